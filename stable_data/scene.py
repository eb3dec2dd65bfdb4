"""The data model of a tabletop scene: immutable values in SI units, validated when they are created.

Frame: metres, radians; z points up; the table top is z = 0; the origin is the table's near-left corner; +x points right, +y away
from the viewer. Yaw is counter-clockwise about +z; an object at yaw 0 faces -y. Quaternions are xyzw.

An object's pose: ``world = position + Rz(yaw) · R(tilt) · diag(scale) · mesh``, where ``position`` is the centre of the
object's box in its yaw frame. The corrector changes only ``position`` and ``yaw``.

Dimension letters used in shapes: S scenes, N objects, P points, V vertices, F faces, C channels, T tokens.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stable_data.condition import GoalCondition
from stable_data.errors import SceneError

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
Vec3: TypeAlias = tuple[float, float, float]
QuatXyzw: TypeAlias = tuple[float, float, float, float]
Rectangle: TypeAlias = tuple[float, float, float, float]  # x_min, x_max, y_min, y_max

TABLE = "table"
"""The name of the table top where an instance is expected (``SceneObject.support``)."""

_MAX_LISTED = 6  # names that a message lists

UPRIGHT: QuatXyzw = (0.0, 0.0, 0.0, 1.0)


class Stage(StrEnum):
    """The paper's three groups of objects: O^t, O^B and O^b, in the order in which they are generated."""

    TASK = "task"
    IMPORTANT = "important"
    SECONDARY = "secondary"


class RelationKind(StrEnum):
    """The relations of the scene graph. ``on`` and ``in`` depend on contact and containment, the others on boxes.

    ``between`` follows from the directions of two others; only a task states it, the scene graph does not list it.
    """

    ON = "on"
    IN = "in"
    LEFT_OF = "left of"
    RIGHT_OF = "right of"
    IN_FRONT_OF = "in front of"
    BEHIND = "behind"
    ABOVE = "above"
    BELOW = "below"
    FACE_TO = "face to"
    IS_AT = "is at"
    EQUALLY_SPACED = "are equally spaced along"
    BETWEEN = "between"


@dataclass(frozen=True, slots=True, order=True)
class Relation:
    """One edge of the scene graph: ``subject kind target``.

    Attributes:
        subject: Instance; for ``are equally spaced along`` the instances, joined by a comma and a space.
        kind: The relation.
        target: Instance, or ``table``; for ``between`` two instances, joined likewise; for ``face to``, ``is at`` and ``are
            equally spaced along`` a direction, cell or axis.
    """

    subject: str
    kind: RelationKind
    target: str

    def __str__(self) -> str:
        """Returns ``subject kind target``."""
        return f"{self.subject} {self.kind} {self.target}"


@dataclass(frozen=True, slots=True)
class Tabletop:
    """The table: a rectangle at z = 0 from the origin to ``size_xy``.

    Attributes:
        table_type: Kind of table, such as ``office_table``.
        size_xy: Extent along x and y, metres.
        restricted_zone: Rectangle on which nothing may stand (a sink), (x_min, x_max, y_min, y_max), metres.
        clearance: Free height above it, metres, such as to the next board of a shelf; None: no limit.
    """

    table_type: str
    size_xy: tuple[float, float]
    restricted_zone: Rectangle | None = None
    clearance: float | None = None

    def __post_init__(self) -> None:
        """Refuses a rectangle without area."""
        if not all(math.isfinite(s) and s > 0 for s in self.size_xy):
            raise SceneError(f"table has size {self.size_xy}, expected two positive lengths in metres", "zone_invalid")
        zone = self.restricted_zone
        if zone is not None and not (all(map(math.isfinite, zone)) and zone[0] < zone[1] and zone[2] < zone[3]):
            raise SceneError(f"restricted zone is {zone}, expected (x_min, x_max, y_min, y_max)", "zone_invalid")
        if self.clearance is not None and not (math.isfinite(self.clearance) and self.clearance > 0):
            raise SceneError(f"clearance is {self.clearance}, expected a positive height in metres", "zone_invalid")


@dataclass(frozen=True, slots=True)
class SupportFrame:
    """Where the table top of a scene lies on a support, such as a board of a shelf.

    Attributes:
        support: Name of the support; scenes with the same name stand on the same piece.
        surface: Name of the surface, unique on the support.
        origin: The origin of the table's frame in the frame of the support, metres; its z is the height of the surface.
        yaw: Rotation of the table's frame about +z in the frame of the support, radians.
        asset_id: The mesh of the support, in metres; its frame, z up with the centre of its box as the origin, is that of the
            support. None without a mesh.
    """

    support: str
    surface: str
    origin: Vec3
    yaw: float = 0.0
    asset_id: str | None = None

    def __post_init__(self) -> None:
        """Refuses a pose that is not finite."""
        if not all(map(math.isfinite, (*self.origin, self.yaw))):
            raise SceneError(
                f"surface {self.surface} has origin {self.origin} and yaw {self.yaw}, expected finite", "not_finite"
            )


@dataclass(frozen=True, slots=True)
class SceneObject:
    """One object of a scene.

    Attributes:
        instance: Id, unique in the scene, ``<k>_<category>_<n>``.
        category: Kind of object, cleaned words joined by ``_``.
        position: Centre of the box in the yaw frame, metres, world frame.
        yaw: Rotation about +z, radians.
        size: Box in the yaw frame, tilt included, metres.
        asset_id: The mesh, or None if the scene names no usable one.
        scale: Metres per mesh unit along the mesh's own axes (z up), or None: fit the tilted mesh to ``size``.
        tilt_quat_xyzw: Rotation before yaw, unit.
        description: Free text, possibly empty.
        stage: The stage, once the scene is staged.
        support: Instance that carries the object, ``table``, or None if nothing does or it is unknown.
        source: The entry of the file that the object was read from, so that writing loses nothing. Not compared.
    """

    instance: str
    category: str
    position: Vec3
    yaw: float
    size: Vec3
    asset_id: str | None = None
    scale: Vec3 | None = None
    tilt_quat_xyzw: QuatXyzw = UPRIGHT
    description: str = ""
    stage: Stage | None = None
    support: str | None = None
    source: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Refuses values that no geometry can be built on."""
        numbers = (*self.position, self.yaw, *self.size, *(self.scale or ()), *self.tilt_quat_xyzw)
        if not all(map(math.isfinite, numbers)):
            raise SceneError(f"object {self.instance}: pose, size or scale is not finite: {numbers}", "not_finite")
        if min(self.size) < 0 or max(self.size) <= 0:
            raise SceneError(f"object {self.instance}: size is {self.size}, expected positive metres", "size_invalid")
        if self.scale is not None and min(self.scale) <= 0:
            raise SceneError(f"object {self.instance}: scale is {self.scale}, expected positive", "scale_invalid")
        norm = math.sqrt(sum(q * q for q in self.tilt_quat_xyzw))
        if abs(norm - 1) > 1e-6:
            raise SceneError(f"object {self.instance}: tilt quaternion has norm {norm}, expected 1", "rotation_not_unit")

    @property
    def bottom(self) -> float:
        """Height of the lower face of the box, metres, world frame."""
        return self.position[2] - self.size[2] / 2

    @property
    def top(self) -> float:
        """Height of the upper face of the box, metres, world frame."""
        return self.position[2] + self.size[2] / 2

    @property
    def tilt_angle(self) -> float:
        """Angle between the mesh's up axis and the world's up axis, radians."""
        x, y, _, _ = self.tilt_quat_xyzw
        # The last element of the rotation matrix, clipped because rounding may exceed 1.
        return math.acos(max(-1.0, min(1.0, 1 - 2 * (x * x + y * y))))

    def moved(self, position: Vec3, yaw: float) -> "SceneObject":
        """Returns the object at another pose."""
        return replace(self, position=position, yaw=yaw)


@dataclass(frozen=True, slots=True)
class TaskInfo:
    """The task of a scene: MesaTask's keys, and what the instruction entails.

    Attributes:
        environment: The place, a sentence.
        task: The instruction.
        goal: Conditions that hold when the task is done, sentences.
        action_sequence: Primitive actions such as ``Pick(Cup)``.
        objects_cluster: Types of the task objects, such as ``NestingCup``.
        task_objects: Instances of O^t.
        relations: Relations that the instruction entails for the initial scene.
        origin: ``file``, ``template`` or ``model``.
        source: The content of the file, so that writing loses nothing. Not compared.
        conditions: Conditions that hold when the task is done, between instances; none if they are not known.
    """

    environment: str
    task: str
    goal: tuple[str, ...] = ()
    action_sequence: tuple[str, ...] = ()
    objects_cluster: tuple[str, ...] = ()
    task_objects: tuple[str, ...] = ()
    relations: tuple[Relation, ...] = ()
    origin: str = "file"
    source: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    conditions: tuple[GoalCondition, ...] = ()


@dataclass(frozen=True, slots=True)
class Scene:
    """A table, the objects on it, and the task.

    Attributes:
        scene_id: Unique in its dataset.
        table: The table top.
        objects: The objects; instances are unique.
        task: The task info, if there is one.
        relations: The scene graph, once it is computed.
        source: Top-level entries of the file without the objects. Not compared.
        fixed: Instances that belong to the surroundings, such as a robot or a shelf: they are obstacles and may carry objects, but
            do not move, and are not judged themselves.
        frame: The surface of a support that is the table top; None: the table is a piece of its own.
    """

    scene_id: str
    table: Tabletop
    objects: tuple[SceneObject, ...]
    task: TaskInfo | None = None
    relations: tuple[Relation, ...] = ()
    source: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    fixed: frozenset[str] = frozenset()
    frame: SupportFrame | None = None

    @property
    def movable(self) -> tuple[SceneObject, ...]:
        """The objects that do not belong to the surroundings."""
        return tuple(o for o in self.objects if o.instance not in self.fixed) if self.fixed else self.objects

    @property
    def surroundings(self) -> tuple[SceneObject, ...]:
        """The objects that are fixed."""
        return tuple(o for o in self.objects if o.instance in self.fixed)

    def __post_init__(self) -> None:
        """Refuses two objects with the same name, and an object with the name of the table."""
        names = [o.instance for o in self.objects]
        if len(set(names)) < len(names) or TABLE in names:
            twice = sorted(name for name, count in Counter(names).items() if count > 1 or name == TABLE)
            more = f" and {len(twice) - _MAX_LISTED} more" if len(twice) > _MAX_LISTED else ""
            message = f"{self.scene_id}: instances {twice[:_MAX_LISTED]}{more} are not unique, expected one name per object"
            raise SceneError(message, "duplicate_instance")

    def __getitem__(self, instance: str) -> SceneObject:
        """The object with that name."""
        for o in self.objects:
            if o.instance == instance:
                return o
        raise KeyError(instance)

    def poses(self) -> FloatArray:
        """Position and yaw of every object, (N, 4) float64: x, y, z in metres, yaw in radians, world frame."""
        return np.array([(*o.position, o.yaw) for o in self.objects], np.float64).reshape(-1, 4)

    def with_poses(self, poses: npt.ArrayLike) -> "Scene":
        """Returns the scene with its objects at other poses, (N, 4), as :meth:`poses` returns them."""
        rows = np.asarray(poses, np.float64).tolist()
        return replace(
            self, objects=tuple(o.moved((x, y, z), yaw) for o, (x, y, z, yaw) in zip(self.objects, rows, strict=True))
        )
