"""Parses XML from outside with bounds: no document type, so no entities; a limited size and depth."""

import xml.etree.ElementTree as ET
from xml.parsers import expat

from stable_data.errors import MeshError

MOST_BYTES = 8 * 2**20
"""Largest XML of a model."""

_MOST_DEPTH = 64
_MOST_TAGS = 2_000_000


class _BoundedTree:
    """Builds the tree; refuses what only an attack contains."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.builder = ET.TreeBuilder()
        self.depth = 0
        self.tags = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        self.tags += 1
        if self.depth > _MOST_DEPTH or self.tags > _MOST_TAGS:
            found = f"nests {self.depth} levels" if self.depth > _MOST_DEPTH else f"has more than {_MOST_TAGS:,} tags"
            raise MeshError(f"{self.path}: {found}, expected the XML of a model; simplify it", "model_unreadable")
        self.builder.start(tag, attributes)

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
