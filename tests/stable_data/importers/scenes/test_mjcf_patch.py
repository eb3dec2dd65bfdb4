"""New poses in the XML of a scene: only the bytes of the poses change, and MuJoCo reads the poses that were asked for."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.errors import SceneError, StableDataError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes import mjcf_patch
from stable_data.importers.scenes.mjcf_patch import PatchedModel, patch_poses
from stable_data.importers.scenes.mjcf_scenes import MjcfScene, read_mjcf_scene
from stable_data.importers.scenes.scene_file import BodyPose
from stable_data.rotations import quat_of, wxyz
from tests.scene_files import SCENE, THINGS, write_corner, write_model

GOAL: BodyPose = ((0.1234567890123, -0.2, 0.3), quat_of(Rotation.from_euler("xyz", [0.1, 0.2, 0.3])))
CUBE = '<geom type="box" size=".03 .03 .03"/></body>'


def patched(folder: Path, *names: str, key: str = "") -> tuple[MjcfScene, PatchedModel]:
    scene = read_mjcf_scene(Boundary(folder), "scene.xml", key)
    found = patch_poses(scene, dict.fromkeys(names, GOAL))
    for name in names:
        at = scene.address(name)
        np.testing.assert_allclose(found.qpos[at : at + 3], GOAL[0], atol=1e-9)
        np.testing.assert_allclose(np.abs(found.qpos[at + 3 : at + 7] @ wxyz(GOAL[1])), 1, atol=1e-12)
    return scene, found


def test_only_poses_change(tmp_path: Path) -> None:
    write_corner(tmp_path)
    _, found = patched(tmp_path, "mug", "box_b")
    assert sorted(found.changed) == ["parts/things.xml", "scene.xml"]
    scene = found.changed["scene.xml"].decode()
    assert scene.startswith(SCENE[: SCENE.index("name='box_b'") - 10])
    assert scene.endswith(SCENE[SCENE.index('<joint type="free"/>') :])
    assert "pos = '0.123456789012 -0.2 0.3'" in scene
    things = found.changed["parts/things.xml"].decode()
    assert things.splitlines()[2:] == THINGS.splitlines()[2:]
    assert "euler" not in things.splitlines()[1]
    assert 'childclass="mug"><freejoint/>' in things.splitlines()[1]


def test_nothing_asked_changes_nothing(tmp_path: Path) -> None:
    write_corner(tmp_path)
    assert patched(tmp_path)[1].changed == {}


def test_a_rotation_that_stays_keeps_its_spelling(tmp_path: Path) -> None:
    write_corner(tmp_path)
    scene = read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    body = next(b for b in scene.file.bodies if b.name == "floating")
    found = patch_poses(scene, {"floating": ((0.3, -0.2, 0.05), body.quat_xyzw)})
    old, new = 'pos="0.3 -0.2 0.2" euler="0 0 30"', 'pos="0.3 -0.2 0.05" euler="0 0 30"'
    assert found.changed["scene.xml"].decode() == SCENE.replace(old, new)


def test_keyframes_that_state_the_pose_change_with_it(tmp_path: Path) -> None:
    first = f'<body name="a" pos="0 0 .5"><freejoint/>{CUBE}'
    second = f'<body name="b" pos=".2 0 .03"><freejoint/>{CUBE}'
    pose_b, arm = ".2 0 .03 1 0 0 0", '<body name="arm"><joint name="j"/><geom size=".05" pos="0 0 .3"/></body>'
    keys = (
        f'<keyframe><key name="home" qpos="0.7  0 0 .03 1 0 0 0\n {pose_b}"/>'
        f'<key name="same" qpos="0 0 0 .03 1 0 0 0 {pose_b}"/><key name="other" qpos="0 .1 .1 .03 1 0 0 0 {pose_b}"/></keyframe>'
    )
    path = write_model(tmp_path, arm + first + second)
    text = path.read_text().replace("</mujoco>", keys + "</mujoco>")
    path.write_text(text)
    scene, found = patched(tmp_path, "a")
    assert scene.key == 0
    after = found.changed["scene.xml"].decode()
    assert found.places["a"] == ("scene.xml: key home", "scene.xml: key same")  # the body itself states another pose
    head, tail = text.index("<keyframe>"), text.index('<key name="other"')
    assert after.startswith(text[:head])
    assert after.endswith(text[tail:])
    assert f"\n {pose_b}" in after
    np.testing.assert_array_equal(found.model.key_qpos[2], scene.model.key_qpos[2])
    assert found.qpos[0] == 0.7


def test_a_body_without_attributes_gets_them(tmp_path: Path) -> None:
    write_model(tmp_path, f'<body pos="1 0 1"><geom size=".1"/></body><body><freejoint/>{CUBE}')
    _, found = patched(tmp_path, "#3")
    assert b'<body pos="0.123456789012 -0.2 0.3" quat="' in found.changed["scene.xml"]


@pytest.mark.parametrize("frame", ['<frame pos="1 2 3" euler="30 0 0"><frame quat="0 1 0 0">', '<frame pos="0 0 1"><frame>'])
def test_a_body_in_static_frames_is_moved_within_them(tmp_path: Path, frame: str) -> None:
    write_model(tmp_path, f'{frame}<body name="a" pos=".1 0 .2" quat="0 0 1 0"><freejoint/>{CUBE}</frame></frame>')
    patched(tmp_path, "a")


@pytest.mark.parametrize(
    ("body", "found"),
    [
        (
            f'<replicate count="2" offset=".2 0 0"><body name="a" pos="0 0 1"><freejoint/>{CUBE}</replicate>',
            "copy of replicate",
        ),
        (f'<frame pos="0 0 1"><body name="a" euler="9 0 0"><freejoint/>{CUBE}</frame>', "in another way than as quat"),
    ],
)
def test_what_cannot_be_changed_in_place_is_refused(tmp_path: Path, body: str, found: str) -> None:
    write_model(tmp_path, body)
    scene = read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    with pytest.raises(SceneError, match=found) as caught:
        patch_poses(scene, {next(iter(scene.free_bodies)): GOAL})
    assert caught.value.code == "not_patchable"


def test_a_change_of_anything_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_corner(tmp_path)
    scene = read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    monkeypatch.setattr(mjcf_patch, "_number", lambda value: b"0.5 0.5" if value == GOAL[0][2] else repr(float(value)).encode())
    with pytest.raises(StableDataError):
        patch_poses(scene, {"fine": GOAL})
    monkeypatch.setattr(mjcf_patch, "_number", lambda value: repr(float(value) + 1e-3).encode())
    with pytest.raises(SceneError) as caught:
        patch_poses(scene, {"fine": GOAL})
    assert caught.value.code == "patch_differs"
