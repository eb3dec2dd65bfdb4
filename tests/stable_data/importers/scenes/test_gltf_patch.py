"""New poses in glTF scenes: they are where they should be, everything else is as it was, byte for byte."""

import difflib
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.errors import SceneError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.gltf_patch import patch_nodes
from stable_data.importers.scenes.gltf_scenes import GltfScene, read_gltf_scene
from stable_data.importers.scenes.scene_file import BodyPose
from stable_data.rotations import quat_of
from tests.scene_files import cuboid, gltf_parts, kitchen, write_gltf

GOAL: BodyPose = ((0.4, 0.3, 0.9), quat_of(Rotation.from_euler("xyz", [0.1, 0.2, 0.3])))
KITCHEN = ("box_a-rigid", "box_b-rigid.001", "floating_RIGID", "fine-rigid", "bottle")


def patched(folder: Path, path: str, poses: dict[str, BodyPose]) -> GltfScene:
    """The scene of a file after new poses were written into it, in a folder beside it."""
    scene = read_gltf_scene(Boundary(folder), path)
    out = folder / "out"
    out.mkdir(exist_ok=True)
    for name in scene.paths:
        (out / name).write_bytes((folder / name).read_bytes())
    (out / path).write_bytes(patch_nodes(scene, poses))
    again = read_gltf_scene(Boundary(out), path)
    was = {body.name: (body.position, body.quat_xyzw) for body in scene.file.bodies}
    for body in again.file.bodies:
        position, quat = poses.get(body.name, was[body.name])
        np.testing.assert_allclose(body.position, position, atol=1e-9)
        assert (Rotation.from_quat(body.quat_xyzw) * Rotation.from_quat(quat).inv()).magnitude() < 1e-8
    return again


@pytest.mark.parametrize("name", KITCHEN)
def test_each_way_to_state_a_pose_can_be_changed(tmp_path: Path, name: str) -> None:
    write_gltf(tmp_path / "a.gltf", *kitchen())
    patched(tmp_path, "a.gltf", {name: GOAL})
    before, after = ((folder / "a.gltf").read_text() for folder in (tmp_path, tmp_path / "out"))
    assert (tmp_path / "out" / "a.bin").read_bytes() == (tmp_path / "a.bin").read_bytes()
    node = next(k for k, n in enumerate(kitchen()[0]["nodes"]) if n.get("name") == name)
    one, other = json.loads(before), json.loads(after)
    keys = {"matrix"} if name == "floating_RIGID" else {"translation", "rotation"}
    for key in keys:
        one["nodes"][node].pop(key, None)
        assert other["nodes"][node].pop(key)
    assert one == other


def test_only_numbers_that_change_are_written_anew(tmp_path: Path) -> None:
    document, content = kitchen()
    write_gltf(tmp_path / "a.gltf", document, content)
    text = (tmp_path / "a.gltf").read_text()
    odd = text.replace("76.0", "7.60E+1").replace(
        '"name": "bottle"', '"n\\u0061me"  :"bottle",\t"note": "[}] \\" caf\\u00e9 é"'
    )
    assert odd != text
    (tmp_path / "a.gltf").write_text(odd, encoding="utf-8-sig")
    scene = read_gltf_scene(Boundary(tmp_path), "a.gltf")
    (x, y, z), quat = next((b.position, b.quat_xyzw) for b in scene.file.bodies if b.name == "box_a-rigid")
    patched(tmp_path, "a.gltf", {"box_a-rigid": ((x, y + 0.1, z), quat)})
    before, after = ((folder / "a.gltf").read_bytes().decode() for folder in (tmp_path, tmp_path / "out"))
    changed = [line for line in difflib.ndiff(before.splitlines(), after.splitlines()) if line[0] in "+-"]
    assert [line[0] for line in changed] == ["-", "+", "-", "+"], "x and z of the translation; its y keeps its spelling"
    assert before.startswith("﻿{")


def test_a_node_without_a_pose_gets_one(tmp_path: Path) -> None:
    for k, node in enumerate(({"name": "cube-rigid", "mesh": 0}, {"mesh": 0, "name": "cube-rigid"})):
        document, content = gltf_parts([cuboid(0.1, 0.1, 0.1)], [node])
        for indent in (None, 1):
            name = f"{k}{indent}.gltf"
            write_gltf(tmp_path / name, document, content, indent=indent)
            patched(tmp_path, name, {"cube-rigid": GOAL})
            before, after = ((folder / name).read_bytes() for folder in (tmp_path, tmp_path / "out"))
            codes = difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
            assert {code[0] for code in codes} == {"equal", "insert"}


def test_of_a_binary_file_the_lengths_follow_and_the_binary_part_stays(tmp_path: Path) -> None:
    write_gltf(tmp_path / "a.glb", *kitchen())
    path = tmp_path / "a.glb"
    path.write_bytes(path.read_bytes() + struct.pack("<2I", 4, 0x12345678) + b"more")  # a chunk that no reader knows
    scene = read_gltf_scene(Boundary(tmp_path), "a.glb")
    moved = {name: (tuple(np.add(GOAL[0], (k, 0, 0)).tolist()), GOAL[1]) for k, name in enumerate(KITCHEN)}
    content = patch_nodes(scene, moved)
    size, length = struct.unpack_from("<2I", content, 8)
    assert (size, length % 4) == (len(content), 0)
    old_length = struct.unpack_from("<I", path.read_bytes(), 12)[0]
    assert content[20 + length :] == path.read_bytes()[20 + old_length :]
    (tmp_path / "b.glb").write_bytes(content)
    again = read_gltf_scene(Boundary(tmp_path), "b.glb")
    loaded = trimesh.load(tmp_path / "b.glb")
    for body in again.file.bodies:
        if body.is_free:
            np.testing.assert_allclose(body.position, moved[body.name][0], atol=1e-9)
            x, y, z = loaded.graph[body.name][0][:3, 3]
            np.testing.assert_allclose((x, -z, y), moved[body.name][0], atol=1e-6)


def test_a_body_below_a_body_that_moves_stays_or_moves_by_itself(tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [
        {"children": [1, 4]},
        {"name": "tray-rigid", "mesh": 0, "children": [2], "translation": [0, 0.05, 0], **_turned(20)},
        {"name": "between", "children": [3], "scale": [2, 2, 2], "translation": [0.1, 0, 0]},
        {"name": "cup-rigid", "mesh": 0, "translation": [0, 0.1, 0]},
        {"name": "floor", "mesh": 0, "translation": [0, -1, 0]},
    ]
    write_gltf(tmp_path / "a.glb", *gltf_parts([cuboid(0.1, 0.1, 0.1)], nodes))
    patched(tmp_path, "a.glb", {"tray-rigid": GOAL})
    patched(tmp_path, "a.glb", {"cup-rigid": GOAL})
    patched(tmp_path, "a.glb", {"tray-rigid": GOAL, "cup-rigid": ((1.0, 2.0, 3.0), GOAL[1])})


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_poses_below_any_tree_are_those_that_were_asked_for(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("tree")
    nodes: list[dict[str, Any]] = [{"children": []}]
    for k in range(1, 7):
        node: dict[str, Any] = {"name": f"{k}-rigid" if k % 2 else f"{k}", "mesh": 0, "children": []}
        size, turn, place = rng.uniform(0.3, 3), Rotation.random(random_state=rng), rng.uniform(-2, 2, 3)
        if rng.random() < 0.3:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = size * turn.as_matrix(), place
            node["matrix"] = matrix.T.ravel().tolist()
        else:
            node |= {"rotation": turn.as_quat().tolist(), "translation": place.tolist(), "scale": [float(size)] * 3}
            node = {key: value for key, value in node.items() if key in ("name", "mesh", "children") or rng.random() < 0.7}
        nodes[int(rng.integers(k))]["children"].append(k)
        nodes.append(node)
    nodes = [{key: value for key, value in node.items() if value != []} for node in nodes]
    write_gltf(folder / "a.glb", *gltf_parts([cuboid(0.1, 0.1, 0.1)], nodes))
    goals = {
        f"{k}-rigid": (tuple(rng.uniform(-2, 2, 3).tolist()), quat_of(Rotation.random(random_state=rng))) for k in (1, 3, 5)
    }
    patched(folder, "a.glb", {name: goal for name, goal in goals.items() if rng.random() < 0.7})


def test_a_pose_below_an_uneven_scale_is_refused_if_it_cannot_be_stated(tmp_path: Path) -> None:
    nodes: list[dict[str, Any]] = [{"scale": [1, 2, 1], "children": [1]}, {"name": "cube-rigid", "mesh": 0}]
    write_gltf(tmp_path / "a.glb", *gltf_parts([cuboid(0.1, 0.1, 0.1)], nodes))
    patched(tmp_path, "a.glb", {"cube-rigid": ((1.0, 2.0, 3.0), quat_of(Rotation.from_euler("z", 0.5)))})
    with pytest.raises(SceneError) as caught:
        patch_nodes(read_gltf_scene(Boundary(tmp_path), "a.glb"), {"cube-rigid": GOAL})
    assert caught.value.code == "not_patchable"


def test_of_keys_that_are_there_twice_the_last_counts(tmp_path: Path) -> None:
    document, content = gltf_parts([cuboid(0.1, 0.1, 0.1)], [{"name": "cube-rigid", "mesh": 0, "translation": [1, 2, 3]}])
    write_gltf(tmp_path / "a.gltf", document, content)
    text = (tmp_path / "a.gltf").read_text()
    (tmp_path / "a.gltf").write_text(text.replace('"name": "cube-rigid"', '"translation": [7, 8, 9], "name": "cube-rigid"'))
    patched(tmp_path, "a.gltf", {"cube-rigid": GOAL})
    (tmp_path / "a.gltf").write_text(text[:-1] + ', "nodes": [{"mesh": 0, "name": "cube-rigid"}]}')
    patched(tmp_path, "a.gltf", {"cube-rigid": GOAL})


def test_a_changed_file_that_differs_in_more_is_refused(tmp_path: Path) -> None:
    write_gltf(tmp_path / "a.gltf", *kitchen())
    scene = read_gltf_scene(Boundary(tmp_path), "a.gltf")
    for old, new in (
        (b"shelf", b"shelv"),
        (b"110", b"111"),
        (b"-15", b"-16"),
        (b'"name": "table"', b'"name": "table", "camera": 0'),
    ):
        other = replace(scene, content=scene.content.replace(old, new))
        assert other.content != scene.content
        with pytest.raises(SceneError) as caught:
            patch_nodes(other, {"box_a-rigid": GOAL})
        assert caught.value.code == "patch_differs"


def _turned(degrees: float) -> dict[str, Any]:
    return {"rotation": Rotation.from_euler("y", degrees, degrees=True).as_quat().tolist()}
