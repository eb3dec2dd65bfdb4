"""Antipodal grasps of a mesh: two opposite points of its surface between which the fingers hold it.

Frame: the object's body frame, which is its yaw frame, centred on its box.
"""

from dataclasses import dataclass

import igl
import numpy as np

from stable_data.geometry.mesh import unit_normals
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import sample_oriented_surface
from stable_data.robot.arm.kinematics import BoolArray
from stable_data.robot.arm.robots import Hand
from stable_data.scene import FloatArray, IntArray

_RAY_SPREAD = 0.12  # standard deviation of the directions, radians
_START = 1e-5  # where a ray starts below the surface, metres
_POINTS = 700  # samples of the surface
_CONE = np.cos(
    np.radians(20.0)
)  # of the angle between the closing direction and the normals; friction 0.8 holds up to 38 degrees
_NARROWEST = 1e-3  # metres
_SLACK = 0.006  # the open hand is wider than the object by at least this, metres
_MOST_PAIRS = 240
_TURNS = 16  # directions of approach around the closing direction
_STEEPEST = np.cos(np.radians(80.0))  # the approach points down at least this much
_APART_POSITION, _APART_ANGLE = 0.012, np.radians(25.0)  # grasps nearer than both are the same
PRESHAPE = 0.02
"""How much wider than the object the hand is opened where it cannot be opened fully, metres."""

_CHUNK = 512
_TIP = 0.002  # free height below the finger tips, metres


@dataclass(frozen=True, slots=True, eq=False)
class Grasps:
    """Poses of the hand.

    Attributes:
        positions: Middle between the fingers, (K, 3) float64, metres: the origin of the tool frame, unless one finger stands still.
        rotations: Of the tool frame, (K, 3, 3): z is the approach, y the closing direction.
        widths: Distance between the two points of the surface, (K,), metres.
        scores: How good they are before any trial, (K,), higher is better; they are sorted by it.
    """

    positions: FloatArray
    rotations: FloatArray
    widths: FloatArray
    scores: FloatArray

    def __len__(self) -> int:
        return len(self.widths)


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """Pairs of opposite points of a surface.

    Attributes:
        centres: Their middles, (K, 3) float64, metres, body frame.
        directions: Unit vectors from one point to the other, (K, 3).
        widths: Their distances, (K,), metres.
        quality: Smaller cosine of the angles between the direction and the normals, (K,).
        center_of_mass: Of the object, or the middle of its surface points, (3,).
        size: Of its box, (3,), metres.
        surface: Points of the surface, (P, 3), metres.
    """

    centres: FloatArray
    directions: FloatArray
    widths: FloatArray
    quality: FloatArray
    center_of_mass: FloatArray
    size: FloatArray
    surface: FloatArray


def opposite_pairs(shape: Shape, hand: Hand) -> PointPairs:
    """Finds pairs of points between which a hand can hold a shape.

    Args:
        shape: The object.
        hand: The hand.

    Returns:
        At most a few hundred pairs spread over the surface; none if the object is nowhere narrow enough, or has no surface.
    """
    points, normals = sample_oriented_surface(shape.ordered_mesh, _POINTS)
    middle = points.mean(axis=0) if shape.center_of_mass is None else shape.center_of_mass
    start, direction, widths, facing = _inward_rays(shape, points, normals)
    quality = np.minimum(facing[:, 0], facing[:, 1])
    good = (quality >= _CONE) & (widths >= _NARROWEST) & (widths <= hand.max_opening - _SLACK)
    start, direction, widths, quality = start[good], direction[good], widths[good], quality[good]
    centres = start + direction * widths[:, None] / 2
    order = np.argsort(-quality, kind="stable")
    order = _spread(centres[order], direction[order], order)
    return PointPairs(centres[order], direction[order], widths[order], quality[order], middle, np.asarray(shape.size), points)


def _inward_rays(
    shape: Shape, points: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Where rays from points of a surface into the body leave it again.

    Args:
        shape: The body.
        points: (P, 3), metres.
        normals: Outward, (P, 3).

    Returns:
        For each exit of a ray its start (R, 3), unit direction (R, 3), length (R,), and the cosines (R, 2) of the angles between
        the direction and the normals at both ends, turned so that 1 is a right angle between direction and both surfaces.
    """
    tree = igl.AABB()
    tree.init(shape.vertices, shape.faces)
    # Along the normal, and once slightly off it: grasps need not be exact.
    noise = np.random.default_rng(0).normal(0.0, _RAY_SPREAD, points.shape)
    aside = normals + noise
    rays = -np.concatenate([normals, aside / np.linalg.norm(aside, axis=1, keepdims=True)])
    begins, outward = np.tile(points, (2, 1)), np.tile(normals, (2, 1))
    hits = tree.intersect_ray(shape.vertices, shape.faces, begins + _START * rays, rays)
    ray = np.repeat(np.arange(len(rays)), [len(found) for found in hits])
    if not len(ray):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2))
    flat = np.array([(face, distance) for found in hits for face, distance, *_ in found])
    far, _ = unit_normals(shape.vertices[shape.faces[flat[:, 0].astype(np.int64)]])
    direction = rays[ray]
    cosines = np.stack([-(outward[ray] * direction).sum(1), (far * direction).sum(1)], axis=1)
    return begins[ray], direction, flat[:, 1] + _START, cosines


def _spread(centres: FloatArray, directions: FloatArray, order: IntArray) -> IntArray:
    """The best pair of each small cell of position and direction, at most as many as allowed."""
    seen: set[tuple[int, ...]] = set()
    kept = []
    folded = _folded(directions)
    cells = np.concatenate([np.round(centres / _APART_POSITION), np.round(folded / _APART_ANGLE)], axis=1).astype(int)
    for row, cell in zip(order.tolist(), map(tuple, cells.tolist()), strict=True):
        if cell not in seen:
            seen.add(cell)
            kept.append(row)
            if len(kept) == _MOST_PAIRS:
                break
    return np.array(kept, np.int64)


def _folded(directions: FloatArray) -> FloatArray:
    """The directions with the largest part positive, because a pair has no first point."""
    largest = (
        np.take_along_axis(directions, abs(directions).argmax(axis=1)[:, None], axis=1) if len(directions) else np.ones((0, 1))
    )
    return np.asarray(directions * np.where(largest < 0, -1.0, 1.0))


def grasps_at(
    pairs: PointPairs,
    position: FloatArray,
    rotation: FloatArray,
    hand: Hand,
    *,
    towards: FloatArray | None = None,
    limit: int = 96,
) -> Grasps:
    """Turns pairs into poses of the hand for an object at a pose.

    Args:
        pairs: Pairs of the object.
        position: Of its body, (3,), metres, frame of the scene.
        rotation: Scene from body, (3, 3).
        hand: The hand.
        towards: Horizontal direction from the robot to the object, (3,); the hand does not point back to the robot. None: any.
        limit: How many are returned at most.

    Returns:
        Poses in the frame of the scene, best first: from above, near the centre of mass, well between the fingers.
    """
    count = len(pairs.widths)
    if not count:
        return Grasps(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0))
    centres, closing = pairs.centres @ rotation.T + position, pairs.directions @ rotation.T
    first, second = _across(closing)
    angles = 2 * np.pi * np.arange(_TURNS) / _TURNS
    # (K, A, 3): directions of approach around the closing direction, the first one pointing down as far as possible.
    approach = np.cos(angles)[None, :, None] * first[:, None] + np.sin(angles)[None, :, None] * second[:, None]
    flat = approach.reshape(-1, 3)
    pair = np.repeat(np.arange(count), _TURNS)
    down = -flat[:, 2]
    keep = down >= _STEEPEST
    if towards is not None:
        keep &= flat @ towards > -0.6
    flat, pair, down = flat[keep], pair[keep], down[keep]
    y = closing[pair]
    rotations = np.stack([np.cross(y, flat), y, flat], axis=2)
    tool = centres[pair].copy()
    # Above the table: the tips reach beyond the tool frame.
    lowest = tool[:, 2] - _reach_down(flat, hand)
    tool -= flat * (np.clip(_TIP - lowest, 0.0, None) / np.maximum(down, 0.2))[:, None]
    shifted = np.linalg.norm(tool - centres[pair], axis=1)
    diagonal = float(np.linalg.norm(pairs.size)) + 1e-9
    away = np.linalg.norm((centres[pair] - (pairs.center_of_mass @ rotation.T + position)), axis=1) / diagonal
    scores = (
        1.0 * down
        - 1.6 * away
        + 0.8 * (pairs.quality[pair] - 1.0) / (1 - _CONE)
        - 0.5 * np.clip(pairs.widths[pair] / (hand.max_opening - _SLACK) - 0.8, 0.0, None) / 0.2
        - 0.5 * (pairs.widths[pair] < 0.004)
        - _sideways(y, towards)
    )
    order = np.flatnonzero(shifted <= hand.pad)
    order = order[np.argsort(-scores[order], kind="stable")]
    surface = pairs.surface @ rotation.T + position
    order = _fitting(tool, rotations, pairs.widths[pair], order, surface, hand, limit)
    return Grasps(tool[order], rotations[order], pairs.widths[pair[order]], scores[order])


def _sideways(closing: FloatArray, towards: FloatArray | None) -> FloatArray | float:
    """What a closing direction costs that is not the natural one, across the direction from the robot to the object.

    An object that is equally good from all sides is so always grasped in the same way, which policies learn easily.
    """
    if towards is None:
        return 0.0
    lateral = np.array([-towards[1], towards[0], 0.0])
    return np.asarray(0.4 * (1 - abs(closing @ lateral)))


def _across(closing: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors at right angles to each direction and to each other; the first points down as far as possible."""
    down = np.array([0.0, 0.0, -1.0])
    first = down - closing * (closing @ down)[:, None]
    length = np.linalg.norm(first, axis=1, keepdims=True)
    other = np.array([1.0, 0.0, 0.0]) - closing * closing[:, :1]
    first = np.where(
        length > 1e-3, first / np.maximum(length, 1e-9), other / np.maximum(np.linalg.norm(other, axis=1, keepdims=True), 1e-9)
    )
    return first, np.cross(closing, first)


def _reach_down(approach: FloatArray, hand: Hand) -> FloatArray:
    """How far the tips reach below the origin of the tool frame, metres."""
    sideways = np.sqrt(np.clip(1 - approach[:, 2] ** 2, 0.0, 1.0))
    return np.asarray(hand.tip * np.clip(-approach[:, 2], 0.0, 1.0) + hand.half_width * sideways)


def _fitting(
    tool: FloatArray,
    rotations: FloatArray,
    widths: FloatArray,
    order: IntArray,
    surface: FloatArray,
    hand: Hand,
    limit: int,
) -> IntArray:
    """The best ones, each different enough from the better ones, in which the hand does not meet the object itself."""
    kept: list[int] = []
    for start in range(0, len(order), _CHUNK):
        rows = order[start : start + _CHUNK]
        rows = rows[_fits_hand(tool[rows], rotations[rows], widths[rows], surface, hand)]
        for row in rows.tolist():
            near = np.linalg.norm(tool[kept] - tool[row], axis=1) < _APART_POSITION
            if not (near & (rotations[kept, :, 2] @ rotations[row, :, 2] > np.cos(_APART_ANGLE))).any():
                kept.append(row)
                if len(kept) == limit:
                    return np.array(kept, np.int64)
    return np.array(kept, np.int64)


def _fits_hand(tool: FloatArray, rotations: FloatArray, widths: FloatArray, surface: FloatArray, hand: Hand) -> BoolArray:
    """In which poses no point of the surface is in the palm or in the fingers, open fully or a little wider than the object.

    A first, coarse look, as if both fingers moved; the arm is then checked with its own shapes.
    """
    local = np.einsum("kpi,kij->kpj", surface[None] - tool[:, None], rotations)  # the surface in the tool frames
    x, y, z = abs(local[..., 0]), abs(local[..., 1]), local[..., 2]
    across, along = hand.palm_half
    in_palm = ((z < -hand.palm) & (x < across) & (y < along)).any(axis=1)
    beside = (x < hand.half_width) & (z >= -hand.palm) & (z < hand.tip)

    def meets(half: FloatArray | float) -> BoolArray:
        side = np.asarray(half).reshape(-1, 1)
        return np.asarray((beside & (y > side) & (y < side + hand.thickness)).any(axis=1))

    wide = np.minimum(hand.max_opening, widths + PRESHAPE) / 2
    return np.asarray(~in_palm & ~(meets(hand.max_opening / 2) & meets(wide)))
