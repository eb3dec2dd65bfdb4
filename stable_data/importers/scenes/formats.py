"""The formats of scene files, by their suffixes."""

import posixpath
from pathlib import Path, PurePosixPath

from stable_data.errors import StableDataError
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.gltf import gltf_document, json_length
from stable_data.importers.mjcf_files import start_tags
from stable_data.importers.scenes.gltf_nodes import has_free_body
from stable_data.limits import LIMITS

_GLB_HEAD = 20  # bytes before the JSON of a GLB

MJCF_SUFFIXES = frozenset({".xml", ".mjcf"})
"""Suffixes of MuJoCo files."""

USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc"})
"""Suffixes of USD files."""

GLTF_SUFFIXES = frozenset({".gltf", ".glb"})
"""Suffixes of glTF files."""

SUFFIXES = MJCF_SUFFIXES | USD_SUFFIXES | GLTF_SUFFIXES
"""Suffixes of scene files."""


def is_mjcf(path: str) -> bool:
    """Whether a file is read as a MuJoCo file: it has the suffix of no other format."""
    return not is_usd(path) and not is_gltf(path)


def is_usd(path: str) -> bool:
    """Whether a file is a USD file by its suffix."""
    return PurePosixPath(path).suffix.lower() in USD_SUFFIXES


def is_gltf(path: str) -> bool:
    """Whether a file is a glTF file by its suffix."""
    return PurePosixPath(path).suffix.lower() in GLTF_SUFFIXES


def repaired_name(path: str) -> str:
    """The file that is written over a USD file: ``NAME_repaired.usda`` beside it."""
    return f"{posixpath.splitext(path)[0]}_repaired.usda"


def is_scene_candidate(root: Path, path: str) -> bool:
    """Whether a file of a folder may be a scene of its own.

    That is a USD file, an XML file whose first element is ``mujoco``, or a glTF file with a free body; or one whose JSON cannot be
    read, so that it is not left out unseen.
    """
    if is_usd(path):
        return True
    if is_gltf(path):
        return _is_gltf_candidate(Boundary(root), path)
    try:
        tags = start_tags(Boundary(root).read_bytes(path, "max_xml_bytes"), path)
    except StableDataError:
        return False
    return bool(tags) and tags[0].name == "mujoco"


def _is_gltf_candidate(boundary: Boundary, path: str) -> bool:
    size = json_length(boundary.read_head(path, _GLB_HEAD))
    try:
        # Of a GLB only its JSON is read: a folder may hold thousands of single assets.
        is_small = 0 < size <= LIMITS.gltf_scene.max_json_bytes
        content = boundary.read_head(path, _GLB_HEAD + size) if is_small else boundary.read_bytes(path)
        return has_free_body(gltf_document(content, path, LIMITS.gltf_scene))
    except StableDataError:
        return True
