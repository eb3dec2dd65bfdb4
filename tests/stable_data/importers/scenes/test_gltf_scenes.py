"""glTF scenes: which nodes are free bodies, where they are and how they are shaped, whatever the tree of nodes looks like."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError, StableDataError
from stable_data.export import glb
from stable_data.geometry.mesh import Mesh, signed_volumes
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.file_physics import watch_shapes
from stable_data.importers.scenes.formats import is_scene_candidate
from stable_data.importers.scenes.gltf_nodes import is_free, is_left_out, name_suffix
from stable_data.importers.scenes.gltf_scenes import GltfScene, read_gltf_scene
from stable_data.importers.scenes.lint import scene_candidates
from stable_data.importers.scenes.scene_file import SceneBody
from stable_data.importers.scenes.supports import find_supports
from stable_data.rotations import rotation_matrix
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.scene_files import basin, cuboid, gltf_parts, kitchen, sheet, solid, write_gltf
from tests.stable_data.export.runs import at_rest, write_run

CUBE, TOP = cuboid(0.1, 0.1, 0.1), sheet((-0.5, 0, -0.3), (-0.5, 0, 0.3), (0.5, 0, 0.3), (0.5, 0, -0.3))
FREE = {"name": "cube-rigid", "mesh": 0, "translation": [0, 0.05, 0]}
FLOOR = {"name": "floor", "mesh": 1}


def read(folder: Path, nodes: list[dict[str, Any]], *meshes: Any, **entries: Any) -> GltfScene:
    """A scene of these nodes below a root; mesh 0 is a cube of 10 cm, mesh 1 a level sheet, others follow."""
    root = {"children": list(range(1, len(nodes) + 1))} if "children" not in nodes[0] else {}
    document, content = gltf_parts([CUBE, TOP, *meshes], [root, *nodes] if root else nodes, **entries)
    write_gltf(folder / "a.glb", document, content)
    return read_gltf_scene(Boundary(folder), "a.glb")


def bodies_of(scene: GltfScene) -> dict[str, SceneBody]:
    return {body.name: body for body in scene.file.bodies}


def box_of(body: SceneBody) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    points = np.concatenate([body.placed(part) for part in body.parts])
    return points.min(axis=0), points.max(axis=0)


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_bodies_are_read_in_metres_and_z_up_whatever_is_above_them(tmp_path: Path, suffix: str) -> None:
    write_gltf(tmp_path / f"a{suffix}", *kitchen())
    scene = read_gltf_scene(Boundary(tmp_path), f"a{suffix}")
    bodies = bodies_of(scene)
    free = ["box_a-rigid", "box_b-rigid.001", "floating_RIGID", "fine-rigid", "bottle"]
    assert [name for name, body in bodies.items() if body.is_free] == free
    assert [name for name, body in bodies.items() if not body.is_free] == ["floor", "table", "shelf"]
    world = Rotation.from_euler("z", 40, degrees=True)
    expected = {"box_a-rigid": (-0.2, -0.01, 0.76), "floating_RIGID": (0.1, -0.12, 0.9), "bottle": (0.05, 0.15, 0.75)}
    for name, place in expected.items():
        np.testing.assert_allclose(bodies[name].position, world.apply(place) + np.array([2, -1, 0]), atol=1e-9)
    turn = Rotation.from_quat(bodies["floating_RIGID"].quat_xyzw) * world.inv()
    np.testing.assert_allclose(turn.as_rotvec(degrees=True), (0, 0, 30), atol=1e-6)
    np.testing.assert_allclose(np.ptp(bodies["box_b-rigid.001"].parts[0].vertices, axis=0), (0.08, 0.06, 0.08), atol=1e-6)
    assert bodies["bottle"].mass == pytest.approx(0.3)
    assert bodies["bottle"].center_of_mass == pytest.approx((0, 0, -0.02), abs=1e-9)
    (surface,) = find_supports(scene.file)
    assert (surface.owner, len(surface.names)) == ("table", 5)
    assert surface.size_xy == pytest.approx((1.0, 0.6), abs=1e-3)
    assert surface.origin[2] == pytest.approx(0.72, abs=1e-6)
    assert scene.paths == (("a.bin", "a.gltf") if suffix == ".gltf" else ("a.glb",))
    assert scene.file.notices == ()


@pytest.mark.parametrize(
    ("name", "suffix"),
    [
        ("cup-rigid", "rigid"),
        ("Cup_RIGID", "rigid"),
        ("cup$rigid", "rigid"),
        ("cup-rigid.012", "rigid"),
        ("cup-rigid_2", "rigid"),
        ("rigid", ""),
        ("cup-rigid-old", ""),
        ("frigid", ""),
        ("wall-col", "col"),
        ("wall-convcolonly", "convcolonly"),
        ("sun-noimp", "noimp"),
        (None, ""),
    ],
)
def test_suffixes_of_names(name: str | None, suffix: str) -> None:
    assert name_suffix({"name": name}) == suffix
    assert is_free({"name": name}) == (suffix == "rigid")
    assert is_left_out({"name": name}) == (suffix == "noimp")


def test_the_extension_wins_over_the_name() -> None:
    def node(**motion: object) -> dict[str, Any]:
        return {"name": "a-rigid", "extensions": {"KHR_physics_rigid_bodies": {"motion": motion}}}

    assert is_free(node(mass=1.0))
    assert not is_free(node(isKinematic=True))
    assert not is_free(node(mass=0)), "an infinite mass"
    assert is_free({"extras": {"category": "mug", "asset_id": None}})
    assert not is_free({"extras": {"category": "mug", "asset_id": None, "fixed": True}})


def test_a_body_has_all_below_it_but_other_bodies(tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [
        {"children": [1, 5]},
        {"name": "tray-rigid", "mesh": 0, "children": [2, 3], "translation": [0, 0.05, 0]},
        {"name": "handle", "mesh": 0, "translation": [0.1, 0, 0]},
        {"name": "cup-rigid", "mesh": 0, "translation": [0, 0.1, 0], "children": [4]},
        {"name": "helper-noimp", "mesh": 0, "translation": [9, 9, 9]},
        FLOOR,
    ]
    bodies = bodies_of(read(tmp_path, nodes))
    assert list(bodies) == ["tray-rigid", "cup-rigid", "floor"]
    np.testing.assert_allclose(box_of(bodies["tray-rigid"]), [(-0.05, -0.05, 0), (0.15, 0.05, 0.1)], atol=1e-6)
    np.testing.assert_allclose(box_of(bodies["cup-rigid"]), [(-0.05, -0.05, 0.1), (0.05, 0.05, 0.2)], atol=1e-6)


def test_uneven_scales_and_mirrors_become_part_of_the_shape(tmp_path: Path) -> None:
    wedge = {"name": "wedge-rigid", "mesh": 2, "translation": [0, 0.3, 0], "scale": [-1, 2, 0.5]}
    shape = solid((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1))
    sheared = {"name": "above", "scale": [2, 1, 1], "children": [2]}
    turned = Rotation.from_euler("y", 45, degrees=True).as_quat().tolist()
    nodes: list[dict[str, Any]] = [
        {"children": [1, 3, 4]},
        sheared,
        {"name": "cube-rigid", "mesh": 0, "rotation": turned},
        wedge,
        FLOOR,
    ]
    bodies = bodies_of(read(tmp_path, nodes, shape))
    np.testing.assert_allclose(box_of(bodies["wedge-rigid"]), [(-0.1, -0.05, 0.3), (0, 0, 0.5)], atol=1e-6)
    diagonal = 0.05 * np.sqrt(2)
    np.testing.assert_allclose(box_of(bodies["cube-rigid"])[1], (2 * diagonal, diagonal, 0.05), atol=1e-6)
    for body in bodies.values():
        assert all(signed_volumes(part.triangles).sum() > 0 for part in body.parts), "faces point outwards"
        assert np.linalg.det(rotation_matrix(body.quat_xyzw)) == pytest.approx(1)


def test_hollow_things_stay_hollow_whether_they_move_or_not(tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [
        {"name": "bin-rigid", "mesh": 2, "translation": [0, 0.1, 0]},
        {"name": "sink", "mesh": 2, "translation": [0.25, 0.1, 0]},
        FLOOR,
    ]
    bodies = bodies_of(read(tmp_path, nodes, basin(0.2, 0.02)))
    for name, x in (("bin-rigid", 0.0), ("sink", 0.25)):
        body = bodies[name]
        assert len(body.parts) > 4
        inside = np.array([[x, 0, 0.1], [x + 0.05, 0.05, 0.15]])
        for part in body.parts:
            triangles = body.placed(part)[part.faces]
            normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
            heights = ((inside[:, None] - triangles[None, :, 0]) * normals).sum(axis=2)
            assert (heights.max(axis=1) > 0).all(), "a point of the hollow lies in no part"


def test_a_room_is_its_floor_and_walls_and_what_is_far_away_is_its_hull(tmp_path: Path) -> None:
    room = cuboid(4, 3, 4)
    meshes = (Mesh(room.vertices, room.faces[:, ::-1]), basin(0.2, 0.02))
    nodes: list[dict[str, Any]] = [
        {"name": "room", "mesh": 2, "translation": [1, 1.5, 0]},
        {"name": "near", "mesh": 3, "translation": [0.4, 0.1, 0]},
        {"name": "far", "mesh": 3, "translation": [2.5, 0.1, 0]},
        FREE,
    ]
    scene = read(tmp_path, nodes, *meshes)
    bodies = bodies_of(scene)
    assert [len(bodies[name].parts) for name in ("room", "far")] == [6, 1]
    assert len(bodies["near"].parts) > 4
    (surface,) = find_supports(scene.file)
    assert (surface.owner, surface.names) == ("room", ("cube-rigid",))
    assert surface.size_xy == pytest.approx((4, 4), abs=1e-3)
    assert surface.origin[2] == pytest.approx(0, abs=1e-6)
    assert all(motion.is_at_rest for motion in watch_shapes(scene.file, {}).values())


def test_colliders_that_are_stated_count_alone(tmp_path: Path) -> None:
    def collider(**geometry: object) -> dict[str, Any]:
        return {"extensions": {"KHR_physics_rigid_bodies": {"collider": {"geometry": geometry}}}}

    shapes: list[dict[str, Any]] = [
        {"type": "box", "box": {"size": [0.2, 0.1, 0.3]}},
        {"type": "sphere", "sphere": {"radius": 0.1}},
        {"type": "cylinder", "cylinder": {"height": 0.2, "radiusTop": 0.05, "radiusBottom": 0.1}},
        {"type": "capsule", "capsule": {"height": 0.2, "radiusTop": 0.05, "radiusBottom": 0.05}},
        {"type": "plane", "plane": {}},
        {"type": "plane", "plane": {"sizeX": 1.0, "sizeZ": 0.5}},
        {"type": "torus"},
    ]
    nodes: list[dict[str, Any]] = [
        {"children": [*range(1, 8), 9, 11, 13]},
        *({"name": f"{shapes[k]['type']}-rigid", "mesh": 0, "translation": [k, 1, 0], **collider(shape=k)} for k in range(4)),
        {"name": "ground", "mesh": 1, "translation": [0, -0.5, 0], **collider(shape=4)},
        {"name": "board", "translation": [0, 0.5, 0], **collider(shape=5)},
        {"name": "hull-rigid", "mesh": 2, "children": [8], "translation": [0, 2, 0]},
        {"name": "of it-convcolonly", "mesh": 0},
        {"name": "by node-rigid", "mesh": 0, "translation": [2, 2, 0], **collider(node=10, convexHull=True)},
        {"name": "apart", "mesh": 0, "scale": [2, 1, 1], "translation": [50, 0, 0]},
        {"name": "cupboard", "mesh": 2, "translation": [4, 0, 0], "children": [12]},
        {"name": "shape-colonly", "mesh": 0},
        {"name": "torus-rigid", "mesh": 0, "translation": [6, 1, 0], **collider(shape=6)},
    ]
    scene = read(tmp_path, nodes, basin(0.4, 0.02), extensions={"KHR_implicit_shapes": {"shapes": shapes}})
    bodies = bodies_of(scene)
    extents = {name: np.ptp(box_of(body), axis=0) for name, body in bodies.items()}
    np.testing.assert_allclose(extents["box-rigid"], (0.2, 0.3, 0.1), atol=1e-9)
    np.testing.assert_allclose(extents["sphere-rigid"], (0.2, 0.2, 0.2), atol=1e-9)
    np.testing.assert_allclose(extents["cylinder-rigid"], (0.2, 0.2, 0.2), atol=1e-9)
    np.testing.assert_allclose(extents["capsule-rigid"], (0.1, 0.1, 0.3), atol=1e-9)
    top = bodies["cylinder-rigid"].parts[0].vertices
    assert np.ptp(top[top[:, 2] > 0.09], axis=0)[0] == pytest.approx(0.1), "the narrow end is up"
    np.testing.assert_allclose(extents["hull-rigid"], (0.1, 0.1, 0.1), atol=1e-6)
    np.testing.assert_allclose(extents["by node-rigid"], (0.1, 0.1, 0.1), atol=1e-6)
    np.testing.assert_allclose(extents["torus-rigid"], (0.1, 0.1, 0.1), atol=1e-6)
    assert box_of(bodies["board"])[1] == pytest.approx((0.5, 0.25, 0.5))
    assert "shape-colonly" in bodies
    assert "cupboard" not in bodies, "it is only seen"
    assert [(ground.owner, ground.height) for ground in scene.file.grounds] == [("ground", -0.5)]
    assert [notice.code for notice in scene.file.notices] == ["shape_unknown"]


def test_what_is_animated_or_held_counts_as_fixed_and_what_is_bent_is_no_obstacle(tmp_path: Path) -> None:
    physics = {"KHR_physics_rigid_bodies": {"joint": {"connectedNode": 3, "joint": 0}}}
    nodes: list[dict[str, Any]] = [
        {"children": [1, 3, 4, 5, 6, 7, 8]},
        {"name": "arm-rigid", "mesh": 0, "children": [2], "translation": [0.3, 0.05, 0]},
        {"name": "pin", "extensions": physics},
        {"name": "lid-rigid", "mesh": 0, "translation": [-0.3, 0.05, 0]},
        {"name": "fan-rigid", "mesh": 0, "translation": [0, 0.05, 0.2]},
        FREE,
        {"name": "person", "mesh": 0, "skin": 0},
        {"name": "leaves", "mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}},
        FLOOR,
    ]
    channel = {"sampler": 0, "target": {"node": 4, "path": "rotation"}}
    scene = read(tmp_path, nodes, animations=[{"channels": [channel], "samplers": []}], skins=[{"joints": [2]}])
    assert [body.name for body in scene.file.bodies if body.is_free] == ["cube-rigid"]
    assert {b.name for b in scene.file.bodies if not b.is_free} == {"arm-rigid", "lid-rigid", "fan-rigid", "floor"}
    said = " ".join(notice.message for notice in scene.file.notices if notice.code == "shape_unknown")
    assert "person is bent by a skeleton" in said
    assert "leaves is a mesh of many instances" in said
    assert sum(notice.code == "body_held" for notice in scene.file.notices) == 3


def test_the_default_scene_is_read_and_equal_names_are_told_apart(tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [
        {"children": [1, 2, 3]},
        FREE,
        FREE | {"translation": [0.3, 0.05, 0]},
        FLOOR | {"name": "cube-rigid#1"},
        FREE | {"translation": [7, 7, 7]},
    ]
    scene = read(tmp_path, nodes, scene=1, scenes=[{"nodes": [4]}, {"nodes": [0]}])
    assert [body.name for body in scene.file.bodies] == ["cube-rigid#1#", "cube-rigid#2", "cube-rigid#1"]


def test_inertia_is_that_of_the_file_where_a_body_can_have_it(tmp_path: Path) -> None:
    motion = {"mass": 2.0, "inertiaDiagonal": [0.01, 0.02, 0.025], "inertiaOrientation": [0, 0, 0, 1]}

    def moving(**entries: object) -> dict[str, Any]:
        return {
            "name": "cube",
            "mesh": 0,
            "translation": [0, 0.05, 0],
            "extensions": {"KHR_physics_rigid_bodies": {"motion": motion | entries}},
        }

    inertia = bodies_of(read(tmp_path, [moving(), FLOOR]))["cube"].inertia
    assert inertia is not None
    np.testing.assert_allclose(inertia, np.diag([0.01, 0.025, 0.02]), atol=1e-12)
    scene = read(tmp_path, [moving(inertiaDiagonal=[0.01, 0.01, 0.5]), FLOOR])
    assert bodies_of(scene)["cube"].inertia is None
    assert [notice.code for notice in scene.file.notices] == ["inertia_replaced"]


def test_an_export_of_this_library_has_the_poses_of_its_scene(tmp_path: Path) -> None:
    store = AssetStore(RunAssets(write_run(tmp_path / "run"), tmp_path / "files"))
    geometry = SceneGeometry.of(at_rest(), store)
    glb.export_scene(geometry, tmp_path)
    path = glb.scene_path(geometry.scene, tmp_path)
    file = read_gltf_scene(Boundary(tmp_path), path.name).file
    bodies = {body.name: body for body in file.bodies}
    assert [name for name, body in bodies.items() if not body.is_free] == ["table"]
    for k, (o, mesh) in enumerate(zip(geometry.scene.objects, geometry.meshes, strict=True)):
        turn = Rotation.from_euler("z", o.yaw)
        origin = np.array(o.position) + (0 if mesh is None else turn.apply(geometry.offset(k)))
        turn = turn if mesh is None else turn * Rotation.from_quat(o.tilt_quat_xyzw)
        np.testing.assert_allclose(bodies[o.instance].position, origin, atol=1e-9)
        assert (Rotation.from_quat(bodies[o.instance].quat_xyzw) * turn.inv()).magnitude() < 1e-9
        np.testing.assert_allclose(np.ptp(box_of(bodies[o.instance]), axis=0)[2], o.size[2], atol=0.004)
    (surface,) = find_supports(file)
    np.testing.assert_allclose(surface.size_xy, geometry.scene.table.size_xy, atol=0.01)
    assert surface.origin[2] == pytest.approx(0, abs=1e-9)
    assert len(surface.names) == 6


def add_nodes(document: dict[str, Any], count: int, to: int) -> None:
    first = len(document["nodes"])
    document["nodes"] += [{"name": "x-rigid"} for _ in range(count)]
    document["nodes"][to]["children"] = list(range(first, first + count))


def edited(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        document, content = kitchen()
        document["buffers"][0]["uri"] = "a.bin"
        change(document)
        (folder / "a.bin").write_bytes(content)
        (folder / "a.gltf").write_text(json.dumps(document))

    return write


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda d: d["buffers"][0].update(uri="../secret.bin"), "path_outside"),
        (lambda d: d["buffers"][0].update(uri="https://example.org/a.bin"), "path_outside"),
        (lambda d: d["buffers"][0].update(uri="/etc/hostname"), "path_outside"),
        (lambda d: d["buffers"][0].update(uri="none.bin"), "file_missing"),
        (lambda d: d["buffers"][0].update(uri="A.bin"), "file_missing"),
        (lambda d: d.update(images=[{"uri": "file:///etc/passwd"}]), "path_outside"),
        (lambda d: d["nodes"][1].update(children=[0]), "cyclic_reference"),
        (lambda d: d["nodes"][1].update(children=[2]), "glb_invalid"),
        (lambda d: d["nodes"][1].update(mesh=99), "glb_invalid"),
        (lambda d: d["accessors"][0].update(count=2**40), "mesh_too_large"),
        (lambda d: d["accessors"][0].update(count=10**5), "glb_truncated"),
        (lambda d: d["accessors"][0].update(sparse={}), "glb_unsupported"),
        (lambda d: d["nodes"][1].update(scale=[1e308, 1e308, 1e308]), "not_finite"),
        (lambda d: d["nodes"][1].update(rotation=[0, 0, 0, 0]), "not_finite"),
        (lambda d: d["nodes"][1].update(matrix=[1, 2, 3]), "glb_invalid"),
        (lambda d: add_nodes(d, 9000, to=2), "file_too_large"),
        (lambda d: add_nodes(d, 11000, to=2), "mesh_too_large"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "glb_unsupported"),
        (lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]), "glb_unsupported"),
        (lambda d: d.update(nodes={}), "no_free_body"),
        (lambda d: d["scenes"][0].update(nodes=[1]), "no_free_body"),
        (lambda d: d.update(animations=[{"channels": [{"target": {"node": [], "path": 3}}, 7]}]), "model_unreadable"),
    ],
)
def test_hostile_and_broken_files_are_errors_with_codes(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], code: str
) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(100))
    folder = tmp_path / "in"
    folder.mkdir()
    edited(change)(folder)
    with pytest.raises(StableDataError) as caught:
        read_gltf_scene(Boundary(folder), "a.gltf")
    assert caught.value.code == code, str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"glTF", b"{", b'{"nodes": NaN}', b"glTF" + struct.pack("<4I", 2, 20, 2**31, 0x4E4F534A), b"[1]"]
)
def test_what_is_no_gltf_is_said_and_not_left_out_of_a_folder(tmp_path: Path, content: bytes) -> None:
    for name in ("a.glb", "a.gltf"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(MeshError) as caught:
            read_gltf_scene(Boundary(tmp_path), name)
        assert caught.value.code == "model_unreadable"
        assert is_scene_candidate(tmp_path, name)


def test_an_image_that_is_missing_is_noted_and_one_that_is_there_belongs_to_the_scene(tmp_path: Path) -> None:
    (tmp_path / "a picture.png").write_bytes(b"png")
    edited(lambda d: d.update(images=[{"uri": "a%20picture.png"}, {"uri": "lost.png"}]))(tmp_path)
    scene = read_gltf_scene(Boundary(tmp_path), "a.gltf")
    assert scene.paths == ("a picture.png", "a.bin", "a.gltf")
    assert [notice.code for notice in scene.file.notices] == ["file_missing"]


def test_single_assets_of_a_folder_are_no_scenes(tmp_path: Path) -> None:
    write_gltf(tmp_path / "scene.glb", *kitchen())
    write_gltf(tmp_path / "scene2.gltf", *kitchen())
    write_gltf(tmp_path / "asset.glb", *gltf_parts([CUBE], [{"mesh": 0}]))
    write_gltf(tmp_path / "asset2.gltf", *gltf_parts([CUBE], [{"mesh": 0}]))
    assert scene_candidates(tmp_path) == ["scene.glb", "scene2.gltf"]
    with pytest.raises(StableDataError) as caught:
        read_gltf_scene(Boundary(tmp_path), "asset.glb")
    assert caught.value.code == "no_free_body"
    assert "single asset" in str(caught.value)
