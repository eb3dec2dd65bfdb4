"""The readers by the kinds of source folders."""

from collections.abc import Mapping
from importlib import import_module

from stable_data.errors import ConfigError
from stable_data.importers.source import Reader

READERS: Mapping[str, str] = {
    "mesh": "stable_data.importers.mesh_reader",
    "mjcf": "stable_data.importers.mjcf",
    "sdformat": "stable_data.importers.sdformat",
    "urdf": "stable_data.importers.urdf",
    "usd": "stable_data.importers.usd",
}
"""Kind -> module, whose ``READER`` reads it. Modules are imported when they are needed: some need packages that are optional."""


def reader_of(kind: str) -> Reader:
    """Returns the reader of a kind of source folder.

    Raises:
        ConfigError: ``unknown_kind``.
    """
    if kind not in READERS:
        raise ConfigError(f"there is no kind {kind!r}, expected one of {', '.join(READERS)}", "unknown_kind")
    reader: Reader = import_module(READERS[kind]).READER
    return reader
