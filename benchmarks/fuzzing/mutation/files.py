"""Edits of a file by the form that its name states."""

import sys
from collections.abc import Sequence
from pathlib import PurePosixPath
from random import Random

from benchmarks.fuzzing.mutation.archive_edits import edited_archive
from benchmarks.fuzzing.mutation.byte_edits import edited_bytes
from benchmarks.fuzzing.mutation.glb_edits import edited_glb
from benchmarks.fuzzing.mutation.json_edits import edited_json, edited_json_lines
from benchmarks.fuzzing.mutation.pickle_edits import edited_pickle
from benchmarks.fuzzing.mutation.table_edits import edited_table
from benchmarks.fuzzing.mutation.tensor_edits import edited_tensors
from benchmarks.fuzzing.mutation.text_edits import edited_text
from benchmarks.fuzzing.mutation.xml_edits import edited_xml

_XML = frozenset({".xml", ".mjcf", ".urdf", ".sdf", ".config", ".dae", ".xacro", ".world"})
_TEXTS = frozenset({".txt", ".toml", ".csv", ".obj", ".mtl", ".usda", ".md", ".jsonl", ".json", ".gltf", "", ".ndjson", *_XML})
_BOTH = frozenset({".ply", ".stl", ".usd"})  # formats that have a form in ASCII
_AS_BYTES = 0.06  # probability of an edit of the bytes of a file that has another form
_RECURSION = 30_000
_AS_TEXT = 0.12  # probability of an edit of the words of a file that is a tree


def edited_file(path: str, content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes:
    """Returns the content of a file with one edit.

    Args:
        path: Its name, whose suffix states its form.
        content: Its content.
        rng: Chooses the edit.
        donors: Contents of other files of the form.
        words: Words of its grammar.
    """
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(_RECURSION)  # else what an edit of a deep tree gives would depend on the depth of the caller
    try:
        return _edited_file(PurePosixPath(path).suffix.lower(), content, rng, donors, words)
    finally:
        sys.setrecursionlimit(before)


def _edited_file(suffix: str, content: bytes, rng: Random, donors: Sequence[bytes], words: Sequence[str]) -> bytes:
    if rng.random() < _AS_BYTES:
        return edited_bytes(content, rng, donors)
    if suffix in _TEXTS and rng.random() < _AS_TEXT:
        return edited_text(content, rng, donors, words)
    changed = _edited(suffix, content, rng, donors, words)
    if changed is not None:
        return changed
    return (
        edited_text(content, rng, donors, words)
        if suffix in _TEXTS and rng.random() < 0.7
        else edited_bytes(content, rng, donors)
    )


def _edited(suffix: str, content: bytes, rng: Random, donors: Sequence[bytes], words: Sequence[str]) -> bytes | None:
    """The content with one edit of its form; None if it does not have the form."""
    if suffix in _XML:
        return edited_xml(content, rng, donors, words)
    if suffix in (".json", ".gltf"):
        return edited_json(content, rng, donors, words)
    if suffix in (".jsonl", ".ndjson"):
        return edited_json_lines(content, rng, donors, words)
    if suffix == ".glb":
        return edited_glb(content, rng, donors, words)
    if suffix == ".parquet":
        return edited_table(content, rng, donors, words)
    if suffix == ".safetensors":
        return edited_tensors(content, rng, donors, words)
    if suffix == ".pkl":
        return edited_pickle(content, rng, donors)
    if suffix in (".usdz", ".zip", ".pth", ".npz"):
        return edited_archive(content, rng, lambda name, inner: edited_file(name, inner, rng, (), words))
    is_text = suffix in _TEXTS or (suffix in _BOTH and content[:2000].isascii())
    return edited_text(content, rng, donors, words) if is_text else None
