"""MJCF as MuJoCo reads it: in a process that knows nothing of this library, and number for number."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from stable_data.assets.store import AssetStore
from stable_data.export import mjcf
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.mujoco_model import CAMERAS, VISUAL_GROUP, body_name, engine_spec
from stable_data.simulation.render import scene_bounds
from stable_data.simulation.room import FLOOR, RESTRICTED_ZONE, TABLE_FRAME, TABLE_TOP, WALL, furnish
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_bodies, compile_spec, hull_volume, settle
from tests.stable_data.export.runs import EMPTY, SCENES, at_rest, falling

pytestmark = pytest.mark.sim

_READ = """
import json, sys
import mujoco
import numpy as np

model = mujoco.MjModel.from_xml_path(sys.argv[1])
assert not any(name.startswith("stable_data") for name in sys.modules)
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
mujoco.mj_forward(model, data)
found = {
    "names": [model.body(k).name for k in range(1, model.nbody)],
    "masses": model.body_mass[1:].tolist(),
    "colliders": [int(((model.geom_bodyid == k) & (model.geom_contype > 0)).sum()) for k in range(1, model.nbody)],
    "start": np.concatenate([data.xpos[1:], data.xquat[1:]], axis=1).tolist(),
    "penetration": float(max(0.0, -data.contact.dist.min())) if data.ncon else 0.0,
}
mujoco.mj_step(model, data, nstep=2000)
mujoco.mj_kinematics(model, data)
found["end"] = np.concatenate([data.xpos[1:], data.xquat[1:]], axis=1).tolist()
print(json.dumps(found))
"""


def read(path: Path) -> dict[str, Any]:
    """What MuJoCo says of a file, alone."""
    done = subprocess.run([sys.executable, "-I", "-c", _READ, str(path)], capture_output=True, text=True, check=True, cwd="/")
    return dict(json.loads(done.stdout))


def xyzw(poses: Any) -> FloatArray:
    """Quaternions (N, 4) of poses with wxyz ones."""
    return np.asarray(poses, np.float64).reshape(-1, 7)[:, [4, 5, 6, 3]]


@pytest.mark.parametrize("scene", [at_rest(), falling()], ids=["at rest", "falling"])
def test_mujoco_alone_finds_what_the_verdict_found(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    solid = SceneGeometry.of(scene, store)
    mjcf.export_scene(solid, tmp_path)
    found, rest = read(mjcf.scene_path(scene, tmp_path)), settle(solid.bodies, scene.table)
    assert found["names"] == [body_name(o.instance) for o in scene.objects]
    np.testing.assert_allclose(found["masses"], [body.mass for body in solid.bodies], rtol=1e-12)
    assert found["colliders"] == [sum(hull_volume(part) > 0 for part in body.parts) for body in solid.bodies]
    start = np.array(found["start"])
    np.testing.assert_allclose(start[:, :3], [o.position for o in scene.objects], atol=1e-12)
    np.testing.assert_allclose(2 * np.arctan2(start[:, 6], start[:, 3]), [o.yaw for o in scene.objects], atol=1e-12)
    assert 1e3 * found["penetration"] == pytest.approx(rest.engine_penetration_mm, abs=1e-6)
    np.testing.assert_allclose(np.array(found["end"])[:, :3], rest.positions, atol=1e-4)
    np.testing.assert_allclose(np.abs((xyzw(found["end"]) * rest.quats_xyzw).sum(axis=1)), 1.0, atol=1e-6)


@pytest.mark.parametrize("scene", SCENES, ids=["at rest", "falling", "empty"])
def test_the_model_is_the_one_of_the_verdict_to_the_last_bit(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    solid = SceneGeometry.of(scene, store)
    mjcf.export_scene(solid, tmp_path)
    read_back, own = (
        mujoco.MjModel.from_xml_path(str(mjcf.scene_path(scene, tmp_path))),
        compile_bodies(solid.bodies, scene.table),
    )
    for name in (
        "timestep",
        "cone",
        "impratio",
        "disableflags",
        "enableflags",
        "integrator",
        "solver",
        "iterations",
        "gravity",
    ):
        np.testing.assert_array_equal(getattr(read_back.opt, name), getattr(own.opt, name), name)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "qpos0"):
        np.testing.assert_array_equal(getattr(read_back, name), getattr(own, name), name)
    collides = read_back.geom_contype > 0
    assert collides.sum() == own.ngeom
    for name in ("pos", "quat", "size", "type", "friction", "solref", "solimp", "condim", "margin", "bodyid", "conaffinity"):
        np.testing.assert_array_equal(getattr(read_back, f"geom_{name}")[collides], getattr(own, f"geom_{name}"), name)
    np.testing.assert_array_equal(read_back.mesh_vert[: len(own.mesh_vert)], own.mesh_vert)
    np.testing.assert_array_equal(read_back.key_qpos[0], own.qpos0)


def test_what_is_seen_is_the_mesh_where_the_object_is(store: AssetStore, tmp_path: Path) -> None:
    scene = at_rest()
    solid = SceneGeometry.of(scene, store)
    mjcf.export_scene(solid, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(mjcf.scene_path(scene, tmp_path)))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for k, (o, shape) in enumerate(zip(scene.objects, solid.shapes, strict=True)):
        geom = model.geom(f"{body_name(o.instance)}/visual")
        assert geom.group[0] == VISUAL_GROUP
        assert geom.contype[0] == geom.conaffinity[0] == 0
        if solid.meshes[k] is None:
            np.testing.assert_allclose(2 * geom.size, o.size)
            continue
        mesh = model.mesh(int(geom.dataid[0]))
        start, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
        turn = data.geom_xmat[geom.id].reshape(3, 3)
        corners = model.mesh_vert[start : start + count] @ turn.T + data.geom_xpos[geom.id]
        np.testing.assert_allclose(box_of(corners), box_of(shape.posed(scene.poses()[k])), atol=2e-6)
    assert [model.camera(k).name for k in range(model.ncam)] == list(CAMERAS)


@pytest.mark.parametrize("scene", SCENES, ids=["at rest", "falling", "empty"])
def test_nothing_of_the_room_changes_the_physics(scene: Scene, store: AssetStore) -> None:
    geometry = SceneGeometry.of(scene, store)
    furnished, bare = compile_spec(engine_spec(geometry)), compile_bodies(geometry.bodies, scene.table)
    names = [furnished.geom(k).name for k in range(furnished.ngeom)]
    assert {FLOOR, WALL, TABLE_TOP, TABLE_FRAME} <= set(names)
    is_room = np.array([name.startswith(("table/", "room/")) or name == RESTRICTED_ZONE for name in names])
    assert not furnished.geom_contype[is_room].any()
    assert not furnished.geom_conaffinity[is_room].any()
    np.testing.assert_array_equal(furnished.body_mass[1:], bare.body_mass[1:])
    assert furnished.body_mass[0] == bare.body_mass[0]
    paths = []
    for model in (furnished, bare):
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=400)
        paths.append(np.r_[data.qpos, data.qvel])
    np.testing.assert_array_equal(*paths)


def test_the_file_has_the_textures_of_the_model(store: AssetStore, tmp_path: Path) -> None:
    scene = at_rest()
    geometry = SceneGeometry.of(scene, store)
    mjcf.export_scene(geometry, tmp_path)
    own, read = compile_spec(engine_spec(geometry)), mujoco.MjModel.from_xml_path(str(mjcf.scene_path(scene, tmp_path)))
    np.testing.assert_array_equal(read.tex_data, own.tex_data)
    np.testing.assert_array_equal(read.mat_texid, own.mat_texid)
    for name in ("rgba", "emission", "specular", "shininess"):
        np.testing.assert_array_equal(getattr(read, f"mat_{name}"), getattr(own, f"mat_{name}"), name)
    np.testing.assert_array_equal(read.geom_matid, own.geom_matid)
    np.testing.assert_array_equal(read.geom_group, own.geom_group)
    for part in furnish(scene.table, *scene_bounds(scene, [None] * len(scene.objects))):
        if part.surface.corner_uv is not None and part.is_of_table:
            mesh = read.mesh(part.name)
            assert mesh.texcoordadr[0] >= 0
            start, count = int(mesh.faceadr[0]), int(mesh.facenum[0])
            uv = read.mesh_texcoord[int(mesh.texcoordadr[0]) + read.mesh_facetexcoord[start : start + count]]
            np.testing.assert_allclose(uv, part.surface.corner_uv, atol=1e-5)


def box_of(corners: Any) -> FloatArray:
    """Lowest and highest corner, (2, 3)."""
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def test_settled_poses_are_those_that_the_engine_left(store: AssetStore, tmp_path: Path) -> None:
    scene = falling()
    before = SceneGeometry.of(scene, store)
    rest = settle(before.bodies, scene.table)
    left = {
        name: (tuple(position), tuple(quat))
        for name, position, quat in zip(rest.names, rest.positions.tolist(), rest.quats_xyzw.tolist(), strict=True)
    }
    after = SceneGeometry.of(scene, store, left)
    moved = [
        np.linalg.norm(np.subtract(o.position, p.position)) for o, p in zip(scene.objects, after.scene.objects, strict=True)
    ]
    assert moved[0] > 0.005
    mjcf.export_scene(after, tmp_path)
    found = read(mjcf.scene_path(scene, tmp_path))
    start, end = np.array(found["start"]), np.array(found["end"])
    np.testing.assert_allclose(end[:, :3], start[:, :3], atol=5e-4)
    for k, shape in enumerate(before.shapes):  # every corner is where the engine left it
        turn = mujoco_matrix(rest.quats_xyzw[k])
        corners = shape.vertices @ turn.T + rest.positions[k]
        np.testing.assert_allclose(after.shapes[k].posed(after.scene.poses()[k]), corners, atol=1e-9)
        assert isinstance(after.shapes[k], Shape)


def mujoco_matrix(quat_xyzw: FloatArray) -> FloatArray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat_xyzw[[3, 0, 1, 2]])
    return matrix.reshape(3, 3)


def test_a_part_that_two_scenes_share_is_one_file(store: AssetStore, tmp_path: Path) -> None:
    mjcf.export_scene(SceneGeometry.of(at_rest(), store), tmp_path)
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "assets").rglob("*.obj")}
    again = Scene("again", at_rest().table, at_rest().objects)
    mjcf.export_scene(SceneGeometry.of(again, store), tmp_path)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "assets").rglob("*.obj")} == files


def test_versions_with_other_defaults_are_told_what_the_verdict_had(store: AssetStore, tmp_path: Path) -> None:
    """Before version 4 MuJoCo found one contact point for two meshes, and no version leaves a blown-up scene as it is."""
    mjcf.export_scene(SceneGeometry.of(at_rest(), store), tmp_path)
    flag = ElementTree.parse(mjcf.scene_path(at_rest(), tmp_path)).find("option/flag")  # noqa: S314 - our own file
    assert flag is not None
    assert flag.attrib == {"autoreset": "disable", "multiccd": "enable"}


@pytest.mark.parametrize("name", ["assets", "README.md", "..", "a/b"])
def test_a_scene_takes_the_place_of_nothing_else(name: str, tmp_path: Path) -> None:
    folder = mjcf.scene_path(replace(EMPTY, scene_id=name), tmp_path).parent
    assert folder.parent == tmp_path
    assert folder.name != name


def test_an_empty_scene_is_a_table(store: AssetStore, tmp_path: Path) -> None:
    mjcf.export_scene(SceneGeometry.of(EMPTY, store), tmp_path)
    assert read(mjcf.scene_path(EMPTY, tmp_path))["names"] == []
