"""Edits of XML documents as trees; also of the text, for document types, entities and encodings."""

import copy
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from random import Random

from benchmarks.fuzzing.mutation.odd_values import near_number, odd_number, odd_text, outside_path

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_NAME = re.compile(r"[A-Za-z_][\w.:-]{0,60}")
_NO_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")  # what no XML file can hold
_NAMESPACE = re.compile(r"\{(.*?)\}")
_HEADS = (
    '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>',
    '<!DOCTYPE x SYSTEM "/tmp/stable-data-fuzz/model.xml">',
    '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///tmp/stable-data-fuzz/model.xml">]>',
    '<!DOCTYPE x [<!ENTITY % p SYSTEM "../outside/model.xml"> %p;]>',
    '<?xml version="1.0" encoding="utf-16"?>',
    '<?xml version="1.0" encoding="x-none"?>',
    '<?xml version="1.1" standalone="yes"?>',
    '<?xml-stylesheet href="/tmp/stable-data-fuzz/model.xml"?>',
    "<!-- " + "-" * 50 + " -->",
    "\ufeff",
    "&e;",
)
_COPIES = (1, 1, 2, 20, 200)


def edited_xml(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes | None:
    """Returns an XML document with one edit of its tree or of its head; None if it is no XML.

    Args:
        content: The document.
        rng: Chooses the edit.
        donors: Documents from which elements are copied.
        words: Words of the grammar: names of elements and attributes, and values.
    """
    if rng.random() < 0.03:
        return rng.choice(_HEADS).encode() + content
    try:
        root = ET.fromstring(content)  # noqa: S314 - an honest file, or an edit of one without a document type
    except (ET.ParseError, LookupError, ValueError):
        return None
    _edit(root, rng, donors, words)
    if isinstance(root.tag, str) and (found := _NAMESPACE.match(root.tag)):
        ET.register_namespace("", found[1])
    try:
        return ET.tostring(root)
    except (TypeError, ValueError, AttributeError):  # a name or a text that no XML can have
        return None


def _edit(root: ET.Element, rng: Random, donors: Sequence[bytes], words: Sequence[str]) -> None:
    elements = list(root.iter())
    parents = {child: parent for parent in elements for child in parent}
    element = rng.choice(elements)
    kind = rng.random()
    if kind < 0.55:
        _edit_attributes(rng.choice([e for e in elements if e.attrib] or elements), elements, rng, words)
    elif kind < 0.64:
        element.text = _edited_text(rng.choice([e.text for e in elements if e.text] or [""]), rng, words)
    elif kind < 0.72 and element in parents:
        parents[element].remove(element)
    elif kind < 0.8 and element in parents:
        parent, at = parents[element], list(parents[element]).index(element)
        count = rng.choice(_COPIES) if len(list(element.iter())) < 50 else 1
        parent[at:at] = [copy.deepcopy(element) for _ in range(count)]
    elif kind < 0.86:
        other = copy.deepcopy(rng.choice(elements))
        element.insert(rng.randrange(len(element) + 1), other)
    elif kind < 0.91 and donors:
        try:
            there = list(ET.fromstring(rng.choice(donors)).iter())  # noqa: S314 - an honest file
        except (ET.ParseError, ValueError):
            return
        element.append(copy.deepcopy(rng.choice(there)))
    elif kind < 0.95:
        tags = [e.tag for e in elements]
        names = [word for word in words if _NAME.fullmatch(word)]
        element.tag = rng.choice(names) if names and rng.random() < 0.5 else rng.choice(tags)
    elif kind < 0.98:
        inner = copy.deepcopy(element)
        for _ in range(rng.choice((1, 5, 63, 64, 300))):
            outer = ET.Element(element.tag)
            outer.append(inner)
            inner = outer
        element.append(inner)
    else:
        element[:] = rng.sample(list(element), len(element))


def _edit_attributes(element: ET.Element, elements: Sequence[ET.Element], rng: Random, words: Sequence[str]) -> None:
    kind, names = rng.random(), list(element.attrib)
    if kind < 0.6 and names:
        name = rng.choice(names)
        element.set(name, _edited_text(element.attrib[name], rng, words))
    elif kind < 0.7 and names:
        del element.attrib[rng.choice(names)]
    elif kind < 0.85:
        other = rng.choice([e for e in elements if e.attrib] or elements)
        if other.attrib:
            name = rng.choice(list(other.attrib))
            element.set(name, other.attrib[name])
    else:
        known = [word for word in words if _NAME.fullmatch(word)] or ["name"]
        element.set(rng.choice(known), _edited_text("", rng, words))


def _edited_text(text: str, rng: Random, words: Sequence[str]) -> str:
    """A value with an edit: of a number in it, of the list of its words, of its name of a file, or another value."""
    kind, numbers = rng.random(), list(_NUMBER.finditer(text))
    if numbers and kind < 0.65:
        found = rng.choice(numbers)
        new = near_number(float(found[0]), rng) if rng.random() < 0.5 else odd_number(rng)
        return text[: found.start()] + _plain(new) + text[found.end() :]
    parts = text.split()
    if parts and kind < 0.75:
        k = rng.randrange(len(parts))
        if rng.random() < 0.5:
            parts[k : k + 1] = []
        else:
            parts[k:k] = [parts[k]] * rng.choice((1, 1, 3, 100))
        return " ".join(parts)
    if kind < 0.87:
        return outside_path(rng)
    return _NO_XML.sub("", odd_text(rng, words)) if rng.random() < 0.95 else odd_text(rng, words)


def _plain(value: float | int) -> str:
    return str(value)
