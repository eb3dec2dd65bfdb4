"""Elements of XML with numbers that read back exactly."""

from typing import Any
from xml.etree import ElementTree as ET

import numpy as np


def add(parent: ET.Element, tag: str, content: object = None, **attributes: Any) -> ET.Element:
    """Adds an element.

    Args:
        parent: The element in which it is added.
        tag: Its name.
        content: Its text; numbers as in :func:`text_of`.
        attributes: Its attributes; a name that is a word of Python ends with ``_``, which is left out.
    """
    element = ET.SubElement(parent, tag, {name.rstrip("_"): text_of(value) for name, value in attributes.items()})
    if content is not None:
        element.text = text_of(content)
    return element


def text_of(value: Any) -> str:
    """Numbers as text that reads back to the same number; single precision with as many digits as it has."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if hasattr(value, "__len__"):
        return " ".join(text_of(v) for v in value)
    return str(value.item() if isinstance(value, np.float64) else value)


def document(root: ET.Element) -> bytes:
    """Returns the content of a file, indented."""
    ET.indent(root, " ")
    content: bytes = ET.tostring(root, encoding="utf-8")
    return content + b"\n"
