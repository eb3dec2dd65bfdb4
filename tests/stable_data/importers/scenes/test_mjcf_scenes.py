"""What is read of a MuJoCo scene file, against MuJoCo's own figures and analytic shapes."""

from pathlib import Path

import numpy as np
import pytest

from stable_data.errors import MeshError, SceneError
from stable_data.geometry.mesh import Mesh, is_closed, signed_volumes
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes import convex_solids
from stable_data.importers.scenes.mjcf_scenes import MjcfScene, read_mjcf_scene
from tests.scene_files import write_corner, write_model

FREE = '<body name="{name}" pos="{pos}"><freejoint/><geom type="box" size=".03 .03 .03"/></body>'


def read(folder: Path, key: str = "") -> MjcfScene:
    return read_mjcf_scene(Boundary(folder), "scene.xml", key)


def test_free_bodies_are_objects_and_the_rest_is_fixed(tmp_path: Path) -> None:
    write_corner(tmp_path)
    file = read(tmp_path).file
    assert [b.name for b in file.bodies if b.is_free] == ["mug", "box_a", "box_b", "floating", "fine", "wedge_1"]
    assert [b.name for b in file.bodies if not b.is_free] == ["table", "base", "arm"]
    assert [(g.owner, g.height) for g in file.grounds] == [("world", -0.8)]


def test_mass_centre_and_inertia_are_those_of_the_model(tmp_path: Path) -> None:
    write_corner(tmp_path)
    scene = read(tmp_path)
    mug = next(b for b in scene.file.bodies if b.name == "mug")
    index = scene.model.body("mug").id
    assert mug.mass == pytest.approx(scene.model.body_subtreemass[index])
    assert mug.center_of_mass is not None
    assert mug.inertia is not None
    np.testing.assert_allclose(mug.center_of_mass, scene.model.body_ipos[index], atol=1e-9)
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(mug.inertia)), np.sort(scene.model.body_inertia[index]), rtol=1e-9)
    box = next(b for b in scene.file.bodies if b.name == "box_b")
    assert box.mass == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("mesh", "volume", "off"),
    [
        (convex_solids.box(np.array([0.1, 0.2, 0.3])), 8 * 0.1 * 0.2 * 0.3, 1e-12),
        (convex_solids.cylinder(0.1, 0.2), np.pi * 0.01 * 0.4, 0.002),
        (convex_solids.ellipsoid(np.array([0.1, 0.2, 0.3])), 4 / 3 * np.pi * 0.006, 0.01),
        (convex_solids.capsule(0.1, 0.2), np.pi * 0.01 * 0.4 + 4 / 3 * np.pi * 0.001, 0.01),
    ],
)
def test_primitives_are_closed_outward_solids(mesh: Mesh, volume: float, off: float) -> None:
    assert is_closed(mesh)
    assert signed_volumes(mesh.triangles).sum() == pytest.approx(volume, rel=off + 1e-12)
    assert (signed_volumes(mesh.triangles) > -1e-12).all()


def test_points_on_a_line_have_no_hull_and_a_plane_has_a_thin_one() -> None:
    assert convex_solids.hull_of(np.outer(np.arange(5.0), [1.0, 2.0, 3.0])) is None
    plate = convex_solids.hull_of(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float))
    assert plate is not None
    assert plate.extents[2] == pytest.approx(1e-4)


def test_the_keyframe_home_or_a_named_one_gives_the_poses(tmp_path: Path) -> None:
    keys = '<keyframe><key name="other" qpos=".2 0 .03 1 0 0 0"/><key name="home" qpos=".1 0 .03 .7071068 0 0 .7071068"/></keyframe>'
    write_model(tmp_path, FREE.format(name="cube", pos="0 0 .5"))
    path = tmp_path / "scene.xml"
    path.write_text(path.read_text().replace("</mujoco>", keys + "</mujoco>"))
    cubes = {key: next(b for b in read(tmp_path, key).file.bodies if b.is_free) for key in ("", "other", "initial")}
    assert [cubes[key].position for key in ("", "other", "initial")] == [(0.1, 0, 0.03), (0.2, 0, 0.03), (0, 0, 0.5)]
    assert read(tmp_path).file.pose_of == "home"
    assert len(cubes["other"].known_quats) == 1
    with pytest.raises(SceneError, match="other, home") as caught:
        read(tmp_path, "none")
    assert caught.value.code == "key_unknown"


def test_held_driven_and_bare_bodies_are_no_objects(tmp_path: Path) -> None:
    bodies = FREE.format(name="held", pos="0 0 .5") + FREE.format(name="cube", pos=".2 0 .03")
    bodies += '<body name="ghost"><freejoint/><geom size=".1" contype="0" conaffinity="0"/></body>'
    arm = '<body pos="0 0 .1"><joint name="j"/><geom size=".05"/></body>'
    bodies += f'<body name="robot" pos="0 .2 .3"><freejoint/><geom size=".05"/>{arm}</body>'
    extra = '<equality><weld body1="held" body2="table"/></equality><actuator><motor joint="j"/></actuator>'
    write_model(tmp_path, bodies, extra)
    scene = read(tmp_path)
    assert list(scene.free_bodies) == ["cube"]
    assert sorted(n.code for n in scene.file.notices) == ["body_driven", "body_held", "no_collider"]


@pytest.mark.parametrize(
    ("body", "extra", "code"),
    [
        ('<geom size=".1"/>', "", "no_free_body"),
        (FREE.format(name="a", pos="0 0 1"), '<option gravity="0 -9.81 0"/>', "gravity_odd"),
        (FREE.format(name="a", pos="0 0 1"), '<size memory="10G"/>', "file_too_large"),
    ],
)
def test_what_is_no_scene_is_refused(tmp_path: Path, body: str, extra: str, code: str) -> None:
    write_model(tmp_path, body, extra)
    with pytest.raises((MeshError, SceneError)) as caught:
        read(tmp_path)
    assert caught.value.code == code
