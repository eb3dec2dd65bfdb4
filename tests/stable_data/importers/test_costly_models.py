"""Models of a few bytes that ask for much time or memory: each is refused soon, and the limit is named."""

import io
import itertools
import json
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from stable_data.errors import MeshError, Notice
from stable_data.importers import mjcf_files, rigid_models, sdformat, urdf
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.collada_dae import _placed
from stable_data.importers.formats.obj import _parse_library, _vertex_colours
from stable_data.importers.formats.xml_text import parse_xml
from stable_data.importers.mesh_files import files_beside, read_mesh_file
from stable_data.importers.mjcf.reader import READER as MJCF
from stable_data.importers.mjcf.text import MjcfText
from stable_data.importers.mjcf_files import collect_files
from stable_data.importers.scenes.gltf_scenes import read_gltf_scene
from stable_data.importers.source import ReaderOptions, SourceRef
from stable_data.importers.usd.layers import LayerLoader, check_prims
from stable_data.importers.usd.shapes import triangulate
from stable_data.limits import LIMITS, SETTING, FileLimits, GltfLimits
from stable_data.scene import FloatArray
from tests.bounds import limit, little_memory, soon

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def refused(folder: Path, name: str, content: str | bytes, code: str, named: str, seconds: float = 5.0) -> None:
    """Asserts that a mesh file is refused soon, with the name of a limit."""
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with soon(seconds), pytest.raises(MeshError) as caught:
        read_mesh_file(Boundary(folder), name, "thing", max_faces=LIMITS.model.max_faces)
    assert (caught.value.code, f"({named} in {SETTING})" in str(caught.value)) == (code, True), str(caught.value)


# --- meshes ---


@pytest.mark.parametrize(
    "names",
    [
        "".join(f"mtllib m{k}.mtl\n" for k in range(5_000)),
        "mtllib " + " ".join(f"m{k}.mtl" for k in range(5_000)),
    ],
)
def test_an_obj_names_a_limited_number_of_files(names: str, tmp_path: Path) -> None:
    refused(tmp_path, "thing.obj", names + TRIANGLE, "file_too_large", "file.max_files")
    with soon(3.0):
        assert files_beside(Boundary(tmp_path), "thing.obj") == ()


def test_a_file_of_materials_is_read_and_parsed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line of 1 MB that names one file of 8 MB was once 170,000 copies of it."""
    parsed = list[bytes]()

    def parse(content: bytes) -> Any:
        parsed.append(content)
        return _parse_library(content)

    monkeypatch.setattr("stable_data.importers.formats.obj._parse_library", parse)
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "b.mtl").write_text("newmtl b\nKd 0 1 0\nnewmtl a\nKd 0 0 1\n")
    names = f"mtllib {'a.mtl ' * 1000}\nmtllib a.mtl b.mtl\nmtllib ./a.mtl A.mtl b.mtl\nmtllib b.mtl\n"
    (tmp_path / "thing.obj").write_text(names + TRIANGLE.replace("f ", "usemtl a\nf ") + "usemtl b\nf 1 2 3\n")
    found, notices = read_mesh_file(Boundary(tmp_path), "thing.obj", "thing", max_faces=2)
    assert [surface.colour for surface in found.surfaces] == [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    assert not notices
    assert parsed == [(tmp_path / name).read_bytes() for name in ("a.mtl", "b.mtl")]


def test_colours_of_vertices_are_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once for each material, they took minutes for 1 MB of vertices and 1 MB of materials."""
    calls = list[int]()

    def colours(rows: FloatArray) -> FloatArray | None:
        calls.append(len(rows))
        return _vertex_colours(rows)

    monkeypatch.setattr("stable_data.importers.formats.obj._vertex_colours", colours)
    faces = "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(50))
    (tmp_path / "thing.obj").write_text("v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\n" + faces)
    found, _ = read_mesh_file(Boundary(tmp_path), "thing.obj", "thing", max_faces=50)
    assert [surface.corner_colours is not None for surface in found.surfaces] == [True] * 50
    assert calls == [3]


def test_an_image_of_many_names_is_in_memory_once(tmp_path: Path) -> None:
    names = ["i.png", "./i.png", "I.png", "x%2F..%2Fi.png", *("./" * k + "i.png" for k in range(2, 50))]
    (tmp_path / "x").mkdir()
    (tmp_path / "i.png").write_bytes(bytes(100_000))
    (tmp_path / "m.mtl").write_text("".join(f"newmtl m{k}\nmap_Kd {name}\n" for k, name in enumerate(names)))
    faces = "".join(f"usemtl m{k}\nf 1/1 2/1 3/1\n" for k in range(len(names)))
    (tmp_path / "thing.obj").write_text("mtllib m.mtl\nvt 0 0\n" + TRIANGLE + faces)
    found, notices = read_mesh_file(Boundary(tmp_path), "thing.obj", "thing", max_faces=100)
    images = [surface.image for surface in found.surfaces if surface.image is not None]
    assert (len(images), len({id(image) for image in images}), notices) == (len(names), 1, ())


def test_a_gltf_names_a_limited_number_of_images(tmp_path: Path) -> None:
    images = ",".join(f'{{"uri": "i{k}.png"}}' for k in range(5_000))
    refused(
        tmp_path, "thing.gltf", f'{{"asset": {{"version": "2.0"}}, "images": [{images}]}}', "file_too_large", "file.max_files"
    )


def test_a_gltf_names_a_limited_number_of_buffers(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(4))
    buffers = ",".join(f'{{"uri": "{prefix}a.bin"}}' for prefix in ("./" * k for k in range(501)))
    text = f'{{"asset": {{"version": "2.0"}}, "buffers": [{buffers}]}}'
    refused(tmp_path, "thing.gltf", text, "file_too_large", "file.max_files")


def test_the_files_of_a_gltf_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each entry once read its file again: 1 MB of them took more than a minute."""
    read, opened = Boundary.read_bytes, list[str]()

    def counted(self: Boundary, path: str, *limits: Any) -> bytes:
        opened.append(path)
        return read(self, path, *limits)

    monkeypatch.setattr(Boundary, "read_bytes", counted)
    (tmp_path / "a.bin").write_bytes(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes())
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "a-rigid"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 199, "byteLength": 36}],
        "buffers": [{"uri": "a.bin", "byteLength": 36}] * 200,
        "images": [{"uri": "none.png"}] * 200,
    }
    (tmp_path / "thing.gltf").write_text(json.dumps(document))
    found, notices = read_mesh_file(Boundary(tmp_path), "thing.gltf", "thing", max_faces=1)
    assert len(found.surfaces) == 1
    assert (opened, [notice.code for notice in notices]) == (["thing.gltf", "a.bin"], ["texture_missing"])
    opened.clear()
    scene = read_gltf_scene(Boundary(tmp_path), "thing.gltf")
    assert (opened, [notice.code for notice in scene.file.notices].count("file_missing")) == (["thing.gltf", "a.bin"], 1)


def many_nodes(count: int, extras: str = "") -> bytes:
    """A GLB whose scene shows one triangle in so many nodes."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(range(count))}],
        "nodes": [{"mesh": 0, "name": "a-rigid"}] * count,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
        "extras": extras,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s4I", b"glTF", 2, 64 + len(text), len(text), 0x4E4F534A)
    return head + text + struct.pack("<2I", 36, 0x004E4942) + corners


def test_the_limits_of_a_mesh_hold_for_one_that_is_imported_and_may_be_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes, long = many_nodes(10_001), many_nodes(2, "x" * 5 * 2**20)
    refused(tmp_path, "nodes.glb", nodes, "mesh_too_large", "mesh.max_nodes")
    refused(tmp_path, "json.glb", long, "mesh_too_large", "mesh.max_json_bytes")
    limit(monkeypatch, "model", max_faces=10_000)
    limit(monkeypatch, "mesh", max_nodes=20_000, max_json_bytes=2**23, max_faces=1)  # of a library, which reduces them
    refused(tmp_path, "nodes.glb", nodes, "mesh_too_large", "model.max_faces")
    limit(monkeypatch, "model", max_faces=10_001)
    for name, count in (("nodes.glb", 10_001), ("json.glb", 2)):
        file, _ = read_mesh_file(Boundary(tmp_path), name, "thing", max_faces=LIMITS.model.max_faces)
        assert sum(len(surface.triangles) for surface in file.surfaces) == count


@dataclass(frozen=True)
class Asked(GltfLimits):
    """Limits that remember which of them were asked for."""

    names: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str) -> Any:
        Asked.names.add(name)
        return super().__getattribute__(name)


def test_every_limit_of_a_gltf_scene_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is listed but never compared with anything would be a promise that nobody keeps."""
    (tmp_path / "a.glb").write_bytes(many_nodes(2))
    monkeypatch.setattr(LIMITS, "gltf_scene", Asked())
    read_gltf_scene(Boundary(tmp_path), "a.glb")
    assert {one.name for one in fields(GltfLimits)} <= Asked.names


def test_all_buffers_together_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "thing.glb").write_bytes(many_nodes(1))
    with pytest.raises(MeshError, match=r"expected at most 35 bytes \(max_bytes\)"):
        read_mesh_file(Boundary(tmp_path, FileLimits(max_file_bytes=10**6, max_bytes=35)), "thing.glb", "thing", max_faces=9)


def test_a_scene_in_gltf_has_limits_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "json.glb").write_bytes(many_nodes(2, "x" * 5 * 2**20))  # more than of a mesh
    assert len(read_gltf_scene(Boundary(tmp_path), "json.glb").nodes) == 2
    limit(monkeypatch, "gltf_scene", max_json_bytes=2**22)
    with pytest.raises(MeshError, match=r"at most 4,194,304 bytes \(gltf_scene\.max_json_bytes in STABLE_DATA_LIMITS\)"):
        read_gltf_scene(Boundary(tmp_path), "json.glb")


def dae(geometry: str, nodes: str) -> str:
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
    <asset><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>{geometry}</mesh></geometry></library_geometries>
    <library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>
    <scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def triangle(count: int) -> str:
    """The geometry of one triangle whose list has so many vertices."""
    numbers = " ".join(["0 0 0 1 0 0 0 1 0", *["0 0 0"] * (count - 3)])
    params = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    return f"""<source id="p"><float_array id="a" count="{3 * count}">{numbers}</float_array>
    <technique_common><accessor source="#a" count="{count}" stride="3">{params}</accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>"""


def test_a_geometry_of_many_vertices_is_not_converted_as_often_as_it_is_shown(tmp_path: Path) -> None:
    """Each use once converted all its vertices: 1,000 uses of 300,000 took minutes."""
    (tmp_path / "thing.dae").write_text(dae(triangle(300_000), '<node><instance_geometry url="#g"/></node>' * 1000))
    with soon(15.0):
        found, _ = read_mesh_file(Boundary(tmp_path), "thing.dae", "thing", max_faces=10_000)
    assert len(found.surfaces) == 1000


def test_primitives_of_a_geometry_count_as_often_as_it_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1,200 primitives that 10,000 nodes show were once 12 million surfaces."""
    limit(monkeypatch, "mesh", max_primitives=100)
    geometry = triangle(3)
    more = geometry[geometry.index("<triangles") :]
    (tmp_path / "thing.dae").write_text(dae(geometry + more * 9, '<node><instance_geometry url="#g"/></node>' * 10))
    found, _ = read_mesh_file(Boundary(tmp_path), "thing.dae", "thing", max_faces=1000)
    assert len(found.surfaces) == 100
    text = dae(geometry + more * 10, '<node><instance_geometry url="#g"/></node>' * 10)
    refused(tmp_path, "thing.dae", text, "mesh_too_large", "mesh.max_primitives")


def test_materials_of_a_node_are_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not as often as other nodes show it."""
    lists = list[object]()

    class Materials(list[Any]):
        def __iter__(self) -> Iterator[Any]:
            lists.append(self)
            return super().__iter__()

    def placed(*scene: Any) -> Iterator[Any]:
        for node, *more in _placed(*scene):
            node.materials = node.materials if isinstance(node.materials, Materials) else Materials(node.materials)
            yield node, *more

    monkeypatch.setattr("stable_data.importers.formats.collada_dae._placed", placed)
    text = dae(triangle(3), '<node><instance_node url="#n"/><instance_node url="#n"/></node>')
    library = '<library_nodes><node id="n"><instance_geometry url="#g"/></node></library_nodes><library_visual_scenes>'
    (tmp_path / "thing.dae").write_text(text.replace("<library_visual_scenes>", library))
    found, _ = read_mesh_file(Boundary(tmp_path), "thing.dae", "thing", max_faces=2)
    assert (len(found.surfaces), len(lists)) == (2, 1)


def test_nodes_that_show_each_other_twice_are_counted(tmp_path: Path) -> None:
    twice = '<instance_node url="#n{0}"/><instance_node url="#n{0}"/>'
    levels = "".join(f'<node id="n{k}">{twice.format(k + 1)}</node>' for k in range(30))
    library = f'<library_nodes>{levels}<node id="n30"><instance_geometry url="#g"/></node></library_nodes>'
    text = dae(triangle(3), '<node><instance_node url="#n0"/></node>')
    text = text.replace("<library_visual_scenes>", library + "<library_visual_scenes>")
    refused(tmp_path, "thing.dae", text, "mesh_too_large", "model.max_nodes")


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"<a>" + b"<b/>" * 5_000 + b"</a>", "model.max_elements"),
        (b"<a>" + b'<b c="" d="" e="" f="" g="" h=""/>' * 4_000 + b"</a>", "model.max_attributes"),
        (b"<a>" * 1000, "model.max_element_levels"),
    ],
)
def test_xml_has_limited_elements_attributes_and_levels(content: bytes, named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "model", max_elements=5_000, max_attributes=20_000)
    with soon(2.0), pytest.raises(MeshError, match=rf"\({named} in {SETTING}\)") as caught:
        parse_xml(content, "thing.xml")
    assert caught.value.code == "model_unreadable"


# --- models of links ---

VISUAL = "<visual><geometry><mesh filename='m.obj'/></geometry></visual>"
MANY: dict[str, Callable[[], str]] = {
    "links.urdf": lambda: "<robot name='r'>" + "".join(f"<link name='l{k}'/>" for k in range(2001)) + "</robot>",
    "joints.urdf": lambda: "<robot name='r'>" + "<joint><parent/><child/></joint>" * 20_000 + "</robot>",
    "visuals.urdf": lambda: "<robot name='r'><link name='l'>" + VISUAL * 20_000 + "</link></robot>",
    "frames.sdf": lambda: (
        "<sdf version='1.7'><model name='m'>"
        + "".join(f"<frame name='f{k}' attached_to='f{k + 1}'/>" for k in range(5_000))
        + "".join(f"<joint name='j{k}' type='fixed'><parent>f0</parent><child>f0</child></joint>" for k in range(5_000))
        + "</model></sdf>"
    ),
}


@pytest.mark.parametrize("name", MANY)
def test_a_model_has_a_limited_number_of_parts(name: str, tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(TRIANGLE)
    (tmp_path / name).write_text(MANY[name]())
    read = urdf.read_model if name.endswith(".urdf") else sdformat.read_model
    with soon(5.0), pytest.raises(MeshError, match=rf"\(model\.max_\w+ in {SETTING}\)") as caught:
        read(Boundary(tmp_path), name, "thing")
    assert caught.value.code == "mesh_too_large"


def test_a_file_that_is_included_often_counts_as_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "file", max_nested_bytes=100_000)
    part = f"<sdf version='1.7'><model name='p'><link name='l'/></model><!--{'x' * 10_000}--></sdf>"
    includes = "".join(f"<include><uri>part.sdf</uri><name>n{k}</name></include>" for k in range(50))
    (tmp_path / "part.sdf").write_text(part)
    (tmp_path / "whole.sdf").write_text(f"<sdf version='1.7'><model name='m'>{includes}</model></sdf>")
    with pytest.raises(MeshError, match=rf"\(file\.max_nested_bytes in {SETTING}\)") as caught:
        sdformat.read_model(Boundary(tmp_path), "whole.sdf", "thing")
    assert caught.value.code == "mesh_too_large"


def sdf(body: str) -> str:
    return f"<sdf version='1.9'><model name='m'>{body}</model></sdf>"


JOINTS = "".join(f"<joint name='j{k}' type='fixed'><parent>world</parent><child>f</child></joint>" for k in range(1000))
LINKS = "".join(f"<link name='l{k}'/>" for k in range(300))
LONG = "A" * 300_000


@pytest.mark.parametrize(
    "body",
    [
        f"<model name='{LONG}'>{LINKS}</model>",
        f"<model name='n'><frame name='f' attached_to='{LONG}'/>{JOINTS}</model>",
        f"<model name='{'n' * 600}'><model name='{'n' * 600}'>{LINKS}</model></model>",
    ],
)
def test_a_long_name_is_not_copied_for_each_link_or_joint_of_a_nested_model(body: str, tmp_path: Path) -> None:
    (tmp_path / "m.sdf").write_text(sdf(body))
    with little_memory(2 * 10**7), pytest.raises(MeshError, match="expected at most 1000") as caught:
        sdformat.read_model(Boundary(tmp_path), "m.sdf", "thing")
    assert (caught.value.code, len(str(caught.value)) < 300) == ("model_unreadable", True)


def counted(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, position: int) -> list[Any]:
    """Lists an argument of all calls of a function."""
    calls, function = [], getattr(module, name)

    def called(*arguments: Any, **more: Any) -> Any:
        calls.append(arguments[position])
        return function(*arguments, **more)

    monkeypatch.setattr(module, name, called)
    return calls


def test_a_model_config_is_read_once_however_often_its_model_is_included(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "leg").mkdir()
    (tmp_path / "leg" / "model.config").write_text("<model><sdf>leg.sdf</sdf></model>")
    (tmp_path / "leg" / "leg.sdf").write_text(sdf("<link name='l'/>"))
    includes = "".join(f"<include><uri>model://leg</uri><name>n{k}</name></include>" for k in range(20))
    (tmp_path / "m.sdf").write_text(sdf(includes))
    parsed = counted(monkeypatch, sdformat, "parse_xml", 1)
    assert len(sdformat.read_model(Boundary(tmp_path), "m.sdf", "thing").links) == 20
    assert (parsed.count("leg/model.config"), parsed.count("leg/leg.sdf")) == (1, 20)


def test_links_of_included_models_are_counted_before_all_of_them_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit(monkeypatch, "model", max_links=300)
    (tmp_path / "part.sdf").write_text(sdf(LINKS))
    includes = "".join(f"<include><uri>part.sdf</uri><name>n{k}</name></include>" for k in range(50))
    (tmp_path / "m.sdf").write_text(sdf(includes))
    parsed = counted(monkeypatch, sdformat, "parse_xml", 1)
    with pytest.raises(MeshError, match=rf"\(model\.max_links in {SETTING}\)"):
        sdformat.read_model(Boundary(tmp_path), "m.sdf", "thing")
    assert parsed == ["m.sdf", "part.sdf", "part.sdf"]


def test_frames_are_looked_for_once_and_not_for_each_joint(tmp_path: Path) -> None:
    (tmp_path / "m.sdf").write_text(sdf("<link name='f'/>" + JOINTS + "<a/>" * 200_000))
    with soon(3.0):
        assert len(sdformat.read_model(Boundary(tmp_path), "m.sdf", "thing").joints) == 1000


def test_a_long_colour_is_parsed_once_however_many_visuals_have_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    visuals = "<visual><geometry><box size='1 1 1'/></geometry><material name='a'/></visual>" * 50
    material = "<material name='a'><color rgba='0 1 0 0.5'/></material>"
    (tmp_path / "m.urdf").write_text(f"<robot>{material}<link name='l'>{visuals}</link></robot>")
    parsed = counted(monkeypatch, urdf, "linear_colour", 0)
    (link,) = urdf.read_model(Boundary(tmp_path), "m.urdf", "thing").links
    assert {(shape.colour, shape.opacity) for shape in link.visuals} == {((0.0, 1.0, 0.0), 0.5)}
    assert parsed == ["0 1 0 0.5"]


TEXTURED = f"{TRIANGLE.partition('f')[0]}vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def test_a_mesh_that_is_shown_with_many_images_is_parsed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And once more for shapes that state no image."""
    (tmp_path / "m.obj").write_text(TEXTURED)
    images = [f"{k}.png" for k in range(20)]
    for name in images:
        (tmp_path / name).write_bytes(name.encode())
    form = "<visual name='v'><geometry><mesh><uri>m.obj</uri></mesh></geometry>{}</visual>"
    looks = [f"<material><pbr><metal><albedo_map>{name}</albedo_map></metal></pbr></material>" for name in images]
    (tmp_path / "m.sdf").write_text(sdf("<link name='l'>" + "".join(map(form.format, [*looks, ""])) + "</link>"))
    parsed = counted(monkeypatch, rigid_models, "read_mesh_file", 1)
    boundary = Boundary(tmp_path)
    asset = rigid_models.assemble(sdformat.read_model(boundary, "m.sdf", "thing"), boundary, "thing", max_faces=100)
    assert [surface.image for surface in asset.surfaces] == [*(name.encode() for name in images), None]
    assert parsed == ["m.obj", "m.obj"]


def test_meshes_of_which_a_part_is_shown_count_whole(tmp_path: Path) -> None:
    """They are kept whole: a file of some kilobytes may show a mesh ten thousand times."""
    nodes = '<node name="part"><instance_geometry url="#g"/></node>' + '<node><instance_geometry url="#g"/></node>' * 9
    shapes = ""
    for k in range(5):
        (tmp_path / f"{k}.dae").write_text(dae(triangle(3), nodes))
        part = f"<mesh><uri>{k}.dae</uri><submesh><name>part</name></submesh></mesh>"
        shapes += f"<visual name='v{k}'><geometry>{part}</geometry></visual>" * 2
    (tmp_path / "m.sdf").write_text(sdf(f"<link name='l'>{shapes}</link>"))
    boundary = Boundary(tmp_path)
    model = sdformat.read_model(boundary, "m.sdf", "thing")
    assert len(rigid_models.assemble(model, boundary, "thing", max_faces=50).surfaces) == 10
    with pytest.raises(MeshError, match="shown in part: has 50 triangles, expected at most 49") as caught:
        rigid_models.assemble(model, boundary, "thing", max_faces=49)
    assert caught.value.code == "mesh_too_large"


# --- MJCF ---


def stl(num_faces: int) -> bytes:
    return bytes(80) + struct.pack("<I", num_faces) + bytes(50 * num_faces)


def test_the_triangles_of_a_model_are_counted_before_mujoco_reads_them(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_bytes(stl(30_000))
    meshes = "".join(f'<mesh name="m{k}" file="m.stl"/>' for k in range(1000))
    (tmp_path / "thing.xml").write_text(
        f'<mujoco><asset>{meshes}</asset><worldbody><geom type="mesh" mesh="m0"/></worldbody></mujoco>'
    )
    with soon(5.0), pytest.raises(MeshError, match=rf"\(model\.max_faces in {SETTING}\)") as caught:
        MJCF.read(Boundary(tmp_path), SourceRef("thing", "thing.xml", ("thing.xml",), {}), ReaderOptions())
    assert caught.value.code == "mesh_too_large"


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MANY_CORNERS = "".join(f"v {k} {k * k} {k * k * k}\n" for k in range(12))


@pytest.mark.parametrize(
    ("name", "content", "count"),
    [
        ("m.obj", CORNERS + FACES, 4),
        ("m.obj", FACES + CORNERS, 4),
        ("m.obj", (CORNERS + FACES).replace("f ", " \t f\t"), 4),
        ("m.obj", (CORNERS + FACES).replace("\n", "\r"), 4),
        ("m.obj", (CORNERS + FACES).replace("\n", "\r\n"), 4),
        ("m.obj", MANY_CORNERS, 4),
        ("m.obj", MANY_CORNERS.replace("v ", " v\t").replace("\n", "\r"), 4),
        ("m.obj", MANY_CORNERS + "f 1 2 3 4 5  6 \n", 4),
        ("m.obj", "# off\n" + CORNERS + FACES + "vn 0 0 1\n" * 100 + "vt 0 0\n" * 100, 4),
        ("m.msh", struct.pack("<4i", 12, 0, 0, 0) + bytes(12 * 12), 4),
    ],
)
def test_faces_are_counted_in_every_form_that_mujoco_reads(name: str, content: str | bytes, count: int, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    meshes = "".join(f'<mesh name="m{k}" file="{name}"/>' for k in range(10))
    (tmp_path / "thing.xml").write_text(f"<mujoco><asset>{meshes}</asset><worldbody><geom/></worldbody></mujoco>")
    boundary = Boundary(tmp_path)
    model = MjcfText.load(boundary, "thing.xml")
    assert model is not None
    model.isolated(boundary, 10 * count)
    with pytest.raises(MeshError, match=rf"has {10 * count} triangles") as caught:
        model.isolated(boundary, 10 * count - 1)
    assert caught.value.code == "mesh_too_large"


def test_a_polygon_counts_as_the_time_in_which_mujoco_cuts_it(tmp_path: Path) -> None:
    """One of 8,000 corners takes 5 s, and a file may be named as a mesh again and again."""
    (tmp_path / "m.obj").write_text(CORNERS + "f" + " 1 2 3 4" * 2_000 + "\n")
    (tmp_path / "thing.xml").write_text('<mujoco><asset><mesh file="m.obj"/></asset><worldbody><geom/></worldbody></mujoco>')
    boundary = Boundary(tmp_path)
    model = MjcfText.load(boundary, "thing.xml")
    assert model is not None
    with pytest.raises(MeshError, match="has 1,000,000 triangles"):
        model.isolated(boundary, 100_000)


def test_a_mesh_file_is_in_memory_once(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_bytes(stl(1000))
    meshes = "".join(f'<mesh name="m{k}" file="m.stl"/>' for k in range(200))
    (tmp_path / "thing.xml").write_text(f"<mujoco><asset>{meshes}</asset><worldbody><geom/></worldbody></mujoco>")
    boundary = Boundary(tmp_path)
    model = MjcfText.load(boundary, "thing.xml")
    assert model is not None
    assert len(model.isolated(boundary, 10**6).meshes) == 1


def test_names_of_files_are_found_in_time_that_grows_with_their_number(tmp_path: Path) -> None:
    """For each of them, the whole model was once searched for its directories."""
    textures = '<texture name="t" type="2d" file="a.png"/>' * 20_000
    (tmp_path / "thing.xml").write_text(f"<mujoco><asset>{textures}</asset><worldbody><geom/></worldbody></mujoco>")
    model = MjcfText.load(Boundary(tmp_path), "thing.xml")
    assert model is not None
    with soon(3.0):
        assert model.references() == {("texture", "a.png"): "a.png"}


def many_meshes(folder: Path, names: Iterable[str], meshdir: str) -> None:
    """A model that names so many meshes, and a scene with it."""
    meshes = "".join(f'<mesh name="m{k}" file="{name}"/>' for k, name in enumerate(names))
    body = "<worldbody><geom size='1'/></worldbody>"
    (folder / "thing.xml").write_text(f'<mujoco><compiler meshdir="{meshdir}"/><asset>{meshes}</asset>{body}</mujoco>')


def test_a_long_directory_before_the_names_of_many_meshes_is_refused(tmp_path: Path) -> None:
    """Each name was once looked up with it, folder by folder: a model of 1 MB took hours."""
    many_meshes(tmp_path, ["a"] * 1000, "a/" * 2_049)
    with soon(3.0), pytest.raises(MeshError, match="a meshdir of 4,098 characters, expected a path of at most 4,096") as caught:
        MjcfText.load(Boundary(tmp_path), "thing.xml")
    assert caught.value.code == "model_unreadable"
    with soon(3.0):
        (notice,) = MJCF.find(Boundary(tmp_path), ReaderOptions())
    assert isinstance(notice, Notice)
    with soon(3.0), pytest.raises(MeshError, match="a meshdir of 4,098 characters"):
        collect_files(Boundary(tmp_path), "thing.xml")


def test_a_model_in_mjcf_names_a_limited_number_of_files(tmp_path: Path) -> None:
    """Names of one file that differ in case count too: each is looked up by itself."""
    many_meshes(tmp_path, ("".join(letters) for letters in itertools.product(*["aA", "bB"] * 5)), "a/" * 2_000)
    for read in (MjcfText.load, collect_files):
        with soon(3.0), pytest.raises(MeshError, match=rf"names 1,024 files.*\(file\.max_files in {SETTING}\)") as caught:
            read(Boundary(tmp_path), "thing.xml")
        assert caught.value.code == "file_too_large"


def test_the_name_of_a_file_is_looked_up_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "m.stl").write_bytes(stl(1))
    many_meshes(tmp_path, ["m.stl"] * 200, "")
    resolve, asked = Boundary.resolve, list[str]()

    def counted(self: Boundary, reference: str, base: str = "") -> str:
        asked.append(reference)
        return resolve(self, reference, base)

    monkeypatch.setattr(Boundary, "resolve", counted)
    (ref,) = MJCF.find(Boundary(tmp_path), ReaderOptions())
    assert isinstance(ref, SourceRef)
    assert (ref.files, asked) == (("thing.xml", "m.stl"), ["m.stl"])
    model = MjcfText.load(Boundary(tmp_path), "thing.xml")
    assert model is not None
    assert model.isolated(Boundary(tmp_path), 10**6).meshes == {"0.stl": stl(1)}
    assert set(collect_files(Boundary(tmp_path), "thing.xml").contents) == {"thing.xml", "m.stl"}
    assert asked == ["m.stl"] * 3


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ('<replicate count="100"><replicate count="101"><geom/></replicate></replicate>', "model.max_copies"),
        ('<replicate count="9999"><geom/></replicate>' * 60, "model.max_elements"),
        ('<replicate count="9999"><attach model="part"/></replicate>', "model.max_elements"),
    ],
)
def test_copies_are_counted_together_and_those_of_attached_models_too(body: str, named: str, tmp_path: Path) -> None:
    part = f"<mujoco><worldbody><body name='b'>{'<geom/>' * 100}</body></worldbody></mujoco>"
    (tmp_path / "part.xml").write_text(part)
    (tmp_path / "scene.xml").write_text(
        f'<mujoco><asset><model name="part" file="part.xml"/></asset><worldbody>{body}</worldbody></mujoco>'
    )
    with soon(5.0), pytest.raises(MeshError, match=rf"\({named} in {SETTING}\)") as caught:
        collect_files(Boundary(tmp_path), "scene.xml")
    assert caught.value.code == "file_too_large"


def test_a_file_with_many_names_is_in_memory_once_and_its_names_are_counted(tmp_path: Path) -> None:
    """Names may differ in the case of letters alone; each becomes a file of its own for MuJoCo."""
    size = 10**6
    (tmp_path / "meshfile.stl").write_bytes(bytes(size))
    names = ["".join(c.upper() if k >> n & 1 else c for n, c in enumerate("meshfile")) for k in range(100)]

    def collect(**limits: int) -> None:
        files = FileLimits(max_file_bytes=2 * size, **limits)
        contents = collect_files(Boundary(tmp_path, files), "scene.xml").contents
        assert (len(contents), sum(map(len, contents.values())) > 100 * size) == (101, True)

    meshes = "".join(f'<mesh name="m{k}" file="{name}.stl"/>' for k, name in enumerate(names))
    (tmp_path / "scene.xml").write_text(f"<mujoco><asset>{meshes}</asset></mujoco>")
    with little_memory(10 * size):
        collect(max_bytes=101 * size)
    for limits in ({"max_bytes": 100 * size}, {"max_files": 100}):
        with pytest.raises(MeshError, match=r"names of files with .* expected at most") as caught:
            collect(**limits)
        assert caught.value.code == "file_too_large"


def test_a_model_is_walked_once_however_often_it_is_attached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "part.xml").write_text("<mujoco><worldbody><body name='b'><geom/></body></worldbody></mujoco>")
    models = "".join(f'<model name="m{k}" file="part.xml"/>' for k in range(100))
    (tmp_path / "scene.xml").write_text(f"<mujoco><asset>{models}</asset><worldbody/></mujoco>")
    merged = counted(monkeypatch, mjcf_files, "merged_elements", 0)
    assert sorted(collect_files(Boundary(tmp_path), "scene.xml").contents) == ["part.xml", "scene.xml"]
    assert merged == ["scene.xml", "part.xml"]


def test_elements_that_many_models_include_are_counted_before_they_are_merged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit(monkeypatch, "model", max_elements=1_000)
    (tmp_path / "common.xml").write_text(f"<mujocoinclude>{'<option/>' * 100}</mujocoinclude>")
    for k in range(20):
        (tmp_path / f"{k}.xml").write_text('<mujoco><include file="common.xml"/></mujoco>')
    models = "".join(f'<model name="m{k}" file="{k}.xml"/>' for k in range(20))
    (tmp_path / "scene.xml").write_text(f"<mujoco><asset>{models}</asset><worldbody/></mujoco>")
    merged = counted(monkeypatch, mjcf_files, "merged_elements", 0)
    with pytest.raises(MeshError, match=rf"\(model\.max_elements in {SETTING}\)") as caught:
        collect_files(Boundary(tmp_path), "scene.xml")
    assert (caught.value.code, len(merged)) == ("file_too_large", 10)  # the scene, and those of 102 elements before the last


# --- USD ---


def test_a_polygon_of_many_corners_is_cut_soon() -> None:
    """Also one that crosses itself; ears were once sought one by one."""
    angle = np.linspace(0, 40 * np.pi, 5_000)
    out, back = (np.stack([r * np.cos(angle), r * np.sin(angle), 0 * angle], axis=1) for r in (angle + 1.0, angle + 1.5))
    spiral = np.concatenate([out, back[::-1]])
    crossing = np.random.default_rng(0).random((3_000, 3)) * (1, 1, 0)
    for points in (spiral, crossing):
        with soon(5.0):
            triangles, _ = triangulate(points, np.array([len(points)]), np.arange(len(points)))
        assert triangles.shape == (len(points) - 2, 3)
        assert 0 <= triangles.min() <= triangles.max() < len(points)
    triangles, _ = triangulate(spiral, np.array([len(spiral)]), np.arange(len(spiral)))
    a, b, c = spiral[triangles].transpose(1, 0, 2)
    x, y, _ = spiral.T
    signed = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(abs(signed), rel=1e-9)


def test_prims_that_refer_to_each_other_twice_are_counted() -> None:
    sdf = pytest.importorskip("pxr.Sdf")
    levels = "".join(
        f'def "P{k}" {{\ndef "a" (references = </P{k + 1}>) {{}}\ndef "b" (references = </P{k + 1}>) {{}}\n}}\n'
        for k in range(40)
    )
    layer = sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(f'#usda 1.0\n(defaultPrim = "P0")\n{levels}def "P40" {{}}\n')
    with soon(3.0), pytest.raises(MeshError, match=rf"\(model\.max_prims in {SETTING}\)") as caught:
        check_prims(layer, "thing.usda", {})
    assert caught.value.code == "mesh_too_large"


def opened(text: str) -> Any:
    layer = pytest.importorskip("pxr.Sdf").Layer.CreateAnonymous(".usda")
    layer.ImportFromString("#usda 1.0\n" + text)
    return layer


def test_long_paths_of_prims_are_refused() -> None:
    """A name of half a megabyte once was repeated for each of 40,000 prims below it."""
    children = "".join(f'def "a{k}" {{}}\n' for k in range(200))
    check_prims(opened(f'def "{"x" * 1_500}" {{\n{children}}}'), "thing.usda", {})
    alone = opened(f'def "{"x" * 10_000}" {{\n{children}}}')
    nested = "".join(f'class "l{k}" {{\ndef "{"x" * 1_500}" (references = </l{k + 1}>) {{}}\n}}\n' for k in range(3))
    composed = opened(f'{nested}class "l3" {{\n{children}}}\n')
    for layer in (alone, composed):
        with little_memory(400_000), pytest.raises(MeshError, match="characters, expected at most 4,096") as caught:
            check_prims(layer, "thing.usda", {})
        assert caught.value.code == "model_unreadable"


def test_prims_are_counted_no_further_than_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The paths of all were once kept until all were counted."""
    children = "".join(f'def "a{k}" {{}}\n' for k in range(2_000))
    layer = opened(f'def "{"x" * 4_000}" {{\n{children}}}')
    limit(monkeypatch, "model", max_prims=50)
    with little_memory(1_600_000), pytest.raises(MeshError, match=r"^'thing\.usda' composes more prims"):
        check_prims(layer, "thing.usda", {})


def test_the_list_of_a_package_is_not_read_if_it_is_very_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as package:
        for k in range(2001):
            package.writestr(f"{k}.usda", "")
    (tmp_path / "thing.usdz").write_bytes(stream.getvalue())

    def read(*_: object, **__: object) -> zipfile.ZipFile:
        raise AssertionError("the list was read")

    monkeypatch.setattr("stable_data.importers.usd.layers.zipfile.ZipFile", read)
    with pytest.raises(MeshError, match=rf"\(model\.max_members in {SETTING}\)") as caught:
        LayerLoader(Boundary(tmp_path)).place("thing.usdz")
    assert caught.value.code == "model_unreadable"
