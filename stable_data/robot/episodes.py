"""Episodes: what a robot observed and did in one attempt at a task, and the rows of the table ``episodes`` that hold them."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stable_data.errors import StableDataError
from stable_data.geometry.images import decode_png
from stable_data.json_text import json_value, quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.storage.row_groups import SPLITS, TableFiles, row_slices, rows_from_table
from stable_data.storage.run_folder import Uri
from stable_data.storage.schemas import REQUIRED, SCHEMAS, Row

FloatArray32: TypeAlias = npt.NDArray[np.float32]

_CAMERA = re.compile(r"[A-Za-z0-9_-]+")
_PNG_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
_RGB = b"\x08\x02"  # bit depth 8, colour type RGB
_NAMES = ("state_names", "environment_state_names", "action_names", "instances")
_UNIT = 1e-3  # largest difference of a quaternion's norm from 1


class EpisodeError(StableDataError):
    """An episode that cannot be used."""


@dataclass(frozen=True, slots=True)
class EpisodeFeatures:
    """What the numbers and pictures of an episode are; a dataset for training has one of these.

    Attributes:
        robot: Name of the robot.
        fps: Actions a second.
        control: Meaning of an action, such as ``joint`` or ``ee``.
        state_names: Names of the S numbers of a state of the robot.
        environment_state_names: Names of the E numbers of a state of the environment.
        action_names: Names of the A numbers of an action.
        cameras: Names of the cameras.
        image_size: Height and width of the pictures, pixels; None without pictures.
    """

    robot: str
    fps: float
    control: str
    state_names: tuple[str, ...]
    environment_state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    cameras: tuple[str, ...] = ()
    image_size: tuple[int, int] | None = None

    def check_same(self, other: "EpisodeFeatures", episode_id: str) -> None:
        """Refuses an episode with other features.

        Args:
            other: The features of the episode.
            episode_id: The episode.

        Raises:
            EpisodeError: A feature differs (``episodes_mixed``).
        """
        for name in self.__slots__:
            was, now = getattr(self, name), getattr(other, name)
            if was != now:
                raise EpisodeError(
                    f"{episode_id}: {name} is {quote_value(now)}, expected {quote_value(was)} as in the first episode; select episodes of "
                    "one kind with a condition on robot, fps, control or task_kind",
                    "episodes_mixed",
                )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Episode:
    """One attempt at a task: T actions, and what was observed before each of them.

    Arrays are converted to float32 and made read-only.

    Attributes:
        episode_id: Identifier, ``<scene_id>/<number>``.
        scene_id: The scene.
        seed: Seed of the episode.
        number: Number of the episode of this scene, from 0.
        robot: Name of the robot.
        task_kind: Kind of the task, such as ``pick``, ``place_on`` or ``stack``.
        instruction: Instruction of the task.
        success: Whether the task was done at the end.
        reason: Why it was not done; None if and only if it was.
        fps: Actions a second.
        control: Meaning of an action, such as ``joint`` or ``ee``.
        state_names: Names of the S numbers of a state of the robot, S >= 1.
        environment_state_names: Names of the E numbers of a state of the environment.
        action_names: Names of the A numbers of an action, A >= 1.
        states: States of the robot before each action, (T, S) float32.
        environment_states: States of the environment before each action, (T, E) float32.
        actions: Actions, (T, A) float32.
        rewards: Reward of each action, (T,) float32.
        instances: Names of the N objects.
        object_poses: Position (metres) and quaternion (xyzw) of each object, before the first action and after each one,
            (T + 1, N, 7) float32, frame of the scene.
        pictures: Camera -> T PNG files of 8-bit RGB, before each action.
        image_size: Height and width of the pictures, pixels; None if and only if there are no pictures.
        randomization: What the domain randomisation drew, a JSON object as text; None without one.
        split: Split of the scene; None if it has none.
        policy: Name of the policy that acted; None: the scripted expert.
        lead: Name of the policy that acted before the first action; None: none did, the episode begins at the reset.
        asset_ids: Asset of each of the instances, empty for one that has none; None: not known.
        subjects: The instances that the steps of the goal act on; None: not known.

    Raises:
        EpisodeError: A value is missing, not finite or not as described (``episode_invalid``).
    """

    episode_id: str
    scene_id: str
    seed: int
    number: int
    robot: str
    task_kind: str
    instruction: str
    success: bool
    reason: str | None
    fps: float
    control: str
    state_names: tuple[str, ...]
    environment_state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    states: FloatArray32
    environment_states: FloatArray32
    actions: FloatArray32
    rewards: FloatArray32
    instances: tuple[str, ...]
    object_poses: FloatArray32
    pictures: Mapping[str, tuple[bytes, ...]] = field(default_factory=dict)
    image_size: tuple[int, int] | None = None
    randomization: str | None = None
    split: str | None = None
    policy: str | None = None
    lead: str | None = None
    asset_ids: tuple[str, ...] | None = None
    subjects: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        self._check_texts()
        self._check_origin()
        num_steps = np.shape(self.actions)[0] if np.ndim(self.actions) else 0
        if num_steps < 1:
            raise self._invalid(f"actions has shape {np.shape(self.actions)}", "at least one action, (T, A)")
        shapes = {
            "states": (num_steps, len(self.state_names)),
            "environment_states": (num_steps, len(self.environment_state_names)),
            "actions": (num_steps, len(self.action_names)),
            "rewards": (num_steps,),
            "object_poses": (num_steps + 1, len(self.instances), 7),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, self._checked(name, shape))
        norms = np.linalg.norm(self.object_poses[..., 3:], axis=-1)
        if norms.size and np.abs(norms - 1).max() > _UNIT:
            raise self._invalid(
                f"object_poses has a quaternion of norm {norms.flat[np.abs(norms - 1).argmax()]:.4g}", "norm 1, order xyzw"
            )
        object.__setattr__(self, "pictures", {name: tuple(files) for name, files in self.pictures.items()})
        self._check_pictures(num_steps)

    @property
    def num_steps(self) -> int:
        """Number of actions T."""
        return len(self.actions)

    @property
    def subject_assets(self) -> tuple[str, ...] | None:
        """Assets of the subjects; None: not known."""
        if self.asset_ids is None or self.subjects is None:
            return None
        return tuple(self.asset_ids[self.instances.index(name)] for name in self.subjects)

    @property
    def features(self) -> EpisodeFeatures:
        """What its numbers and pictures are."""
        return EpisodeFeatures(
            self.robot,
            self.fps,
            self.control,
            self.state_names,
            self.environment_state_names,
            self.action_names,
            tuple(self.pictures),
            self.image_size,
        )

    def decoded_picture(self, camera: str, number: int) -> npt.NDArray[np.uint8]:
        """Returns a picture, (H, W, 3) uint8.

        Raises:
            EpisodeError: It cannot be decoded (``episode_invalid``).
        """
        try:
            return decode_png(self.pictures[camera][number])
        except ValueError as error:
            raise EpisodeError(
                f"{self.episode_id}: picture {number} of camera {camera} {error}; record it again", "episode_invalid"
            ) from error

    def _check_texts(self) -> None:
        for name in ("scene_id", "robot", "task_kind", "instruction", "control"):
            if not getattr(self, name).strip():
                raise self._invalid(f"{name} is empty", "a text")
        if self.episode_id != f"{self.scene_id}/{self.number}":
            raise self._invalid(f"episode_id is {quote_value(self.episode_id)}", f"{self.scene_id}/{self.number}")
        for name in ("seed", "number"):
            if not 0 <= getattr(self, name) < 2**63:
                raise self._invalid(f"{name} is {getattr(self, name)}", "0 to 2^63 - 1")
        if self.success != (self.reason is None):
            raise self._invalid(
                f"success is {self.success} and reason is {quote_value(self.reason)}", "a reason for a failure alone"
            )
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise self._invalid(f"fps is {self.fps}", "a positive number of actions a second")
        for name in _NAMES:
            names = tuple(getattr(self, name))
            object.__setattr__(self, name, names)
            if len(set(names)) < len(names) or "" in names:
                raise self._invalid(f"{name} is {quote_value(list(names))}", "different names")
        if self.split is not None and self.split not in SPLITS:
            raise self._invalid(f"split is {quote_value(self.split)}", f"one of {', '.join(SPLITS)}, or None")
        if self.randomization is not None and not _is_json_object(self.randomization):
            raise self._invalid(f"randomization is {quote_value(self.randomization)}", "a JSON object as text")

    def _check_origin(self) -> None:
        for name in ("asset_ids", "subjects"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.asset_ids is not None and len(self.asset_ids) != len(self.instances):
            raise self._invalid(f"asset_ids has {len(self.asset_ids)} ids", f"{len(self.instances)}, one for each instance")
        if strange := set(self.subjects or ()) - set(self.instances):
            raise self._invalid(f"subjects has {quote_value(min(strange))}", "some of the instances")
        for name, none in {"policy": "the scripted expert", "lead": "no policy"}.items():
            found = getattr(self, name)
            if found is not None and not found.strip():
                raise self._invalid(f"{name} is empty", f"a name, or None for {none}")

    def _checked(self, name: str, shape: tuple[int, ...]) -> FloatArray32:
        with np.errstate(over="ignore"):  # beyond the range of float32: not finite
            values = np.array(getattr(self, name), np.float32)
        if values.shape != shape or (name in ("states", "actions") and not shape[1]):
            names = "at least one name" if values.shape == shape else f"{shape} for its names and {shape[0]} rows"
            raise self._invalid(f"{name} has shape {values.shape}", names)
        if not np.isfinite(values).all():
            place = tuple(int(k) for k in np.argwhere(~np.isfinite(values))[0])
            raise self._invalid(f"{name}{list(place)} is {values[place]}", "finite numbers")
        values.setflags(write=False)
        return values

    def _check_pictures(self, num_steps: int) -> None:
        if (self.image_size is None) == bool(self.pictures):
            found = f"image_size is {self.image_size} with {len(self.pictures)} cameras"
            raise self._invalid(found, "a size if and only if there are pictures")
        if self.image_size is None:
            return
        height, width = map(int, self.image_size)
        object.__setattr__(self, "image_size", (height, width))
        most = LIMITS.table.max_picture_side
        if not (1 <= height <= most and 1 <= width <= most):
            side = at_most(LIMITS.table, "max_picture_side", "pixels")
            raise self._invalid(f"image_size is {(height, width)}", f"sides of at least 1 and {side}")
        head = _PNG_START + width.to_bytes(4, "big") + height.to_bytes(4, "big") + _RGB
        for camera, files in self.pictures.items():
            if not _CAMERA.fullmatch(camera):
                raise self._invalid(f"a camera is {quote_value(camera)}", "a name of letters, digits, _ and -")
            if len(files) != num_steps:
                raise self._invalid(f"camera {camera} has {len(files)} pictures", f"{num_steps}, one for each action")
            for k, content in enumerate(files):
                if not content.startswith(head):
                    raise self._invalid(
                        f"picture {k} of camera {camera} is another file", f"PNG, 8-bit RGB, {height} x {width}"
                    )

    def _invalid(self, found: str, expected: str) -> EpisodeError:
        return EpisodeError(f"{self.episode_id}: {found}, expected {expected}", "episode_invalid")


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json_value(text), dict)
    except ValueError:
        return False


def episode_row(episode: Episode) -> Row:
    """Returns an episode as a row of ``episodes``; arrays are flat."""
    names = [name for name in SCHEMAS["episodes"].names if name not in ("num_steps", "image_size", "pictures")]
    row = {name: getattr(episode, name) for name in names} | {"num_steps": episode.num_steps}
    for name in ("states", "environment_states", "actions", "object_poses"):
        row[name] = row[name].ravel()
    row["image_size"] = None if episode.image_size is None else list(episode.image_size)
    cameras = [{"camera": camera, "images": list(files)} for camera, files in episode.pictures.items()]
    return row | {"pictures": cameras or None}


def episode_from_row(row: Mapping[str, Any]) -> Episode:
    """Returns the episode of a row that :func:`episode_row` made; without the column ``pictures``, one without pictures.

    Raises:
        EpisodeError: The row is not of an episode (``episode_invalid``).
    """
    _refuse_nulls(row)
    num_steps, values = row["num_steps"], dict[str, Any]()
    if num_steps < 1:
        raise EpisodeError(f"{row['episode_id']}: num_steps is {num_steps}, expected at least 1", "episode_invalid")
    shapes = {
        "states": (num_steps, len(row["state_names"])),
        "environment_states": (num_steps, len(row["environment_state_names"])),
        "actions": (num_steps, len(row["action_names"])),
        "object_poses": (num_steps + 1, len(row["instances"]), 7),
    }
    for name, shape in shapes.items():
        found = np.asarray(row[name], np.float32)
        if found.size != math.prod(shape):
            raise EpisodeError(
                f"{row['episode_id']}: {name} has {found.size} numbers, expected {math.prod(shape)}, {shape}", "episode_invalid"
            )
        values[name] = found.reshape(shape)
    for name in _NAMES:
        values[name] = tuple(row[name])
    names = ("scene_id", "seed", "number", "robot", "task_kind", "instruction", "success", "fps", "control", "rewards")
    values |= {name: row[name] for name in names} | {
        name: row.get(name) for name in ("reason", "randomization", "split", "policy", "lead", "asset_ids", "subjects")
    }
    size, cameras = row.get("image_size"), row.get("pictures") or []
    return Episode(
        episode_id=row["episode_id"],
        **values,
        pictures={camera["camera"]: tuple(camera["images"]) for camera in cameras},
        image_size=(size[0], size[1]) if size and cameras else None,
    )


def _refuse_nulls(row: Mapping[str, Any]) -> None:
    """Refuses a row with a null where an episode has a value."""
    found = [name for name in REQUIRED["episodes"] if row[name] is None]
    found += [name for name in (*_NAMES, "asset_ids", "subjects") if None in (row.get(name) or ())]
    for camera in row.get("pictures") or ():
        if camera is None or camera["camera"] is None or camera["images"] is None or None in camera["images"]:
            found.append("pictures")
    size = row.get("image_size")
    if None in (size or ()):
        found.append("image_size")
    elif size is not None and len(size) != 2:
        raise EpisodeError(f"{row['episode_id']}: image_size has {len(size)} numbers, expected 2", "episode_invalid")
    if found:
        raise EpisodeError(
            f"{row['episode_id']}: {found[0]} is null, or a part of it is, expected all values; record the episode again",
            "episode_invalid",
        )


def read_episodes(
    uri: Uri | Sequence[Uri], *, where: str | None = None, split: str | None = None, with_pictures: bool = True
) -> Iterator[Episode]:
    """Yields the episodes of a run, in the order of its files; a few are in memory at a time.

    Args:
        uri: The run folder, or several.
        where: A condition such as ``success and task_kind == "pick"`` (:mod:`stable_data.storage.filter_expression`); None: all.
        split: Split of the scenes; None: all.
        with_pictures: Whether pictures are read.

    Raises:
        ConfigError: A run has no table ``episodes``, it cannot be read, or the condition is not valid.
        EpisodeError: A row is not of an episode.
    """
    names = [name for name in SCHEMAS["episodes"].names if with_pictures or name not in ("pictures", "image_size")]
    files = TableFiles(uri, "episodes", None if with_pictures else names, split, where)
    for group in range(len(files.groups)):
        for part in row_slices(files.read([group])):
            yield from map(episode_from_row, rows_from_table(part))
