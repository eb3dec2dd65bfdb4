"""Hostile GLB files: whatever is in one, reading it ends soon, in bounds, with a mesh or a MeshError."""

from typing import Any

import pytest
import trimesh

from stable_data.errors import MeshError
from stable_data.glb import load_coats, load_glb
from stable_data.mesh import Mesh
from tests.stable_data.glb_files import edited, glb_bytes

BOX = Mesh(trimesh.creation.box().vertices, trimesh.creation.box().faces)
HUGE = (2**31, 2**32, 2**63 - 1, 2**63, 2**64, 10**400)
NO_SIZE = (-1, -(2**63), 0.0, 3.5, True, False, None, "8", [8], {})


def refused(content: bytes) -> str:
    """The code of the error that each reader of surfaces gives."""
    codes = set()
    for load in (load_glb, load_coats):
        with pytest.raises(MeshError) as caught:
            load(content, "thing")
        codes.add(caught.value.code)
    (code,) = codes
    return code


def box_with(entry: str, number: int, **changes: Any) -> bytes:
    """The box with fields of an entry changed; entry 0 is of its indices, 1 of its corners."""
    return edited(glb_bytes(BOX), lambda document: document[entry][number].update(changes))


@pytest.mark.parametrize("count", [1, 8, 3000, *HUGE])
def test_an_accessor_of_an_empty_view_is_refused(count: int) -> None:
    """For an empty buffer numpy does not check the size: the values would be those of foreign memory."""

    def edit(document: dict[str, Any]) -> None:
        document["bufferViews"][1]["byteLength"] = 0
        document["accessors"][1].update(componentType=5121, count=count)
        document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 1}}]

    assert refused(edited(glb_bytes(BOX), edit)) == "glb_truncated"


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ("accessors", "count"),
        ("accessors", "byteOffset"),
        ("bufferViews", "byteOffset"),
        ("bufferViews", "byteLength"),
        ("bufferViews", "byteStride"),
    ],
)
def test_a_size_that_is_none_or_reaches_beyond_its_view_is_refused(entry: str, key: str, number: int) -> None:
    for value in NO_SIZE:
        assert refused(box_with(entry, number, **{key: value})) == "glb_invalid", value
    for value in HUGE:
        assert refused(box_with(entry, number, **{key: value})) == "glb_truncated", value


def test_the_last_element_ends_where_its_view_does() -> None:
    load_glb(box_with("accessors", 1, count=8), "thing")
    for changes in ({"count": 9}, {"byteOffset": 1}, {"count": 7, "byteOffset": 13}):
        assert refused(box_with("accessors", 1, **changes)) == "glb_truncated"
    assert refused(box_with("bufferViews", 1, byteStride=13)) == "glb_truncated"
    assert refused(box_with("bufferViews", 1, byteStride=11)) == "glb_invalid"
    assert refused(box_with("bufferViews", 1, byteLength=95)) == "glb_truncated"
    assert refused(box_with("bufferViews", 1, byteOffset=36 * 4 + 1)) == "glb_truncated"


def test_a_sparse_accessor_is_refused_whatever_its_sizes() -> None:
    for count in (0, 1, *HUGE):
        sparse = {"count": count, "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 1}}
        assert refused(box_with("accessors", 1, sparse=sparse)) == "glb_unsupported"


@pytest.mark.parametrize("index", [-1, 2, 10**400, 1.0, True, None, "1", [1]])
def test_an_index_that_is_none_of_its_list_is_refused(index: object) -> None:
    assert refused(box_with("accessors", 1, bufferView=index)) == "glb_invalid"
    assert refused(box_with("bufferViews", 1, buffer=index)) == "glb_invalid"
    assert refused(box_with("nodes", 0, mesh=index)) == "glb_invalid"
    assert refused(box_with("meshes", 0, primitives=[{"attributes": {"POSITION": index}}])) == "glb_invalid"
    with pytest.raises(MeshError):
        load_coats(box_with("meshes", 0, primitives=[{"attributes": {"POSITION": 1, "COLOR_0": index}}]), "thing")
