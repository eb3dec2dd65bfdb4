"""Parses XML from outside with bounds: no document type, so no entities; a limited size and depth."""

import xml.etree.ElementTree as ET
from xml.parsers import expat

from stable_data.errors import MeshError
from stable_data.limits import LIMITS, at_most


class _BoundedTree:
    """Builds the tree; refuses what only an attack contains."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.builder = ET.TreeBuilder()
        self.depth = 0
        self.elements = 0
        self.attributes = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        self.elements += 1
        self.attributes += len(attributes)
        most = LIMITS.model
        if self.elements > most.max_elements or self.attributes > most.max_attributes or self.depth > most.max_element_levels:
            self._refuse_size()
        self.builder.start(tag, attributes)

    def _refuse_size(self) -> None:
        found = {"elements": self.elements, "attributes": self.attributes, "element_levels": self.depth}
        what = next(name for name, count in found.items() if count > getattr(LIMITS.model, f"max_{name}"))
        said, most = what.replace("_", " "), at_most(LIMITS.model, f"max_{what}")
        raise MeshError(f"{self.path}: has {found[what]:,} {said}, expected {most}; simplify it", "model_unreadable")

    def end(self, tag: str) -> None:
        self.depth -= 1
        self.builder.end(tag)

    def data(self, text: str) -> None:
        self.builder.data(text)

    def refuse(self, *_: object) -> None:
        message = f"{self.path}: has a DOCTYPE, expected none; it can define entities that read other files: remove it"
        raise MeshError(message, "model_unreadable")


def parse_xml(content: bytes, path: str) -> ET.Element:
    """Parses an XML text.

    Args:
        content: The file; not trusted.
        path: Its name in messages.

    Returns:
        The outermost element; names of tags and attributes as written, with their prefixes.

    Raises:
        MeshError: ``model_unreadable``: no XML, a document type, or deeper or longer than a model is.
    """
    tree = _BoundedTree(path)
    parser = expat.ParserCreate()
    parser.StartElementHandler = tree.start
    parser.EndElementHandler = tree.end
    parser.CharacterDataHandler = tree.data
    parser.StartDoctypeDeclHandler = tree.refuse
    try:
        parser.Parse(content.removeprefix(b"\xef\xbb\xbf").lstrip(), True)  # many files have blanks before the declaration
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, MeshError):
            raise
        message = f"{path}: no XML that can be read ({error}), expected the XML of a model; correct it"
        raise MeshError(message, "model_unreadable") from error
    return tree.builder.close()
