"""Where a robot stands, on the height of the table top and looking inwards: behind an edge, or, a small one, on the table inside it."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.robot.arm.robots import Robot
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Scene, Tabletop
from stable_data.scene_graph.relations import yawed_rectangle

AUTO = "auto"
"""The setting by which the place follows from the scene."""

EDGES = ("front", "left", "right", "back")
"""The edges of the table."""

CHOSEN_EDGES = EDGES[:3]
"""The edges behind which ``auto`` puts a robot: behind the back edge there often is a wall. One on the table may stand at any edge."""

_GAP = 0.02  # between the base and the edge, metres
_STEP = 0.1  # distance of the places along an edge that are compared, metres
_STEP_ON_TABLE = 0.05  # the same for a robot that stands between the objects
_FREE = 0.01  # between a base on the table and the objects, metres
_HIGH, _AHEAD, _ASIDE = 0.25, 0.65, 0.2  # of the space of the arm at its start, as shares of the reach
_COMFORT = 0.8  # share of the reach that is better than the rest


@dataclass(frozen=True, slots=True)
class Mount:
    """Pose of a robot's base in the frame of the scene; its x axis points over the table.

    Attributes:
        x: Metres.
        y: Metres.
        z: Metres.
        yaw: Radians.
        edge: The edge of the table at which it stands.
    """

    x: float
    y: float
    z: float
    yaw: float
    edge: str

    @property
    def rotation(self) -> FloatArray:
        """Scene from base, (3, 3)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def position(self) -> FloatArray:
        """Of the base, (3,)."""
        return np.array([self.x, self.y, self.z])

    def to_base(self, points: FloatArray) -> FloatArray:
        """Converts points (..., 3) from the frame of the scene to that of the base."""
        return np.asarray((points - self.position) @ self.rotation)

    def to_scene(self, points: FloatArray) -> FloatArray:
        """Converts points (..., 3) from the frame of the base to that of the scene."""
        return np.asarray(points @ self.rotation.T + self.position)


def mount_at(robot: Robot, table: Tabletop, edge: str, share: float = 0.5) -> Mount:
    """Returns the mount at an edge: behind it, or just inside it if the robot stands on the table.

    Args:
        robot: The robot.
        table: The table.
        edge: One of EDGES.
        share: Place along the edge, from 0 (its left or front end) to 1. A base on the table stays on it also at the ends.

    Raises:
        ConfigError: There is no such edge, or the share is not from 0 to 1 (``setting_invalid``).
    """
    if edge not in EDGES or not 0 <= share <= 1:
        raise ConfigError(
            f"mount is {quote_value(f'{edge}:{share:g}')}, expected auto or one of {', '.join(EDGES)}, "
            "with a share from 0 to 1 after a colon if not in the middle",
            "setting_invalid",
        )
    (width, depth), base = table.size_xy, robot.table_base
    length = width if edge in ("front", "back") else depth
    along, inside = share * length, -(robot.base_front + _GAP)
    if base is not None:
        along, inside = max(min(along, length - base.half_width), min(base.half_width, length / 2)), base.back + _GAP
    x, y, yaw = {
        "front": (along, inside, math.pi / 2),
        "back": (along, depth - inside, -math.pi / 2),
        "left": (inside, along, 0.0),
        "right": (width - inside, along, math.pi),
    }[edge]
    return Mount(x, y, 0.0, yaw, edge)


def mount_of(
    robot: Robot, scene: Scene, setting: str = AUTO, wanted: Iterable[str] = (), places: FloatArray | None = None
) -> Mount:
    """Returns the mount that a setting asks for.

    Args:
        robot: The robot.
        scene: The scene.
        setting: ``auto`` (:func:`best_mount`), an edge, or an edge and a share of its length, such as ``front:0.25``.
        wanted: See :func:`best_mount`.
        places: See :func:`best_mount`.

    Raises:
        ConfigError: The setting is none of these (``setting_invalid``).
    """
    place = parse_mount(setting)
    return best_mount(robot, scene, wanted, places) if place is None else mount_at(robot, scene.table, *place)


def parse_mount(setting: str) -> tuple[str, float] | None:
    """Returns the edge and the share of its length of a setting; None for ``auto``.

    Raises:
        ConfigError: The setting is none (``setting_invalid``).
    """
    if setting == AUTO:
        return None
    edge, _, number = setting.partition(":")
    try:
        share = float(number or 0.5)
    except ValueError:
        share = math.nan
    if edge not in EDGES or not 0 <= share <= 1:
        raise ConfigError(
            f"mount is {quote_value(setting)}, expected auto or one of {', '.join(EDGES)}, "
            "with a share from 0 to 1 after a colon if not in the middle",
            "setting_invalid",
        )
    return edge, share


def mount_setting(mount: Mount, table: Tabletop) -> str:
    """Returns the setting that gives a mount again, such as ``front:0.25``; the share has four digits."""
    along, length = (mount.x, table.size_xy[0]) if mount.edge in ("front", "back") else (mount.y, table.size_xy[1])
    return f"{mount.edge}:{along / length:.4g}"


def best_mount(robot: Robot, scene: Scene, wanted: Iterable[str] = (), places: FloatArray | None = None) -> Mount:
    """Returns the mount from which most of the wanted objects, and then most of all, are in reach.

    Args:
        robot: The robot.
        scene: The scene.
        wanted: Instances that have to be in reach; none: the task objects of the scene.
        places: Further places that have to be in reach, (P, 2), metres, frame of the scene.

    Returns:
        The first one of the best, in the order front, left, right (and back, for a robot on the table), and from the middle of an edge to
        its ends. Places where something high stands where the arm is at its start, or anything where its base would stand, are left out,
        if there are others.
    """
    names = frozenset(wanted) or frozenset(() if scene.task is None else scene.task.task_objects)
    objects = scene.movable
    centres = np.array([o.position[:2] for o in objects], np.float64).reshape(-1, 2)
    is_wanted = np.array([o.instance in names for o in objects], bool)
    if places is not None:
        centres = np.concatenate([centres, places[:, :2]])
        is_wanted = np.concatenate([is_wanted, np.ones(len(places), bool)])
    best, best_score = mount_at(robot, scene.table, EDGES[0]), (-1.0, -1.0, -1.0)
    edges, step = (CHOSEN_EDGES, _STEP) if robot.table_base is None else (EDGES, _STEP_ON_TABLE)
    for edge in edges:
        length = scene.table.size_xy[0 if edge in ("front", "back") else 1]
        for share in _shares(length, step):
            mount = mount_at(robot, scene.table, edge, share)
            if _is_blocked(robot, mount, scene) or _is_taken(robot, mount, scene):
                continue
            in_reach, is_easy = _in_reach(robot, mount, centres)
            score = (float((in_reach & is_wanted).sum()), float((is_easy & is_wanted).sum()), float(is_easy.sum()))
            if score > best_score:
                best, best_score = mount, score
    return best


def _is_blocked(robot: Robot, mount: Mount, scene: Scene) -> bool:
    """Whether something high stands where the arm is at its start."""
    for o in scene.objects:
        if o.top > _HIGH * robot.reach:
            x, y, _ = mount.to_base(np.array(o.position))
            half = max(o.size[:2]) / 2
            if -half < x < _AHEAD * robot.reach + half and abs(y) < _ASIDE * robot.reach + half:
                return True
    return False


def _is_taken(robot: Robot, mount: Mount, scene: Scene) -> bool:
    """Whether an object stands where the base would be on the table."""
    base = robot.table_base
    if base is None:
        return False
    x, y = (-base.back - _FREE, robot.base_front + _FREE), (-base.half_width - _FREE, base.half_width + _FREE)
    outline = shapely.box(x[0], y[0], x[1], y[1])
    corners = (rotate_xy(yawed_rectangle(o) - mount.position[:2], -mount.yaw) for o in scene.objects)
    return any(outline.intersects(shapely.Polygon(c)) for c in corners)


def _shares(length: float, step: float) -> Sequence[float]:
    """Places along an edge, the middle first."""
    count = max(0, int((length / 2 - step) / step))
    steps = [k * step / length for k in range(1, count + 1)]
    return [0.5, *(0.5 + sign * step for step in steps for sign in (-1, 1))]


def _in_reach(robot: Robot, mount: Mount, centres: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Which places (N, 2) a robot can reach by their distance, and which easily."""
    local = rotate_xy(centres - mount.position[:2], -mount.yaw)
    distance = np.linalg.norm(local, axis=1)
    in_reach = (distance >= robot.too_near) & (distance <= robot.reach)
    return in_reach, in_reach & (distance <= _COMFORT * robot.reach)
