"""Writes new poses of free bodies into the JSON of a glTF scene; every other byte stays as it is.

A pose stands in ``translation`` and ``rotation`` of a node, or in its ``matrix``. These numbers are replaced in the text, or inserted
where a node lacks them. The changed file is read again, and all that both files state is compared.
"""

import json
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import SceneError
from stable_data.geometry.gltf_reader import PlacedNode, placed_nodes
from stable_data.importers.formats.gltf import gltf_document, json_span
from stable_data.importers.scenes.gltf_nodes import is_own_object
from stable_data.importers.scenes.gltf_scenes import Z_UP, GltfScene, node_pose
from stable_data.importers.scenes.scene_file import BodyPose
from stable_data.limits import LIMITS
from stable_data.scene import FloatArray

_POSE = ("translation", "rotation", "matrix")
_NO_CHANGE = 1e-12  # units of the file, and parts of a unit quaternion: what is rounding
_RIGID = 1e-6  # largest difference of the change of a node's transform from a rotation
_EXACT = 1e-6  # metres, and radians: largest difference of a written pose
_TOKEN = re.compile(rb'"(?:[^"\\]|\\.)*"|[{}\[\]:,]|[^\s{}\[\]:,"]+', re.DOTALL)
_NUMBER = re.compile(rb"[-+.\deE]+")


def patch_nodes(scene: GltfScene, poses: Mapping[str, BodyPose]) -> bytes:
    """Puts new poses into a glTF scene.

    Args:
        scene: The scene.
        poses: Name of a free body -> its new pose, in metres, z up.

    Returns:
        The content of the changed file.

    Raises:
        SceneError: A node cannot show its pose, because nodes above it are scaled unevenly (``not_patchable``), or the changed file
            differs in more than the poses (``patch_differs``).
    """
    changes = {node.index: change for node, change in _changed_nodes(scene, poses)}
    start, end = json_span(scene.content)
    text = scene.content[start:end]
    places = _node_places(text)
    spans: dict[tuple[int, int], bytes] = {}
    for index, change in changes.items():
        if index not in places:
            raise _differs(scene, f"node {index} is not found in the text")
        first, stated = places[index]
        inserted: list[bytes] = []
        for key, (before, now) in change.items():
            if key in stated:
                spans[stated[key]] = _replaced(text[slice(*stated[key])], before, now)
            else:
                inserted.append(b'"%s":[%s]' % (key.encode(), b",".join(map(_number, now))))
        if inserted:
            spans[first, first] = _insertion(text, first, inserted)
    content = _with_json(scene.content, start, end, _spliced(text, spans))
    _compare(scene, content, poses, changes)
    return content


def _changed_nodes(
    scene: GltfScene, poses: Mapping[str, BodyPose]
) -> Iterator[tuple[PlacedNode, dict[str, tuple[FloatArray, FloatArray]]]]:
    """The nodes whose transform changes, and for each key its numbers in the file and its new ones."""
    free = {index: name for name, index in scene.free_nodes.items()}
    bodies = {body.name: body for body in scene.file.bodies}
    was = {node.index: node.world_from_node for node in scene.nodes}
    now: dict[int, FloatArray] = {}  # world_from_node of those that move
    for node in scene.nodes:
        name = free.get(node.index)
        above = None if node.parent is None else now.get(node.parent)
        if name is None or (name not in poses and above is None):
            if above is not None:
                now[node.index] = above @ node.parent_from_node
            continue
        motion = np.eye(4)
        if name in poses:
            position, quat = poses[name]
            turn = Z_UP.T @ (Rotation.from_quat(quat) * Rotation.from_quat(bodies[name].quat_xyzw).inv()).as_matrix() @ Z_UP
            motion[:3, :3] = turn
            motion[:3, 3] = Z_UP.T @ np.array(position) - turn @ Z_UP.T @ np.array(bodies[name].position)
        now[node.index] = motion @ node.world_from_node
        old_parent = np.eye(4) if node.parent is None else was[node.parent]
        change = np.asarray(np.linalg.solve(old_parent if above is None else above, motion @ old_parent), np.float64)
        turn = change[:3, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=_RIGID):
            found = f"node {name} is below a node with an uneven scale, so that its rotation cannot be stated"
            raise SceneError(f"{scene.file.path}: {found}; apply the scale of the nodes above it", "not_patchable")
        yield node, _new_values(scene.document["nodes"][node.index], node, change)


def _new_values(entry: Mapping[str, Any], node: PlacedNode, change: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    if "matrix" in entry:
        before = node.parent_from_node
        return {"matrix": (before.T.ravel(), (change @ before).T.ravel())}  # glTF stores columns first
    before = node.parent_from_node[:3, 3]
    found = {"translation": (before, change[:3, :3] @ before + change[:3, 3])}
    turn = Rotation.from_matrix(change[:3, :3])
    if turn.magnitude() > _NO_CHANGE:
        quat = np.array(entry.get("rotation", (0, 0, 0, 1)), np.float64)
        turned = (turn * Rotation.from_quat(quat)).as_quat()
        found["rotation"] = (quat, turned if turned @ quat >= 0 else -turned)
    return {key: pair for key, pair in found.items() if (np.abs(pair[0] - pair[1]) > _NO_CHANGE).any()}


def _node_places(text: bytes) -> dict[int, tuple[int, dict[str, tuple[int, int]]]]:
    """Where the nodes stand in a JSON text: their number -> the byte after their brace, and the spans of the lists of their pose."""
    found: dict[int, tuple[int, dict[str, tuple[int, int]]]] = {}
    path: list[str | int] = []  # keys and indices of the containers that are open, and of the present value
    kinds: list[bytes] = []
    start, is_key = 0, False
    for match in _TOKEN.finditer(text):
        token = match[0]
        if token in (b"{", b"["):
            if token == b"{" and len(path) == 2 and path[0] == "nodes" and isinstance(path[1], int):
                found[path[1]] = (match.end(), {})
            if token == b"[" and len(path) == 3:
                start = match.start()
            kinds.append(token)
            path.append("" if token == b"{" else 0)
            is_key = token == b"{"
        elif token in (b"}", b"]"):
            kinds.pop()
            path.pop()
            if token == b"]" and len(path) == 3 and path[0] == "nodes" and isinstance(path[1], int) and path[2] in _POSE:
                found[path[1]][1][str(path[2])] = (start, match.end())
            is_key = False
        elif token == b",":
            last = path[-1]
            if isinstance(last, int):
                path[-1] = last + 1
            is_key = kinds[-1] == b"{"
        elif is_key:
            path[-1] = str(json.loads(token))
            is_key = False
    return found


def _replaced(text: bytes, before: FloatArray, now: FloatArray) -> bytes:
    """A list of numbers with new ones; those that stay keep their spelling."""
    spans = [match.span() for match in _NUMBER.finditer(text)]
    if len(spans) != len(now):
        return b"[" + b",".join(map(_number, now)) + b"]"
    moved = np.abs(now - before) > _NO_CHANGE
    return _spliced(text, {span: _number(v) for span, v, has_moved in zip(spans, now, moved, strict=True) if has_moved})


def _insertion(text: bytes, first: int, entries: Sequence[bytes]) -> bytes:
    """Entries of an object as they stand behind its brace, spaced like the first entry that is there."""
    rest = text[first:].lstrip()
    space = text[first : len(text) - len(rest)]
    joined = (b"," + space).join([space + entry if k == 0 else entry for k, entry in enumerate(entries)])
    return joined if rest.startswith(b"}") else joined + b","


def _spliced(text: bytes, spans: Mapping[tuple[int, int], bytes]) -> bytes:
    pieces, at = [], 0
    for (first, last), new in sorted(spans.items()):
        pieces += [text[at:first], new]
        at = last
    return b"".join([*pieces, text[at:]])


def _with_json(content: bytes, start: int, end: int, text: bytes) -> bytes:
    """The file with another JSON; of a GLB the lengths and the padding follow it."""
    if start == 0:
        return text
    padded = text.rstrip(b" ")
    padded += b" " * (-len(padded) % 4)
    rest = content[end:]
    size = start + len(padded) + len(rest)
    return b"".join((content[:8], struct.pack("<2I", size, len(padded)), content[16:start], padded, rest))


def _number(value: float) -> bytes:
    return repr(round(float(value), 12) + 0.0).encode()


def _compare(scene: GltfScene, content: bytes, poses: Mapping[str, BodyPose], changed: Mapping[int, Mapping[str, Any]]) -> None:
    """Refuses a changed file that differs in more than the poses.

    Raises:
        SceneError: See above (``patch_differs``).
    """
    document = gltf_document(content, scene.file.path, LIMITS.gltf_scene)
    if content.startswith(b"glTF"):
        (_, end), (_, old_end) = json_span(content), json_span(scene.content)
        if content[end:] != scene.content[old_end:]:
            raise _differs(scene, "the binary part differs")
    expected = [dict(node) for node in scene.document["nodes"]]
    for index, keys in changed.items():
        expected[index] |= {key: document["nodes"][index].get(key) for key in keys}
    if document != {**scene.document, "nodes": expected}:
        raise _differs(scene, "more than the poses differs")
    wanted = {body.name: (body.position, body.quat_xyzw) for body in scene.file.bodies if body.is_free} | dict(poses)
    nodes = {node.index: node for node in placed_nodes(document, scene.file.path, limits=LIMITS.gltf_scene)}
    for name, (position, quat) in wanted.items():
        index = scene.free_nodes[name]
        found, turned = node_pose(nodes[index].world_from_node, is_z_up=is_own_object(document["nodes"][index]))
        angle = (Rotation.from_quat(turned) * Rotation.from_quat(quat).inv()).magnitude()
        off = max(float(np.abs(np.subtract(found, position)).max()), float(angle))
        if not off <= _EXACT:
            raise _differs(scene, f"the pose of {name} is off by {off:.1e}, at most {_EXACT:g} is expected")


def _differs(scene: GltfScene, found: str) -> SceneError:
    return SceneError(f"{scene.file.path}: in the changed file {found}; the file is left as it is", "patch_differs")
