"""The formats of scene files, by their suffixes."""

import posixpath
from pathlib import Path, PurePosixPath

from stable_data.errors import StableDataError
from stable_data.importers.boundary import Boundary
from stable_data.importers.mjcf_files import MAX_XML_BYTES, start_tags

MJCF_SUFFIXES = frozenset({".xml", ".mjcf"})
"""Suffixes of MuJoCo files."""

USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc"})
"""Suffixes of USD files."""

SUFFIXES = MJCF_SUFFIXES | USD_SUFFIXES
"""Suffixes of scene files."""


def is_usd(path: str) -> bool:
    """Whether a file is a USD file by its suffix."""
    return PurePosixPath(path).suffix.lower() in USD_SUFFIXES


def repaired_name(path: str) -> str:
    """The file that is written over a USD file: ``NAME_repaired.usda`` beside it."""
    return f"{posixpath.splitext(path)[0]}_repaired.usda"


def is_scene_candidate(root: Path, path: str) -> bool:
    """Whether a file of a folder may be a scene of its own: a USD file, or an XML file whose first element is ``mujoco``."""
    if is_usd(path):
        return True
    try:
        tags = start_tags(Boundary(root).read_bytes(path, most=MAX_XML_BYTES), path)
    except StableDataError:
        return False
    return bool(tags) and tags[0].name == "mujoco"
