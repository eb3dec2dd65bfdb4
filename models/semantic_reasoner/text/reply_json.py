"""Objects as a language model reads and writes them: JSON in centimetres and whole degrees.

A reply is ``{"objects":[...]}``; that of an edit also lists the removed instances: ``{"remove":["mug_0"],"objects":[...]}``.
Lengths have one decimal and angles none, so that rendering and parsing are inverses of each other.
"""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from stable_data.errors import SceneError
from stable_data.json_text import json_value
from stable_data.limits import LIMITS, at_most
from stable_data.scene import Relation, SceneObject, Stage, Vec3
from stable_data.storage.json_schemas import LEAST_SIDE_CM, LONGEST_CM, MOST_ENTRIES

DECIMALS = 1
"""Decimals of a length in centimetres."""

_INSTANCE = re.compile(r"[^\W\d_]\w*?_[0-9]+")
# A whole string or a comma before a closing bracket; in an atomic group, so that a string without an end costs linear time.
_STRING_OR_COMMA = re.compile(r'("(?>(?:[^"\\]|\\.)*)(?:"|\Z))|,(?=\s*[\]}])', re.DOTALL)


@dataclass(frozen=True, slots=True)
class LayoutObject:
    """An object of a layout in the units of the text.

    Attributes:
        instance: ``<category>_<number>``, unique in its layout.
        description: d_i, the words for which an asset is retrieved.
        size_cm: s_i, width, depth and height of its box in the yaw frame, centimetres.
        position_cm: p_i, centre of the box, centimetres, world frame.
        z_rotation_deg: r_i, counter-clockwise seen from above, 0 faces the viewer, degrees in (-180, 180].
    """

    instance: str
    description: str
    size_cm: Vec3
    position_cm: Vec3
    z_rotation_deg: int

    @property
    def category(self) -> str:
        """The category in the instance."""
        return self.instance.rpartition("_")[0]

    def to_scene_object(self, stage: Stage | None = None) -> SceneObject:
        """Returns the object in SI units, without an asset and without a support."""
        (w, d, h), (x, y, z) = self.size_cm, self.position_cm
        return SceneObject(
            self.instance,
            self.category,
            (x / 100, y / 100, z / 100),
            math.radians(self.z_rotation_deg),
            (w / 100, d / 100, h / 100),
            description=self.description,
            stage=stage,
        )


def layout_objects(objects: Iterable[SceneObject], known: Mapping[str, str] | None = None) -> tuple[LayoutObject, ...]:
    """Converts scene objects to layout objects, in their order.

    Args:
        objects: The objects; all of one layout, so that names are unique.
        known: Names of the instances, see :func:`layout_names`; None names them here.

    Returns:
        One layout object each. Boxes are rounded to a millimetre, and no side is shorter than that.
    """
    objects = tuple(objects)
    names = layout_names(objects) if known is None else known
    return tuple(
        LayoutObject(
            names[o.instance],
            sanitise_words(o.description) or sanitise_words(o.category.replace("_", " ")) or "object",
            _to_cm(o.size, least=0.1),
            _to_cm(o.position),
            _whole_degrees(o.yaw),
        )
        for o in objects
    )


def layout_names(objects: Iterable[SceneObject]) -> dict[str, str]:
    """Returns ``<category>_<number>`` for each instance, numbered from 0 in the given order."""
    count: Counter[str] = Counter()
    names = {}
    for o in objects:
        category = category_word(o.category)
        names[o.instance] = f"{category}_{count[category]}"
        count[category] += 1
    return names


def renumber_instances(objects: Iterable[LayoutObject], taken: Iterable[str]) -> tuple[LayoutObject, ...]:
    """Gives each object whose name is used already the next free number of its category.

    Numbers only distinguish objects, so a reply with wrong numbers can be used. ``taken`` are the names of other objects.
    """
    used = set(taken)
    named = []
    untried: dict[str, Iterator[str]] = {}  # by category; all names before these are used
    for o in objects:
        if o.instance in used:
            names = untried.setdefault(o.category, _names_of(o.category))
            o = replace(o, instance=next(name for name in names if name not in used))
        used.add(o.instance)
        named.append(o)
    return tuple(named)


def _names_of(category: str) -> Iterator[str]:
    return (f"{category}_{n}" for n in itertools.count())


def category_word(category: str) -> str:
    """Returns a category as it stands in names of instances: small letters, digits and underscores."""
    word = re.sub(r"\W+", "_", category.lower()).strip("_")
    return word if word and not word[0].isdigit() else f"object_{word}".rstrip("_")


def _to_cm(lengths: Vec3, least: float = -math.inf) -> Vec3:
    # + 0.0 turns -0.0 into 0.0, which is rendered differently; so in _vector.
    x, y, z = (max(least, round(100 * v, DECIMALS)) + 0.0 for v in lengths)
    return x, y, z


def _whole_degrees(yaw: float) -> int:
    """An angle in radians as whole degrees in (-180, 180]."""
    return -((180 - round(math.degrees(yaw))) % 360) + 180


def sanitise_words(words: str) -> str:
    """Returns words from outside as one line in which no chat template finds a special token."""
    return re.sub(r"<(?=[|/a-zA-Z])", "< ", " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", words).split()))


# --- text ---------------------------------------------------------------------------------------------------------------------


def render_objects(objects: Iterable[LayoutObject], removed: Sequence[str] | None = None) -> str:
    """Returns the JSON text of a layout or a reply, without white space; ``removed`` is None if it is not of an edit."""
    head = "" if removed is None else f'"remove":{_json(list(removed))},'
    return f'{{{head}"objects":[{",".join(_render(o) for o in objects)}]}}'


def _render(o: LayoutObject) -> str:
    return (
        f'{{"instance":{_json(o.instance)},"description":{_json(o.description)},"size":{_numbers(o.size_cm)}'
        f',"position":{_numbers(o.position_cm)},"z_rotation":{o.z_rotation_deg}}}'
    )


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _numbers(values: Vec3) -> str:
    return f"[{','.join(f'{v:.{DECIMALS}f}' for v in values)}]"


@dataclass(frozen=True, slots=True)
class LayoutReply:
    """The content of a reply.

    Attributes:
        objects: New and changed objects, in the order of the text.
        removed: Removed instances; empty except for edits.
        relations: Relations that shall hold after an edit, with the names of the layout; the JSON text has none.
    """

    objects: tuple[LayoutObject, ...]
    removed: tuple[str, ...] = ()
    relations: tuple[Relation, ...] = ()


POSITION = '"position":['
"""What precedes the position of an object in a text of :func:`render_objects`."""


def parse_beginning(text: str) -> tuple[LayoutObject, ...]:
    """Returns the complete objects of the beginning of a reply; none if its last brace is part of a description."""
    end = text.rfind("}", 0, len(text.removesuffix("]}"))) + 1
    try:
        return parse_reply(f"{text[:end]}]}}").objects if end else ()
    except SceneError:
        return ()


def parse_reply(text: str) -> LayoutReply:
    """Parses a reply in the form of ``schemas/layout_reply.schema.json``.

    Code fences, words before and after the JSON, and commas before closing brackets are skipped, since models without
    constrained decoding add them; of several replies in one text, the last is used. Comments are refused: they often stand for
    objects that are left out. Numbers may have any form of JSON and are rounded to the decimals of the text.

    Raises:
        SceneError: The reply is too long (``reply_too_long``), not JSON (``reply_not_json``), or not in the form of a reply
            (``reply_malformed``).
    """
    data = json_of_reply(text)
    if not isinstance(data, dict) or not isinstance(data.get("objects"), list):
        raise SceneError(f'reply is {_shown(text)}, expected {{"objects":[...]}}', "reply_malformed")
    removed = data.get("remove", [])
    if not isinstance(removed, list) or not all(isinstance(name, str) for name in removed):
        raise SceneError(f'reply: "remove" is {_shown(str(removed))}, expected a list of instances', "reply_malformed")
    for key, entries in (("objects", data["objects"]), ("remove", removed)):
        if len(entries) > MOST_ENTRIES:
            raise SceneError(f'reply: "{key}" has {len(entries)} entries, expected at most {MOST_ENTRIES}', "reply_malformed")
    return LayoutReply(tuple(_parse(entry, k) for k, entry in enumerate(data["objects"])), tuple(removed))


def json_of_reply(text: str, keys: Sequence[str] = ("objects", "remove")) -> Any:
    """Returns the JSON in a reply: what starts at the first brace; if that is no JSON, what starts where the last document opens.

    Args:
        text: The reply; code fences, words around the JSON, and commas before closing brackets are skipped.
        keys: Keys with which the document may open.

    Raises:
        SceneError: The reply is too long (``reply_too_long``), or has no JSON (``reply_not_json``).
    """
    # Lone surrogates are passed, so that their size is counted and not an encoding error.
    num_bytes = len(text.encode("utf-8", "surrogatepass"))
    if num_bytes > LIMITS.text.max_reply_bytes:
        most = at_most(LIMITS.text, "max_reply_bytes", "bytes")
        raise SceneError(f"reply has {num_bytes} bytes, expected {most}; ask again", "reply_too_long")
    end = text.rfind("}") + 1 or len(text)
    opening = re.compile(rf'\{{\s*"(?:{"|".join(map(re.escape, keys))})"\s*:')
    starts = [max(0, text.find("{")), *(m.start() for m in opening.finditer(text))]
    for start in (starts[0], starts[-1]):
        body = text[start:end]
        for attempt in (body, _STRING_OR_COMMA.sub(r"\1", body)):
            try:
                return json_value(attempt)
            except ValueError as error:
                reason = _why_not_json(error)
    raise SceneError(f"reply is not JSON ({reason}): {_shown(text)}; ask again", "reply_not_json")


def _why_not_json(error: ValueError) -> str:
    if not isinstance(error, json.JSONDecodeError):
        return str(error)
    if not error.doc.strip():
        return "it is empty"
    if error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated string"):
        return "it is cut off"
    return f"{error.msg} at {_shown(error.doc[error.pos : error.pos + 40])}"


def _parse(entry: Any, k: int) -> LayoutObject:
    if not isinstance(entry, dict):
        raise SceneError(f"reply: object {k} is {_shown(str(entry))}, expected a JSON object", "reply_malformed")
    instance, description = entry.get("instance"), entry.get("description")
    if not isinstance(instance, str) or not _INSTANCE.fullmatch(instance):
        raise SceneError(
            f'reply: object {k} has "instance" {_shown(str(instance))}, expected a name such as "mug_0"', "reply_malformed"
        )
    if not isinstance(description, str) or not sanitise_words(description):
        raise SceneError(f'reply: {instance} has "description" {_shown(str(description))}, expected words', "reply_malformed")
    size, position = _vector(entry, "size", instance), _vector(entry, "position", instance)
    if min(size) < LEAST_SIDE_CM:
        raise SceneError(
            f"reply: {instance} has size {size}, expected three lengths of 0.1 cm or more, in centimetres", "reply_malformed"
        )
    angle: Any = entry.get("z_rotation")
    if not _is_number(angle):
        raise SceneError(f'reply: {instance} has "z_rotation" {_shown(str(angle))}, expected degrees', "reply_malformed")
    return LayoutObject(instance, sanitise_words(description), size, position, _whole_degrees(math.radians(float(angle))))


def _vector(entry: Mapping[str, Any], key: str, instance: str) -> Vec3:
    values = entry.get(key)
    if not isinstance(values, list) or len(values) != 3 or not all(map(_is_number, values)):
        raise SceneError(f"reply: {instance} has {key!r} {_shown(str(values))}, expected three numbers", "reply_malformed")
    x, y, z = (round(float(v), DECIMALS) + 0.0 for v in values)
    return x, y, z


def _is_number(value: Any) -> bool:
    # JSON's true is an int in Python; the bound also refuses 1e999, which is read as infinity.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LONGEST_CM


def _shown(text: str) -> str:
    words = " ".join(text.split())
    return repr(words if len(words) <= 80 else f"{words[:77]}...")
