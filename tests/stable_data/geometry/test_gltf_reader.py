"""Hostile GLB files: whatever is in one, reading it ends soon, in bounds, with a mesh or a MeshError."""

import io
import json
import re
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from random import Random
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import COLLIDERS, PART_FACES, _GlbReader, load_colliders, load_glb, load_surfaces
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import load_paint
from stable_data.limits import LIMITS, at_most
from tests.bounds import soon
from tests.stable_data.geometry.glb_files import document_of, edited, glb_bytes, rebuilt

BOX = Mesh(trimesh.creation.box().vertices, trimesh.creation.box().faces)
MANY = Mesh(BOX.vertices, BOX.faces.repeat(1_000, axis=0)[:10_000])
HUGE = (2**31, 2**32, 2**63 - 1, 2**63, 2**64, 10**400)
NO_SIZE: tuple[Any, ...] = (-1, -(2**63), 0.0, 3.5, True, False, None, "8", [8], {})


def refused(content: bytes) -> str:
    """The code of the error that each reader of surfaces gives."""
    codes = set()
    for load in (load_glb, load_surfaces):
        with pytest.raises(MeshError) as caught:
            load(content, "thing")
        codes.add(caught.value.code)
    (code,) = codes
    return code


def box_with(entry: str, number: int, **changes: Any) -> bytes:
    """The box with fields of an entry changed; entry 0 is of its indices, 1 of its corners."""
    return edited(glb_bytes(BOX), lambda document: document[entry][number].update(changes))


def test_an_accessor_of_an_empty_view_is_refused() -> None:
    """For an empty buffer numpy does not check the size: the values would be those of foreign memory."""

    def edit(document: dict[str, Any], count: int) -> None:
        document["bufferViews"][1]["byteLength"] = 0
        document["accessors"][1].update(componentType=5121, count=count)
        document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 1}}]

    for count in (3, 8, 3000, 3_000_000, *HUGE):
        code = refused(edited(glb_bytes(BOX), partial(edit, count=count)))
        assert code == ("glb_too_large" if count in HUGE else "glb_truncated")


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
        code = "glb_too_large" if key == "count" else "glb_truncated"
        assert refused(box_with(entry, number, **{key: value})) == code, value


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
        load_surfaces(box_with("meshes", 0, primitives=[{"attributes": {"POSITION": 1, "COLOR_0": index}}]), "thing")


def json_bomb(letters: bytes) -> bytes:
    """The box, its JSON ended by a list of letters."""
    document, binary = document_of(glb_bytes(BOX))
    return rebuilt(json.dumps(document).encode()[:-1] + b',"extras":[' + letters + b"]}", binary)


def with_primitives(document: dict[str, Any], count: int) -> None:
    document["meshes"][0]["primitives"] *= count


def with_nodes(document: dict[str, Any], count: int, num_primitives: int = 1) -> None:
    document["nodes"] *= count
    document["scenes"][0]["nodes"] = list(range(count))
    document["meshes"][0]["primitives"] = [{"attributes": {}, "mode": 0}] * num_primitives


BOMBS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "20,000 primitives of one accessor": ("max_corners", lambda: edited(large(), partial(with_primitives, count=20_000))),
    "300 primitives of one accessor": ("max_corners", lambda: edited(large(), partial(with_primitives, count=300))),
    "faces without many corners": ("max_faces", lambda: edited(glb_bytes(MANY), partial(with_primitives, count=101))),
    "primitives": ("max_primitives", lambda: edited(glb_bytes(BOX), partial(with_primitives, count=20_001))),
    "empty primitives at 10,000 nodes": (
        "max_primitives",
        lambda: edited(glb_bytes(BOX), partial(with_nodes, count=10_000, num_primitives=20_000)),
    ),
    "nodes": ("max_nodes", lambda: edited(glb_bytes(BOX), partial(with_nodes, count=10_001))),
    "children": ("max_nodes", lambda: box_with("nodes", 0, children=[0] * 1_000_000)),
    "a scene of one node many times": ("max_nodes", lambda: box_with("scenes", 0, nodes=[0] * 1_000_000)),
    "JSON that is large": ("max_json_bytes", lambda: json_bomb(b"[]," * 2_000_000 + b"0")),
    "JSON that is deep": ("max_json_levels", lambda: json_bomb(b"[" * 100_000 + b"]" * 100_000)),
    "JSON that hides its depth in strings": (
        "max_json_levels",
        lambda: json_bomb(b'["]]\\\\",["\\"]",' * 70 + b"0" + b"]" * 140),
    ),
}


def large() -> bytes:
    """A mesh of 30,000 vertices and three faces."""
    return glb_bytes(Mesh(BOX.vertices.repeat(3_750, axis=0), BOX.faces[:3] * 3_750))


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_soon_and_the_limit_named(name: str) -> None:
    limit, made = BOMBS[name]
    content = made()
    for load in (load_glb, load_surfaces):
        with soon(), pytest.raises(MeshError, match=re.escape(at_most(LIMITS.mesh, limit))) as caught:
            load(content, "thing")
        assert caught.value.code == "glb_too_large"


def test_json_as_large_as_it_may_be_is_read_soon() -> None:
    content = json_bomb(b"[]," * 1_350_000 + b"0")
    with soon(3.0):
        load_glb(content, "thing")


def test_brackets_in_strings_are_no_levels() -> None:
    load_glb(json_bomb(json.dumps(["[" * 100, '\\"[[{{' * 100, "\\"]).encode()), "thing")


def test_many_textures_are_no_more_than_the_file() -> None:
    """Each of 2,000 views is nearly the whole file."""

    def edit(document: dict[str, Any]) -> None:
        size, count = document["buffers"][0]["byteLength"], 2_000
        document["bufferViews"] += [{"buffer": 0, "byteLength": size - k} for k in range(count)]
        document["images"] = [{"bufferView": 2 + k} for k in range(count)]
        document["textures"] = [{"source": k} for k in range(count)]
        document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(count)]
        document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 1}, "material": k} for k in range(count)]

    with soon(), pytest.raises(MeshError, match="textures that overlap"):
        load_surfaces(edited(glb_bytes(BOX), edit), "thing")


def test_many_textures_are_counted_once() -> None:
    """Each of 19,000 textures has an empty image of its own; all were counted again for each, which took seconds."""
    count = 19_000

    def edit(document: dict[str, Any]) -> None:
        document["bufferViews"] += [{"buffer": 0, "byteLength": 0}] * count
        document["images"] = [{"bufferView": 2 + k} for k in range(count)]
        document["textures"] = [{"source": k} for k in range(count)]

    reader = _GlbReader("thing", LIMITS.mesh)
    reader.open(edited(glb_bytes(BOX), edit))
    with soon():
        assert {reader._image({"index": k}) for k in range(count)} == {b""}


def test_a_colour_of_a_large_accessor_costs_what_the_primitive_has() -> None:
    """Each of 5,000 primitives names the same million colours, and has one triangle."""

    def edit(document: dict[str, Any]) -> None:
        document["accessors"][0]["count"] = 3
        document["accessors"].append(
            {"bufferView": 2, "componentType": 5121, "normalized": True, "count": 10**6, "type": "VEC3"}
        )
        document["bufferViews"].append({"buffer": 0, "byteOffset": 240, "byteLength": 3 * 10**6})
        primitives = [{"attributes": {"POSITION": 1, "COLOR_0": 2}, "indices": 0}]
        document["meshes"][0]["primitives"] = primitives * 5_000

    document, binary = document_of(glb_bytes(BOX))
    edit(document)
    with soon(2.0):
        load_surfaces(rebuilt(document, binary + bytes(3 * 10**6)), "thing")


def colliders_with(part_faces: Any, **primitive: Any) -> bytes:
    """The box with colliders: the box again, as parts of some faces."""

    def edit(document: dict[str, Any]) -> None:
        again = document["meshes"][0]["primitives"][0] | primitive
        document["meshes"].append({"name": COLLIDERS, "primitives": [again], "extras": {PART_FACES: part_faces}})

    return edited(glb_bytes(BOX), edit)


def test_there_may_not_be_many_colliders() -> None:
    assert len(load_colliders(colliders_with([4, 8]), "thing")) == 2
    with soon(), pytest.raises(MeshError, match=r"at most 1,000 \(mesh\.max_colliders in "):
        load_colliders(colliders_with([4] * 1_001), "thing")


def test_colliders_that_cannot_be_are_refused() -> None:
    lines = colliders_with([4, 8], mode=1)
    assert len(load_glb(lines, "thing")[0].faces) == 12
    wrong = [[], [0, 12], [4, 7], [-4, 16], [4.0, 8], [2**63, 4], [True] * 12, "4", None, 12, [[4, 8]], {"4": 8}]
    for content in (lines, colliders_with([4, 8], indices=1), *map(colliders_with, wrong)):
        with pytest.raises(MeshError) as caught:
            load_colliders(content, "thing")
        assert caught.value.code == "glb_invalid"
    with pytest.raises(MeshError) as caught:
        load_colliders(edited(colliders_with([12]), lambda d: d["nodes"][0].update(translation=[1.7e308] * 3)), "thing")
    assert caught.value.code == "glb_nan_vertices"


def rich_glb() -> bytes:
    """Two nodes, colours of a material, of corners and of a texture, colliders, and a view with a stride."""
    binary = document_of(glb_bytes(BOX))[1]
    corners, indices = np.frombuffer(binary[144:], "<f4").reshape(8, 3), binary[:144]
    picture = io.BytesIO()
    Image.new("RGB", (4, 4), "#f08020").save(picture, "png")
    wide = np.concatenate([corners, corners[:, :2]], axis=1).tobytes()  # corners and texture coordinates, 20 bytes a vertex
    chunks = [indices, wide, bytes(range(24)), picture.getvalue()]
    starts = np.cumsum([0, *map(len, chunks)]).tolist()
    primitive = {"attributes": {"POSITION": 1, "TEXCOORD_0": 2, "COLOR_0": 3}, "indices": 0, "material": 0}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "extensionsRequired": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1], "rotation": [0.0, 0.0, 0.6, 0.8], "scale": [1.0, -2.0, 1.0], "translation": [0.0, 0.5, 3.0]},
            {"mesh": 0, "matrix": np.eye(4).ravel().tolist()},
        ],
        "meshes": [
            {"primitives": [primitive, {"attributes": {"POSITION": 1}, "mode": 5}, {"attributes": {"POSITION": 1}, "mode": 0}]},
            {"name": COLLIDERS, "primitives": [{"attributes": {"POSITION": 1}, "indices": 0}], "extras": {PART_FACES: [4, 8]}},
        ],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.5, 0.5, 1.0], "baseColorTexture": {"index": 0, "texCoord": 0}}}
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5125, "count": 36, "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "byteOffset": 12, "componentType": 5126, "count": 8, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5121, "normalized": True, "count": 8, "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(chunk)} for start, chunk in zip(starts, chunks, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    document["bufferViews"][1]["byteStride"] = 20  # type: ignore[index]
    return rebuilt(document, b"".join(chunks))


RICH = rich_glb()
NESTED: list[Any] = []
for _ in range(100):
    NESTED = [NESTED]
NUMBERS = [-1, 0, 1, 2, 3, 7, 36, 144, 5121, 5123, 5126, *HUGE, 0.5, -0.0, 1e-300, 1e308, float("inf"), float("nan")]
OTHERS: list[Any] = [
    None,
    True,
    False,
    "",
    "x",
    "VEC4",
    "SCALAR",
    "\ud800",
    [],
    {},
    [0],
    [0, 0],
    [[]],
    [[1.0] * 4] * 4,
    {"x": 0},
    NESTED,
]


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every list or object of a JSON value with each of its indices or keys."""
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    for key in keys:
        yield value, key
        yield from places(value[key])


def mutated(content: bytes, random: Random) -> bytes:
    """A GLB with some fields, or some bytes, that are others."""
    document, binary = document_of(content)
    for _ in range(random.randint(0, 3)):
        owner, key = random.choice(list(places(document)))
        action = random.randrange(5)
        if action == 0:
            del owner[key]
        elif action == 1:
            owner[key] = [owner[key]] * random.choice((2, 20))
        elif action == 2 and isinstance(owner[key], int | float):
            owner[key] += random.choice((-1, 1))
        else:
            owner[key] = deepcopy(random.choice(random.choice((NUMBERS, OTHERS))))  # later mutations are in place
    damaged = bytearray(rebuilt(document, binary))
    for _ in range(random.choice((0, 0, 1, 20))):
        damaged[random.randrange(len(damaged))] = random.choice((0, 255, random.randrange(256)))
    return bytes(damaged[: len(damaged) - random.choice((0, 0, 0, 1, random.randrange(len(damaged))))])


def surfaces(content: bytes) -> list[Mesh]:
    return [load_glb(content, "thing")[0]]


def colliders(content: bytes) -> list[Mesh]:
    return list(load_colliders(content, "thing"))


def colours(content: bytes) -> list[Mesh]:
    """No mesh, but all that is read for colours."""
    load_surfaces(content, "thing")
    load_paint(content, "thing", BOX)
    return []


@settings(max_examples=400, deadline=None)
@given(st.randoms(use_true_random=False))
def test_of_a_damaged_file_only_meshes_and_mesh_errors_come(random: Random) -> None:
    content = mutated(RICH, random)
    found: list[Mesh] = []
    for load in (surfaces, colliders, colours):
        try:
            found += load(content)
        except MeshError as error:
            code, message = error.code, str(error)
            assert code.startswith(("glb_", "texture_"))
            assert len(message) < 500
            assert message.isprintable()
    for mesh in found:
        assert np.isfinite(mesh.vertices).all()
        assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


def test_the_file_that_is_damaged_is_whole() -> None:
    assert len(load_glb(RICH, "thing")[0].faces) == 12 + 6
    assert [len(part.faces) for part in load_colliders(RICH, "thing")] == [4, 8]
    textured, plain = load_surfaces(RICH, "thing")
    assert textured.image is not None
    assert textured.corner_uv is not None
    assert textured.corner_colours is not None
    assert plain.colour is None
