"""Every format gives the triangles and the look that its file describes, and no file costs more than itself."""

import base64
import gzip
import io
import json
import struct
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.geometry.mesh import Mesh, signed_volumes
from stable_data.geometry.mesh_colors import to_linear
from stable_data.importers.boundary import Boundary
from stable_data.importers.formats.mesh_file import MeshFile, fan
from stable_data.importers.formats.obj import texture_name
from stable_data.importers.mesh_files import SUFFIXES, files_beside, joined_triangles, read_mesh_file, transformed, z_up
from stable_data.importers.source import Axis
from stable_data.limits import FileLimits
from tests.stable_data.geometry.glb_files import document_of, edited, glb_bytes
from tests.stable_data.importers.mesh_texts import CUBE_STL, SQUARE, dae, png

BOX = Mesh(np.array(trimesh.creation.box((2, 1, 3)).vertices), np.array(trimesh.creation.box((2, 1, 3)).faces))


def read(root: Path, name: str, content: str | bytes | None = None, **options: Any) -> tuple[MeshFile, tuple[Notice, ...]]:
    if content is not None:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return read_mesh_file(
        Boundary(root, options.pop("limits", FileLimits())), name, "thing", **{"max_faces": 10_000, **options}
    )


def code_of(root: Path, name: str, content: str | bytes, **options: Any) -> str:
    with pytest.raises(MeshError) as caught:
        read(root, name, content, **options)
    assert "\n" not in str(caught.value)
    return caught.value.code


def size_of(file: MeshFile) -> list[float]:
    return [round(side, 9) for side in np.ptp(joined_triangles(file.surfaces).reshape(-1, 3), axis=0).tolist()]


# OBJ


def test_obj_has_polygons_materials_and_textures(tmp_path: Path) -> None:
    (tmp_path / "tex").mkdir()
    (tmp_path / "tex" / "a b.png").write_bytes(png())
    (tmp_path / "a.mtl").write_text(
        "newmtl red\nKd 1 0 0\nd 0.25\nnewmtl shown\nKd 0 0 0\nTr 0.25\nmap_Kd -s 1 1 1 tex\\a b.png\n"
    )
    (tmp_path / "b.mtl").write_text("newmtl red\nKd 0 1 0\nnewmtl blue\nKd 0 0 0.5\n")
    text = (
        "mtllib a.mtl\nmtllib b.mtl\n"
        + SQUARE
        + "usemtl shown\nf 1/1 2/2 3/3 4/4\nusemtl red\nf 1//1 2//1 3//1\nusemtl blue\nf 1 2 3\n"
    )
    file, notices = read(tmp_path, "m.obj", text + "usemtl none\nf 1 3 4 # end\n")
    assert not notices
    shown, red, blue, none = file.surfaces
    assert shown.triangles.tolist() == [[[0, 0, 0], [2, 0, 0], [2, 1, 0]], [[0, 0, 0], [2, 1, 0], [0, 1, 0]]]
    assert (shown.colour, shown.opacity, shown.image) == ((1.0, 1.0, 1.0), 0.75, png())
    assert shown.corner_uv is not None
    assert shown.corner_uv[0].tolist() == [[0, 1], [1, 1], [1, 0]]  # from the upper left
    assert (red.colour, red.opacity, red.image, red.corner_uv) == ((1.0, 0.0, 0.0), 0.25, None, None)
    assert blue.colour == pytest.approx((0.0, 0.0, float(to_linear(np.array(0.5)))))
    assert none.colour is None
    assert (file.unit_m, file.up) == (None, "")


def test_obj_counts_negative_indices_from_their_line(tmp_path: Path) -> None:
    near = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n"
    file, _ = read(tmp_path, "m.obj", near + near.replace(" 0\n", " 5\n").replace("f -3 -2 -1", "f -3 -2 -1 -6"))
    assert [t[:, 2].tolist() for t in file.surfaces[0].triangles] == [[0, 0, 0], [5, 5, 5], [5, 5, 0]]


def test_obj_has_colours_of_vertices_and_continued_lines(tmp_path: Path) -> None:
    file, _ = read(tmp_path, "m.obj", "v 0 0 0 255 0 0\nv 1 0 0 \\\n 0 255 0\r\nv\t0 1 0 0 0 128\nf 1 2 3\n")
    colours = file.surfaces[0].corner_colours
    assert colours is not None
    np.testing.assert_allclose(colours[0], np.diag((1, 1, float(to_linear(np.array(128 / 255))))))


def test_long_obj_equals_that_of_trimesh(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=6)  # more lines than are converted at once
    file, _ = read(tmp_path, "m.obj", ball.export(file_type="obj", digits=12), max_faces=10**6)
    np.testing.assert_allclose(file.surfaces[0].triangles, ball.triangles, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("a.png", "a.png"),
        ("-s 1 2 3 -o 0.5 a b.png", "a b.png"),
        ("-clamp on a.png", "a.png"),
        ("-bm 1.0 -imfchan r x/y.png", "x/y.png"),
        ('"c d.png"', "c d.png"),
        ("-mm 0 1 1.png", "1.png"),
    ],
)
def test_options_of_textures_are_no_names(text: str, name: str) -> None:
    assert texture_name(text) == name


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("v 0 0 0\n", "mesh_empty"),
        ("", "mesh_empty"),
        ("v 0 0 0\nf 1 1 1\n", "mesh_empty"),
        ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mesh_not_finite"),
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mesh_not_finite"),
        ("v inf 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mesh_not_finite"),
        ("v 1e200 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mesh_not_finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "model_unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "model_unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -9\n", "model_unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf a b c\n", "model_unreadable"),
        ("v 0 x 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "model_unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n", "model_unreadable"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 11, "mesh_too_large"),
    ],
)
def test_bad_obj_is_refused(tmp_path: Path, text: str, code: str) -> None:
    assert code_of(tmp_path, "m.obj", text, max_faces=10) == code


# Textures


@pytest.mark.parametrize(
    ("reference", "code"),
    [
        ("../../secret.png", "texture_outside"),
        ("/etc/passwd", "texture_outside"),
        ("C:\\art\\a.png", "texture_outside"),
        ("https://example.org/a.png", "texture_outside"),
        ("none.png", "texture_missing"),
        ("large.png", "texture_too_large"),
    ],
)
@pytest.mark.parametrize("suffix", [".obj", ".dae", ".gltf", ".ply"])
def test_a_bad_texture_costs_the_texture_alone(tmp_path: Path, suffix: str, reference: str, code: str) -> None:
    root = tmp_path / "in"
    root.mkdir()
    (tmp_path / "secret.png").write_bytes(png())
    (root / "large.png").write_bytes(bytes(20_000))
    (root / "m.mtl").write_text(f"newmtl m\nmap_Kd {reference}\n")
    content = {
        ".obj": "mtllib m.mtl\n" + SQUARE + "usemtl m\nf 1/1 2/2 3/3 4/4\n",
        ".dae": dae(image=reference),
        ".gltf": gltf_text(root, images=[{"uri": reference}]),
        ".ply": ply_text(reference),
    }[suffix]
    file, notices = read(root, f"m{suffix}", content, limits=FileLimits(max_file_bytes=10_000))
    assert [(notice.item_id, notice.code) for notice in notices] == [("thing", code)]
    assert all(surface.image is None and surface.corner_uv is None for surface in file.surfaces)


def test_files_of_textures_are_passed_on_and_never_decoded(tmp_path: Path) -> None:
    bomb = b"\x89PNG\r\n\x1a\n" + bytes(50)  # no decoder would take it
    (tmp_path / "t.png").write_bytes(bomb)
    (tmp_path / "m.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    contents = {
        "m.obj": "mtllib m.mtl\n" + SQUARE + "usemtl m\nf 1/1 2/2 3/3 4/4\n",
        "m.dae": dae(image="t.png"),
        "m.gltf": gltf_text(tmp_path, images=[{"uri": "t.png"}]),
        "m.ply": ply_text("t.png"),
    }
    for name, content in contents.items():
        file, notices = read(tmp_path, name, content)
        assert (file.surfaces[0].image, notices) == (bomb, ()), name
        uv = file.surfaces[0].corner_uv
        assert uv is not None
        assert uv.shape == (*file.surfaces[0].triangles.shape[:2], 2)


def test_texture_coordinates_lie_where_the_picture_does(tmp_path: Path) -> None:
    """In every format the corner (0, 0, 0) is the lower left of the picture and (2, 1, 0) the upper right."""
    (tmp_path / "t.png").write_bytes(png())
    (tmp_path / "m.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    read(tmp_path, "m.obj", "mtllib m.mtl\n" + SQUARE + "usemtl m\nf 1/1 2/2 3/3 4/4\n")
    read(tmp_path, "m.dae", dae(image="t.png"))
    read(tmp_path, "m.ply", ply_text("t.png"))
    for name in ("m.obj", "m.dae", "m.ply"):
        surface = read(tmp_path, name)[0].surfaces[0]
        assert surface.corner_uv is not None
        for corner, uv in zip(surface.triangles.reshape(-1, 3), surface.corner_uv.reshape(-1, 2), strict=True):
            np.testing.assert_allclose(uv, (corner[0] / 2, 1 - corner[1]))


def test_missing_materials_are_noted_once(tmp_path: Path) -> None:
    _, notices = read(tmp_path, "m.obj", "mtllib none.mtl\nmtllib none.mtl\n" + SQUARE + "f 1 2 3\n")
    assert [notice.code for notice in notices] == ["material_missing"]


# COLLADA


def test_dae_has_unit_axis_transforms_and_looks(tmp_path: Path) -> None:
    asset = '<contributor><author>Ann</author><copyright>CC BY 4.0</copyright></contributor><unit meter="0.01"/><up_axis>Y_UP</up_axis>'
    moved = (
        '<node id="a"><translate>0 0 5</translate><node id="b" name="turned"><matrix>2 0 0 0 0 0 1 0 0 1 0 0 0 0 0 1</matrix>'
        + ('<instance_geometry url="#g"/></node></node>')
    )
    file, _ = read(tmp_path, "m.DAE", dae(asset=asset, nodes=moved))
    assert (file.unit_m, file.up, file.author, file.copyright) == (0.01, "y", "Ann", "CC BY 4.0")
    assert size_of(file) == [4.0, 0.0, 1.0]
    assert joined_triangles(file.surfaces)[..., 2].min() == 5
    # y and z change places: a mirrored surface still faces the same way.
    normals = np.cross(*np.diff(joined_triangles(file.surfaces), axis=1).swapaxes(0, 1))
    assert (normals[:, 1] > 0).all()
    assert file.names == (frozenset({"turned", "b", "form", "g"}),)
    plain, _ = read(tmp_path, "p.dae", dae())
    assert (plain.unit_m, plain.up, plain.surfaces[0].colour) == (None, "", (1.0, 0.0, 0.0))


@pytest.mark.parametrize("mode", ["A_ONE", "RGB_ZERO"])
def test_dae_transparency_may_be_written_the_wrong_way_round(tmp_path: Path, mode: str) -> None:
    def opacity(colour: str, share: str) -> float:
        look = f'<transparent opaque="{mode}"><color>{colour}</color></transparent><transparency><float>{share}</float></transparency>'
        text = dae().replace("</diffuse>", "</diffuse>" + look)
        return read(tmp_path, "m.dae", text)[0].surfaces[0].opacity

    assert opacity("1 1 1 1", "0.5") == pytest.approx(0.5)
    assert opacity("0 0 0 0", "0") == 1.0  # not seen at all would be no asset
    assert opacity("1 1 1 0", "1") == 1.0


def test_a_broken_material_costs_the_look_alone(tmp_path: Path) -> None:
    broken = dae(image="t.png").replace("<init_from>i</init_from>", "<init_from>none</init_from>")
    file, notices = read(tmp_path, "m.dae", broken)
    assert [notice.code for notice in notices] == ["material_invalid"]
    assert size_of(file) == [2, 1, 0]


DOUBLING = "".join(
    f'<node id="n{k}"><instance_node url="#n{k - 1}"/><instance_node url="#n{k - 1}"/></node>'
    if k
    else '<node id="n0"><instance_geometry url="#g"/></node>'
    for k in range(30)
)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (dae(index="0 0 1 1 2 2 9 3"), "model_unreadable"),
        (dae(index="0 0 1 1 2 2 -1 3"), "model_unreadable"),
        (dae(positions="nan 0 0 2 0 0 2 1 0 0 1 0"), "mesh_not_finite"),
        (dae(nodes='<node id="x"/>'), "mesh_empty"),
        (dae(nodes='<node id="x"><instance_node url="#x"/></node>'), "model_unreadable"),
        (
            dae(library=f"<library_nodes>{DOUBLING}</library_nodes>", nodes='<node><instance_node url="#n29"/></node>'),
            "mesh_too_large",
        ),
        ("<COLLADA>", "model_unreadable"),
        ("no xml", "model_unreadable"),
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><COLLADA>&b;</COLLADA>', "model_unreadable"),
        ("<a>" * 100 + "</a>" * 100, "model_unreadable"),
    ],
)
def test_bad_dae_is_refused(tmp_path: Path, text: str, code: str) -> None:
    assert code_of(tmp_path, "m.dae", text) == code


def test_dae_without_its_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "collada", None)
    with pytest.raises(ConfigError, match="pip install"):
        read(tmp_path, "m.dae", dae())


# glTF


def gltf_text(root: Path, *, images: list[dict[str, Any]] | None = None, uri: str = "m.bin") -> str:
    """A box as glTF with its buffer beside it; with images, with texture coordinates and a material."""
    document, binary = document_of(glb_bytes(BOX))
    if images is not None:
        uv = np.zeros((len(BOX.vertices), 2), "<f4").tobytes()
        document["accessors"].append({"bufferView": 2, "componentType": 5126, "count": len(BOX.vertices), "type": "VEC2"})
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(uv)})
        binary += uv
        document["images"], document["textures"] = images, [{"source": 0}]
        document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        document["meshes"][0]["primitives"][0] |= {"material": 0}
        document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
    document["buffers"] = [{"byteLength": len(binary), "uri": uri}]
    if not uri.startswith("data:"):
        (root / "m.bin").write_bytes(binary)
    return json.dumps(document)


def test_gltf_with_files_beside_equals_its_glb(tmp_path: Path) -> None:
    alone, _ = read(tmp_path, "a.glb", glb_bytes(BOX))
    beside, _ = read(tmp_path, "b.gltf", gltf_text(tmp_path))
    address = "data:application/octet-stream;base64," + base64.b64encode((tmp_path / "m.bin").read_bytes()).decode()
    inside, _ = read(tmp_path, "c.gltf", gltf_text(tmp_path, uri=address))
    for file in (alone, beside, inside):
        np.testing.assert_array_equal(file.surfaces[0].triangles, alone.surfaces[0].triangles)
        assert (file.up, file.unit_m) == ("y", None)
    turned = transformed(alone.surfaces, z_up("y"))
    np.testing.assert_allclose(np.ptp(joined_triangles(turned).reshape(-1, 3), axis=0), BOX.extents)
    assert signed_volumes(joined_triangles(turned)).sum() == pytest.approx(6)


def test_gltf_of_several_buffers_and_images_is_one(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(png())
    address = "data:image/png;base64," + base64.b64encode(png()).decode()
    document = json.loads(gltf_text(tmp_path, images=[{"uri": address}]))
    binary = (tmp_path / "m.bin").read_bytes()
    first = document["bufferViews"][0]["byteLength"]
    (tmp_path / "1.bin").write_bytes(binary[:first])
    (tmp_path / "2.bin").write_bytes(binary[first:])
    document["buffers"] = [{"byteLength": first, "uri": "1.bin"}, {"byteLength": len(binary) - first, "uri": "2.bin"}]
    for view in document["bufferViews"][1:]:
        view |= {"buffer": 1, "byteOffset": view["byteOffset"] - first}
    file, notices = read(tmp_path, "m.gltf", json.dumps(document))
    assert not notices
    assert file.surfaces[0].image == png()
    assert sorted(size_of(file)) == sorted(BOX.extents.tolist())


def test_gltf_states_licence_and_author(tmp_path: Path) -> None:
    extras = {"license": "CC-BY-4.0 (http://creativecommons.org/licenses/by/4.0/)", "author": "Ann"}
    document = json.loads(gltf_text(tmp_path)) | {"asset": {"version": "2.0", "copyright": "2020 Ann", "extras": extras}}
    file, _ = read(tmp_path, "m.gltf", json.dumps(document))
    assert (file.licence, file.copyright, file.author) == (extras["license"], "2020 Ann", "Ann")


@pytest.mark.parametrize(
    ("edit", "code"),
    [
        (lambda d: d["nodes"].__setitem__(0, {"mesh": 0, "children": [0]}), "cyclic_reference"),
        (lambda d: d.update(nodes=[{"children": [1]}, {"children": [2]}, {"mesh": 0, "children": [0]}]), "cyclic_reference"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=0), "mesh_empty"),
        (lambda d: d.update(scenes=[{"nodes": []}]), "mesh_empty"),
        (lambda d: d["bufferViews"][0].update(byteLength=10**9), "model_unreadable"),
        (lambda d: d["bufferViews"][0].update(buffer=3), "model_unreadable"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "model_unreadable"),
        (lambda d: d["accessors"][0].update(count=10**9), "mesh_too_large"),
        (lambda d: d["meshes"][0]["primitives"][0].update(indices=1), "glb_invalid"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "glb_unsupported"),
        (lambda d: d.update(nodes=3), "model_unreadable"),
        (lambda d: d["buffers"][0].update(uri="../out.bin"), "path_outside"),
        (lambda d: d["buffers"][0].update(uri="none.bin"), "include_missing"),
        (lambda d: d["buffers"][0].update(uri="http://example.org/m.bin"), "path_outside"),
        (lambda d: d["buffers"][0].update(uri="data:;base64,!"), "model_unreadable"),
    ],
)
def test_bad_gltf_is_refused(tmp_path: Path, edit: Any, code: str) -> None:
    root = tmp_path / "in"
    root.mkdir()
    (tmp_path / "out.bin").write_bytes(bytes(10_000))
    document = json.loads(gltf_text(root))
    edit(document)
    assert code_of(root, "m.gltf", json.dumps(document)) == code


def test_bad_glb_is_refused(tmp_path: Path) -> None:
    good = glb_bytes(BOX)
    assert code_of(tmp_path, "a.glb", good[:40]) == "model_unreadable"
    assert code_of(tmp_path, "a.glb", b"") == "model_unreadable"
    assert code_of(tmp_path, "a.gltf", "[" * 5000) == "model_unreadable"
    assert (
        code_of(tmp_path, "a.glb", edited(good, lambda d: d["bufferViews"][0].update(byteLength=10**6))) == "model_unreadable"
    )
    corners = np.array(BOX.vertices)
    corners[0, 0] = np.nan
    assert code_of(tmp_path, "a.glb", glb_bytes(Mesh(corners, BOX.faces))) == "mesh_not_finite"
    assert code_of(tmp_path, "a.glb", good, max_faces=11) == "mesh_too_large"
    assert code_of(tmp_path, "a.gltf", gltf_text(tmp_path), limits=FileLimits(max_bytes=700)) in (
        "file_too_large",
        "mesh_too_large",
    )


# STL and PLY


def test_stl_is_read_in_both_forms(tmp_path: Path) -> None:
    text, _ = read(tmp_path, "a.stl", CUBE_STL)
    faces = text.surfaces[0].triangles.astype("<f4")
    record = b"".join(bytes(12) + face.tobytes() + bytes(2) for face in faces)
    binary, _ = read(tmp_path, "b.STL", b"solid but binary".ljust(80) + struct.pack("<I", 12) + record)
    for file in (text, binary):
        assert size_of(file) == [1, 1, 1]
        assert signed_volumes(joined_triangles(file.surfaces)).sum() == pytest.approx(1)
    assert code_of(tmp_path, "c.stl", bytes(80) + struct.pack("<I", 10**9) + record) == "model_unreadable"
    assert code_of(tmp_path, "c.stl", bytes(84)) == "mesh_empty"
    assert code_of(tmp_path, "c.stl", CUBE_STL.replace("vertex 1 1 1", "vertex nan 1 1")) == "mesh_not_finite"
    assert code_of(tmp_path, "c.stl", CUBE_STL, max_faces=11) == "mesh_too_large"
    assert code_of(tmp_path, "c.stl", "") == "model_unreadable"


def ply_text(texture: str = "", faces: str = "4 0 1 2 3\n3 0 1 2\n") -> str:
    """A square of 2 × 1 and a triangle on it."""
    comment = f"comment TextureFile {texture}\n" if texture else ""
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "s", "t"))
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    corners = "0 0 0 0 0 255 0 0\n2 0 0 1 0 255 0 0\n2 1 0 1 1 255 0 0\n0 1 0 0 1 255 0 0\n"
    head = f"ply\nformat ascii 1.0\n{comment}element vertex 4\n{names}{colours}element face 2\nproperty list uchar int vertex_indices\n"
    return f"{head}end_header\n{corners}{faces}"


def test_ply_has_polygons_and_colours(tmp_path: Path) -> None:
    file, _ = read(tmp_path, "m.ply", ply_text())
    surface = file.surfaces[0]
    assert (len(surface.triangles), size_of(file)) == (3, [2, 1, 0])
    assert surface.corner_colours is not None
    assert (surface.corner_colours == (1, 0, 0)).all()
    of_faces = trimesh.creation.box()
    of_faces.visual.face_colors = [[0, 0, 255, 255]] * 12
    file, _ = read(tmp_path, "b.ply", of_faces.export(file_type="ply"))
    assert (np.asarray(file.surfaces[0].corner_colours) == (0, 0, 1)).all()


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (ply_text(faces="3 0 1 9\n3 0 1 2\n"), "model_unreadable"),
        (ply_text(faces="3 0 1 -1\n3 0 1 2\n"), "model_unreadable"),
        (ply_text().replace("0 0 0 0 0", "nan 0 0 0 0"), "mesh_not_finite"),
        (ply_text().replace("element face 2", "element face 0"), "mesh_empty"),
        (ply_text().replace("end_header", ""), "model_unreadable"),
        (ply_text().replace("0 0 0 0 0", "a b c d e"), "model_unreadable"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nend_header\n", "model_unreadable"),
        ("", "model_unreadable"),
    ],
)
def test_bad_ply_is_refused(tmp_path: Path, content: str, code: str) -> None:
    assert code_of(tmp_path, "m.ply", content) == code


# All formats


def test_compressed_files_are_refused(tmp_path: Path) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("m.dae", dae())
    for content in (gzip.compress(bytes(1000)), packed.getvalue(), b"7z\xbc\xaf\x27\x1c"):
        for suffix in SUFFIXES:
            with pytest.raises(MeshError, match="unpack it"):
                read(tmp_path, f"m{suffix}", content)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    assert code_of(tmp_path, "m.blend", "") == "model_unreadable"
    assert code_of(tmp_path, "m", "") == "model_unreadable"
    with pytest.raises(MeshError) as caught:
        read(tmp_path, "none.obj")
    assert caught.value.code == "file_missing"


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(data=st.data())
def test_random_damage_is_a_clear_error_or_a_mesh(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, data: st.DataObject
) -> None:
    root = tmp_path_factory.mktemp("damage")
    (root / "m.bin").write_bytes(document_of(glb_bytes(BOX))[1])
    good = {
        ".glb": glb_bytes(BOX),
        ".gltf": gltf_text(root).encode(),
        ".obj": (SQUARE + "f 1/1 2/2 3/3 4/4\n").encode(),
        ".dae": dae().encode(),
        ".ply": ply_text().encode(),
        ".stl": CUBE_STL.encode(),
    }[suffix]
    content = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    content = content[: data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))]
    with suppress(MeshError):
        file, _ = read(root, f"m{suffix}", bytes(content))
        assert np.isfinite(joined_triangles(file.surfaces)).all()


def test_files_that_a_mesh_names_are_found_without_parsing_it(tmp_path: Path) -> None:
    for name in ("t.png", "u.png", "m.mtl", "m.bin"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "m.mtl").write_text("newmtl m\nmap_Kd -s 1 1 1 t.png\nmap_kd u.png\nmap_Kd ../x.png\n")
    (tmp_path / "a.obj").write_text("mtllib m.mtl\nv broken")
    (tmp_path / "a.gltf").write_text('{"buffers": [{"uri" : "m.bin"}, {"uri": "data:x"}], "images": [{"uri": "t.png"}]} broken')
    (tmp_path / "a.dae").write_text("<init_from> t.png </init_from><init_from><ref>u.png</ref>")
    (tmp_path / "a.ply").write_text("ply\ncomment TextureFile t.png\n")
    (tmp_path / "a.stl").write_text("")
    root = Boundary(tmp_path)
    found = {suffix: files_beside(root, f"a.{suffix}") for suffix in ("obj", "gltf", "dae", "ply", "stl")}
    assert found == {
        "obj": ("m.mtl", "t.png", "u.png"),
        "gltf": ("m.bin", "t.png"),
        "dae": ("t.png", "u.png"),
        "ply": ("t.png",),
        "stl": (),
    }
    assert not root.opened
    (tmp_path / "long.mtl").write_bytes(b"map_Kd " + b"-1 " * 100_000 + b"\n" + b" " * 10**6 + b"\nmap_Kd" + b"\t" * 10**6)
    (tmp_path / "long.obj").write_text("mtllib long.mtl\n" + " " * 10**6)
    assert files_beside(root, "long.obj") == ("long.mtl",)


@given(st.lists(st.integers(0, 7), max_size=20))
def test_fans_use_every_corner_of_every_polygon(counts: list[int]) -> None:
    rows = fan(np.array(counts, np.int64))
    expected, start = [], 0
    for count in counts:
        expected += [[start, start + k + 1, start + k + 2] for k in range(count - 2)]
        start += count
    assert rows.tolist() == expected


@pytest.mark.parametrize("axis", ["x", "y", "z", "-x", "-y", "-z"])
def test_any_axis_is_turned_upward(axis: Axis) -> None:
    matrix = z_up(axis)[:3, :3]
    up = np.zeros(3)
    up["xyz".index(axis[-1])] = -1 if axis.startswith("-") else 1
    assert (matrix @ up).tolist() == [0, 0, 1]
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3))
