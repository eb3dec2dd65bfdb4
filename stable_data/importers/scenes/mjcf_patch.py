"""Writes new poses of free bodies into the XML of a MuJoCo scene file; every other byte stays as it is.

A pose stands at two places: in the attributes of the body's start tag, and in the ``qpos`` of keyframes. The place of the pose that
was repaired is changed, and every other place that states the same pose. The changed file is compiled, and all that both models
state is compared.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stable_data.errors import SceneError
from stable_data.importers.mjcf_files import Element, compile_model, read_spec
from stable_data.importers.scenes.mjcf_scenes import MjcfScene
from stable_data.importers.scenes.scene_file import BodyPose
from stable_data.rotations import quat_of, wxyz
from stable_data.scene import FloatArray
from stable_data.simulation.mujoco_import import mujoco

_ORIENTATIONS = ("quat", "euler", "axisangle", "xyaxes", "zaxis")
_SAME_POSE = 1e-9  # difference of numbers of poses that are one pose
_NO_CHANGE = 1e-12  # metres, and parts of a unit quaternion: what is rounding
_EXACT = 1e-6  # metres, and parts of a unit quaternion: largest difference of a written pose
# What MuJoCo derives from the initial poses; nothing of it is stated by the file.
_DERIVED = (
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "dof_length",
    "cam_pos0",
    "cam_poscom0",
    "cam_mat0",
    "light_pos0",
    "light_poscom0",
    "light_dir0",
    "tendon_length0",
    "tendon_invweight0",
    "actuator_length0",
    "actuator_acc0",
    "actuator_lengthrange",
)
_POSES = ("body_pos", "body_quat", "qpos0", "qpos_spring", "key_qpos")
_OF_MASSLESS = ("body_ipos", "body_iquat", "body_sameframe")  # MuJoCo copies the pose there if a body has no mass of its own
_ATTRIBUTE = re.compile(rb"""([^\s=<>/"']+)\s*=\s*("[^"]*"|'[^']*')""")


@dataclass(frozen=True, slots=True, eq=False)
class PatchedModel:
    """A scene file with new poses.

    Attributes:
        changed: Path of each changed file, relative to the source folder -> its content.
        model: The compiled model of the changed files.
        qpos: The joint positions of the repaired poses.
        places: For each body, where its pose was changed.
    """

    changed: Mapping[str, bytes]
    model: mujoco.MjModel
    qpos: FloatArray
    places: Mapping[str, tuple[str, ...]]


def patch_poses(scene: MjcfScene, poses: Mapping[str, BodyPose], *, is_everywhere: bool = True) -> PatchedModel:
    """Puts new poses into a scene file.

    Args:
        scene: The file.
        poses: Name of a free body -> its new pose, in the frame of the file.
        is_everywhere: Whether other places that state the same pose change with it; else only the place that was read.

    Raises:
        SceneError: A pose stands where it cannot be changed (``not_patchable``), or the changed file differs in more than
            these poses (``patch_differs``).
    """
    edits = _Edits(scene, is_everywhere=is_everywhere)
    for name, pose in poses.items():
        edits.move(name, pose)
    changed = edits.contents()
    with scene.files.placed(changed) as place:
        model = compile_model(read_spec(place, scene.file.path), scene.file.path)
    qpos = _compare(scene, model, poses)
    return PatchedModel(changed, model, qpos, {name: tuple(found) for name, found in edits.places.items()})


class _Edits:
    """Replacements of bytes in the XML files of a model."""

    def __init__(self, scene: MjcfScene, *, is_everywhere: bool) -> None:
        self._scene, self._model, self._is_everywhere = scene, scene.model, is_everywhere
        self._replaced: dict[str, dict[tuple[int, int], bytes]] = {}
        self._keys: dict[int, list[bytes]] = {}  # the numbers of a keyframe's qpos that changes
        self.places: dict[str, list[str]] = {}
        self._elements = scene.files.elements
        self._bodies = _body_elements(self._elements)
        self._key_elements = [k for k, e in enumerate(self._elements) if e.tag.name == "key"]

    def move(self, name: str, pose: BodyPose) -> None:
        """Changes the pose of a free body at its places."""
        scene, model, at = self._scene, self._model, self._scene.address(name)
        before, now = scene.qpos[at : at + 7], np.array([*pose[0], *wxyz(pose[1])])
        self.places[name] = []
        is_initial = np.allclose(model.qpos0[at : at + 7], before, rtol=0, atol=_SAME_POSE)
        if scene.key < 0 or (self._is_everywhere and is_initial):
            element = self._element_of(name)
            frame = self._frame_of(name, element, model.qpos0[at : at + 7])
            self._change_body(name, element, *(_within(frame, pose) for pose in (before, now)))
            self.places[name].append(f"{element.path}: body")
        for k in range(model.nkey):
            same = self._is_everywhere and np.allclose(model.key_qpos[k, at : at + 7], before, rtol=0, atol=_SAME_POSE)
            if k == scene.key or same:
                self._change_key(k, at, before, now, name, must=k == scene.key)

    def contents(self) -> dict[str, bytes]:
        """The changed files."""
        for k, numbers in self._keys.items():
            element = self._elements[self._key_elements[k]]
            first, last, quote = _attribute(self._scene.files.contents[element.path], element, "qpos") or (0, 0, b"")
            self._replaced.setdefault(element.path, {})[first, last] = quote + b"".join(numbers) + quote
        found = {}
        for path, spans in self._replaced.items():
            content, pieces, at = self._scene.files.contents[path], [], 0
            for (first, last), text in sorted(spans.items()):
                pieces += [content[at:first], text]
                at = last
            found[path] = b"".join([*pieces, content[at:]])
        return found

    def _element_of(self, name: str) -> Element:
        """The element of a free body.

        Raises:
            SceneError: It has none of its own in the world, in a file that can be changed.
        """
        index = self._scene.free_bodies[name]
        names = [_name_of(self._elements[k]) for k in self._bodies]
        there = [self._model.body(k).name for k in range(1, self._model.nbody)]
        if name.startswith("#") or names.count(name) != 1:
            number = self._bodies[index - 1] if names == there else None
        else:
            number = self._bodies[names.index(name)]
        if number is None:
            raise self._refused(
                name, "has no element of its own in the file, as a copy of replicate, attach or composite has none"
            )
        return self._elements[number]

    def _frame_of(self, name: str, element: Element, world: FloatArray) -> tuple[FloatArray, Rotation] | None:
        """The pose of the frames around a body, from its pose (7,) in the world; None if it stands in the world itself.

        Raises:
            SceneError: What is around it is no frame, or its own rotation is not stated as a quaternion (``not_patchable``).
        """
        above, is_framed = element.parent, False
        while self._elements[above].tag.name == "frame":
            above, is_framed = self._elements[above].parent, True
        if self._elements[above].tag.name != "worldbody":
            raise self._refused(name, f"stands in an element {self._elements[above].tag.name}, which moves it too")
        if not is_framed:
            return None
        stated = element.tag.attributes
        if any(other in stated for other in _ORIENTATIONS[1:]):
            raise self._refused(name, "stands in a frame and states its rotation in another way than as quat")
        w, x, y, z = (float(v) for v in stated.get("quat", "1 0 0 0").split())
        own = Rotation.from_quat([x, y, z, w])
        turn = Rotation.from_quat(world[[4, 5, 6, 3]]) * own.inv()
        return world[:3] - turn.apply([float(v) for v in stated.get("pos", "0 0 0").split()]), turn

    def _change_body(self, name: str, element: Element, before: FloatArray, now: FloatArray) -> None:
        content = self._scene.files.contents[element.path]
        spans = self._replaced.setdefault(element.path, {})
        inserted: list[bytes] = []
        kept = np.abs(before[:3] - now[:3]) <= _NO_CHANGE
        if not kept.all():
            self._set(content, element, ("pos",), "pos", now[:3], kept, spans, inserted)
        if not any(np.allclose(before[3:], sign * now[3:], rtol=0, atol=_NO_CHANGE) for sign in (1, -1)):
            self._set(content, element, _ORIENTATIONS, "quat", now[3:], np.zeros(4, bool), spans, inserted)
        if inserted:
            end = element.tag.offset + 1 + len(element.tag.name.encode())
            if not content[element.tag.offset : end] == b"<" + element.tag.name.encode():
                raise self._refused(name, f"stands in {element.path}, which is not in UTF-8")
            spans[end, end] = b"".join(inserted)

    def _set(
        self,
        content: bytes,
        element: Element,
        old: Sequence[str],
        new: str,
        values: FloatArray,
        kept: npt.NDArray[np.bool_],
        spans: dict[tuple[int, int], bytes],
        inserted: list[bytes],
    ) -> None:
        """Replaces one of the old attributes of an element by a new one, or inserts it; kept numbers stay as they are written."""
        text = b" ".join(_number(v) for v in values)
        for attribute in old:
            found = _attribute(content, element, attribute)
            if found is not None:
                first, last, quote = found
                if attribute != new:
                    first = content.rindex(attribute.encode(), element.tag.offset, first)
                    quote = new.encode() + b"=" + quote
                    text += quote[-1:]
                    spans[first, last] = quote + text
                else:
                    pieces = re.split(rb"(\s+)", content[first + 1 : last - 1])
                    numbers = [i for i, piece in enumerate(pieces) if piece.strip()]
                    if len(numbers) == len(values):
                        for i, value, stays in zip(numbers, values, kept, strict=True):
                            pieces[i] = pieces[i] if stays else _number(value)
                        text = b"".join(pieces)
                    spans[first, last] = quote + text + quote
                return
        inserted.append(b" " + new.encode() + b'="' + text + b'"')

    def _change_key(self, k: int, at: int, before: FloatArray, now: FloatArray, name: str, *, must: bool) -> None:
        """Changes the seven numbers of a body in a keyframe."""
        model = self._model
        if len(self._key_elements) != model.nkey:
            if must:
                raise self._refused(name, "has its pose in a keyframe that has no element of its own in the file")
            return
        element = self._elements[self._key_elements[k]]
        content = self._scene.files.contents[element.path]
        found = _attribute(content, element, "qpos")
        where = f"{element.path}: key {model.key(k).name}".rstrip()
        if found is None:  # the keyframe has the initial pose, whatever that is
            if must and not np.allclose(model.qpos0[at : at + 7], before, rtol=0, atol=_SAME_POSE):
                raise self._refused(name, f"has its pose in {where}, which states none")
            return
        if k not in self._keys:
            first, last, _ = found
            pieces = re.split(rb"(\s+)", content[first + 1 : last - 1])
            self._keys[k] = pieces
        pieces = self._keys[k]
        numbers = [i for i, piece in enumerate(pieces) if piece.strip()]
        if len(numbers) != model.nq:
            raise self._refused(name, f"has its pose in {where}, which is written in an unusual way")
        for i in range(7):
            if abs(before[i] - now[i]) > _NO_CHANGE:
                pieces[numbers[at + i]] = _number(float(now[i]))
        self.places[name].append(where)

    def _refused(self, name: str, found: str) -> SceneError:
        path = self._scene.file.path
        return SceneError(
            f"{path}: body {name} {found}, expected a body in worldbody; it cannot be moved in place", "not_patchable"
        )


def _within(frame: tuple[FloatArray, Rotation] | None, pose: FloatArray) -> FloatArray:
    """A pose (7,) in the world as a pose in a frame."""
    if frame is None:
        return pose
    origin, turn = frame
    rotation = turn.inv() * Rotation.from_quat(pose[[4, 5, 6, 3]])
    return np.array([*turn.inv().apply(pose[:3] - origin), *wxyz(quat_of(rotation))])


def _body_elements(elements: Sequence[Element]) -> list[int]:
    """Indices of the elements of bodies in the world, in the order of the model."""
    in_world, found = set(), []
    for k, element in enumerate(elements):
        name = element.tag.name
        if (name == "worldbody" and element.parent == 0) or element.parent in in_world:
            in_world.add(k)
            if name == "body":
                found.append(k)
    return found


def _name_of(element: Element) -> str:
    return element.tag.attributes.get("name", "")


def _attribute(content: bytes, element: Element, name: str) -> tuple[int, int, bytes] | None:
    """Where the value of an attribute stands in a file: first byte, end, both with the quotes; and the quote."""
    if name not in element.tag.attributes:
        return None
    at = element.tag.offset + 1 + len(element.tag.name.encode())
    while True:
        match = _ATTRIBUTE.search(content, at)
        if match is None:
            return None
        if match[1] == name.encode():
            return match.start(2), match.end(2), match[2][:1]
        at = match.end()


def _number(value: float) -> bytes:
    return repr(round(float(value), 12) + 0.0).encode()


def _compare(scene: MjcfScene, model: mujoco.MjModel, poses: Mapping[str, BodyPose]) -> FloatArray:
    """Compares the changed model with the original; returns the joint positions of the repaired poses.

    Raises:
        SceneError: They differ in more than the poses (``patch_differs``).
    """
    before, path = scene.model, scene.file.path
    stays = _places_that_stay(scene, poses)
    for name in _array_names(before):
        one, other = np.asarray(getattr(before, name)), np.asarray(getattr(model, name))
        same = one.shape == other.shape
        if same and name in stays:
            same = np.array_equal(one[stays[name]], other[stays[name]])
        elif same and name not in _DERIVED:
            same = np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
        if not same:
            found = f"{name} of the changed file differs from the original"
            raise SceneError(
                f"{path}: {found}, expected the same but for the poses; the file is left as it is", "patch_differs"
            )
    if (before.names, before.nq, before.nv) != (model.names, model.nq, model.nv):
        raise SceneError(
            f"{path}: the changed file has other elements, expected the same; it is left as it is", "patch_differs"
        )
    return _written_poses(scene, model, poses)


def _places_that_stay(scene: MjcfScene, poses: Mapping[str, BodyPose]) -> dict[str, npt.NDArray[np.bool_]]:
    """Array of the model that holds poses -> which of its places must not change."""
    before = scene.model
    stays = {name: np.ones(np.shape(getattr(before, name)), bool) for name in (*_POSES, *_OF_MASSLESS)}
    for name in poses:
        body, at = scene.free_bodies[name], scene.address(name)
        stays["body_pos"][body] = stays["body_quat"][body] = False
        for array in _OF_MASSLESS if before.body_mass[body] == 0 else ():
            stays[array][body] = False
        for array in ("qpos0", "qpos_spring"):
            stays[array][at : at + 7] = False
        if before.nkey:
            stays["key_qpos"][:, at : at + 7] = False
    return stays


def _written_poses(scene: MjcfScene, model: mujoco.MjModel, poses: Mapping[str, BodyPose]) -> FloatArray:
    """The joint positions of the changed file, which must be those of the given poses.

    Raises:
        SceneError: They are not (``patch_differs``).
    """
    qpos: FloatArray = np.array(model.key_qpos[scene.key] if scene.key >= 0 else model.qpos0)
    expected = scene.qpos.copy()
    for name, (position, quat) in poses.items():
        at = scene.address(name)
        expected[at : at + 7] = [*position, *wxyz(quat)]
        if expected[at + 3 : at + 7] @ qpos[at + 3 : at + 7] < 0:
            expected[at + 3 : at + 7] *= -1
    error = float(np.abs(qpos - expected).max(initial=0.0))
    if error > _EXACT:
        found = f"written poses differ by {error:.1e}"
        raise SceneError(f"{scene.file.path}: {found}, expected at most {_EXACT:g}; the file is left as it is", "patch_differs")
    return qpos


def _array_names(model: mujoco.MjModel) -> list[str]:
    names = [name for name in dir(model) if not name.startswith("_") and name not in ("stat", "vis", "opt", "signature")]
    return [name for name in names if isinstance(getattr(model, name), (np.ndarray, int, float))]
