"""What carries or holds what in a layout: what a correction keeps together.

A layout that is to be corrected need not be at rest: contents stick in walls, and what stood on a plate has slid off half of
it. What carries an object that is above the table is therefore, in this order: what the scene's own relations say; what it
rests on as it is; of all that it touches from above, is in, or is nearly over, what it comes to rest on with the least change
of height.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import shapely

from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.static_stability import STEADY, stands_alone, steadiness
from models.physics_corrector.packing.slab_outline import BoolArray
from stable_data.geometry.shape import Shape
from stable_data.metrics.collision import TOLERANCE
from stable_data.scene import TABLE, FloatArray, RelationKind, Scene
from stable_data.scene_graph.relations import INSIDE_SLACK
from stable_data.scene_graph.support_tree import ancestors

TABLE_TOP = -1
"""Stands for the table as a carrier."""

_RIM = 3e-3  # the bottom of what is in a container is this much below the rim at least, metres
_LOOKS = 11  # a side, of looks down on a shape
_DEEP, _WALL, _HOLLOW_SHARE = 0.3, 0.25, 0.08  # so deep and so far below the walls, shares of the height, at so many of them
_LAYERS = 8  # heights at which walls are looked for
_SUNK = 2e-3  # how far the bottom of what is on another thing may be below that thing's, metres
_TOUCH = 3e-3  # what is so far above another one still is on it, metres
_OVER = 0.02  # how far beyond its carrier's outline the centre of what is on it may be, metres
_SLIPPED = 0.7  # or so large a share of half its own width
_FITS = 0.8  # share of an object's outline that is over its container's
_SUNKEN, _HALF = 0.015, 0.5  # what touches another is on it where its bottom is at most this far below its top, metres or share
_TORN = 0.06  # what cannot stand alone belongs into a container that is so near, metres
_GAP = 1e-2  # what is so close below an object without contact counts as carrying it, metres
_DOWN = 0.01  # what it costs to take what is on or in another thing for standing on the table, metres
_UNSTEADY = 5e-3  # what it costs to take it for resting where it just touches and would not stay
_LYING = 0.03  # likewise of what does not stand there by itself
_WIDE = 0.05  # what it costs that a carrier is so wide: of two containers around a thing the smaller one is the likelier
_TOWARDS, _ASIDE = (
    (0.0, 0.5, 1.0),
    0.2,
)  # where it is tried to come down, shares of the way to the middle; and what going there costs


@dataclass(frozen=True, slots=True)
class SupportEdge:
    """What carries an object.

    Attributes:
        parent: Its number, or ``TABLE_TOP``.
        is_in: Whether the object is in it.
    """

    parent: int = TABLE_TOP
    is_in: bool = False


_hollow: "WeakKeyDictionary[Shape, bool]" = WeakKeyDictionary()


def is_hollow(shape: Shape) -> bool:
    """Can something be put into a shape? Looks down on it: a hollow is deep below the top and has walls on all four sides.

    A layout may have things stuck in solid ones; those are not contents, and no correction could keep them in.
    """
    if shape not in _hollow:
        low, high = shape.footprint.min(axis=0), shape.footprint.max(axis=0)
        shares = (np.arange(_LOOKS) + 0.5) / _LOOKS
        points = low + (high - low) * np.stack(np.meshgrid(shares, shares, indexing="ij"), axis=2)
        height = float(shape.size[2])
        found = _first_heights(points.reshape(-1, 2), shape.vertices[shape.faces], -height / 2).reshape(_LOOKS, _LOOKS)
        walled = _are_walled(points.reshape(-1, 2), found.ravel() + _WALL * height, shape).reshape(_LOOKS, _LOOKS)
        over = shapely.contains_xy(shapely.Polygon(shape.footprint), *points.reshape(-1, 2).T).reshape(_LOOKS, _LOOKS)
        deep = over & walled & (height / 2 - found > _DEEP * height)
        _hollow[shape] = bool(deep.sum() >= _HOLLOW_SHARE * over.sum() > 0)
    return _hollow[shape]


def _are_walled(points: FloatArray, heights: FloatArray, shape: Shape) -> BoolArray:
    """Is there a wall to all four sides of each of the points (P, 2), so high as the heights (P,) say or a little lower?"""
    size, triangles = float(shape.size[2]), shape.vertices[shape.faces]
    layer = np.floor((heights / size + 0.5) * _LAYERS).astype(int)
    walled = np.zeros(len(points), bool)
    for n in np.unique(layer[(layer > 0) & (layer < _LAYERS)]):
        here = np.flatnonzero(layer == n)
        ends = _section(triangles, (n / _LAYERS - 0.5) * size)
        walled[here] = True
        for axis in (0, 1):
            along, across = points[here, axis], points[here, 1 - axis]
            first, second = ends[:, 0], ends[:, 1]
            passed = (first[None, :, 1 - axis] <= across[:, None]) != (second[None, :, 1 - axis] <= across[:, None])
            run = second[:, 1 - axis] - first[:, 1 - axis]
            share = (across[:, None] - first[None, :, 1 - axis]) / np.where(np.abs(run) < 1e-12, 1.0, run)[None]
            hit = first[None, :, axis] + share * (second[:, axis] - first[:, axis])[None]
            walled[here] &= (passed & (hit > along[:, None])).any(axis=1) & (passed & (hit < along[:, None])).any(axis=1)
    return walled


def _section(triangles: FloatArray, height: float) -> FloatArray:
    """Where triangles pass a height: ends of segments seen from above, (S, 2, 2), metres."""
    above = triangles[:, :, 2] > height
    mixed = triangles[above.any(axis=1) & ~above.all(axis=1)]
    other = mixed[:, [1, 2, 0]]
    passes = (mixed[:, :, 2] > height) != (other[:, :, 2] > height)
    first, second = mixed[passes], other[passes]
    share = ((height - first[:, 2]) / (second[:, 2] - first[:, 2]))[:, None]
    return np.asarray((first[:, :2] + share * (second - first)[:, :2]).reshape(-1, 2, 2))


def _first_heights(points: FloatArray, triangles: FloatArray, floor: float) -> FloatArray:
    """Height of the highest face at each of the points (P, 2), ``floor`` where there is none, (P,) metres."""
    a, b, c = (triangles[:, n] for n in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    facing = np.abs(area) > 1e-14
    a, b, c, area = a[facing], b[facing], c[facing], area[facing]
    flat_low, flat_high = (f(f(a[:, :2], b[:, :2]), c[:, :2]) for f in (np.minimum, np.maximum))
    heights = np.full(len(points), floor)
    for n, (x, y) in enumerate(points):
        over = np.nonzero((flat_low[:, 0] <= x) & (flat_high[:, 0] >= x) & (flat_low[:, 1] <= y) & (flat_high[:, 1] >= y))[0]
        p, q, r, twice = a[over], b[over], c[over], area[over]
        u = ((q[:, 0] - x) * (r[:, 1] - y) - (q[:, 1] - y) * (r[:, 0] - x)) / twice
        v = ((r[:, 0] - x) * (p[:, 1] - y) - (r[:, 1] - y) * (p[:, 0] - x)) / twice
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        if hit.any():
            heights[n] = (u * p[:, 2] + v * q[:, 2] + (1 - u - v) * r[:, 2])[hit].max()
    return heights


def distance_outside(point: FloatArray, outline: FloatArray) -> float:
    """How far a point (2,) is outside a convex outline (K, 2), counter-clockwise, metres; negative inside."""
    edges = np.roll(outline, -1, axis=0) - outline
    length = np.maximum(np.linalg.norm(edges, axis=1), 1e-12)
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / length[:, None]
    return float(((point - outline) * normals).sum(axis=1).max())


def expected_carriers(scene: Scene) -> Mapping[int, SupportEdge]:
    """What the scene's own relations say that objects are on or in; never a circle. Objects on the table are left out."""
    number = {o.instance: k for k, o in enumerate(scene.objects)}
    found: dict[int, SupportEdge] = {}
    parents = dict.fromkeys(number.values(), TABLE_TOP)
    for relation in scene.relations:
        if relation.kind not in (RelationKind.ON, RelationKind.IN) or relation.target == TABLE:
            continue
        child, parent = number.get(relation.subject), number.get(relation.target)
        if child is None or parent is None or child in found or child in (parent, *ancestors(parents, parent)):
            continue
        found[child], parents[child] = SupportEdge(parent, relation.kind is RelationKind.IN), parent
    return found


def infer_carriers(meshes: MeshQueries, poses: FloatArray, wanted: Mapping[int, SupportEdge]) -> list[list[SupportEdge]]:
    """What may carry each object, the likeliest first. The first ones are never a circle.

    Args:
        meshes: The objects.
        poses: Where they are, (N, 4).
        wanted: What is known to carry some of them.
    """
    boxes = [meshes.box(k, pose) for k, pose in enumerate(poses)]
    found = {k: [carried] for k, carried in wanted.items()}
    parents = {k: wanted[k].parent if k in wanted else TABLE_TOP for k in range(len(poses))}
    for k in sorted(range(len(poses)), key=lambda k: (float(boxes[k][0][2]), k)):
        if k not in found:
            others = [p for p in range(len(poses)) if p != k and k not in ancestors(parents, p)]
            found[k] = _ranked(meshes, poses, boxes, k, others)
            parents[k] = found[k][0].parent
    return [found[k] for k in range(len(poses))]


def _ranked(
    meshes: MeshQueries, poses: FloatArray, boxes: Sequence[tuple[FloatArray, FloatArray]], k: int, others: Sequence[int]
) -> list[SupportEdge]:
    """What may carry an object, among others or the table, the likeliest first; at least the table."""
    low, leans = float(boxes[k][0][2]), not stands_alone(meshes.shapes[k])
    if low <= TOLERANCE and not leans:
        return [SupportEdge()]
    found = [option for p in others if (option := _carried_by(meshes, poses, boxes, k, p)) is not None]
    exact = sorted((float(meshes.shapes[p].size[:2].prod()), p, carried) for p, (carried, is_exact) in found if is_exact)
    if exact and steadiness(meshes, k, poses[k], [p for _, p, _ in exact], poses) >= STEADY:
        return [exact[0][2]]
    if not found and leans:
        leant = [(near, p) for p in others if (near := _leant_in(meshes, poses, boxes, k, p)) is not None]
        return [SupportEdge(p, True) for _, p in sorted(leant)] or [SupportEdge()]
    ranked = [(_effort(meshes, poses, k, p) + _UNSTEADY * is_exact, p, carried) for p, (carried, is_exact) in found]
    ranked.append((low + (_LYING if leans else _DOWN), TABLE_TOP, SupportEdge()))
    return [carried for _, _, carried in sorted(ranked, key=lambda option: option[:2])]


def _effort(meshes: MeshQueries, poses: FloatArray, k: int, p: int) -> float:
    """How far an object would have to go to come down on another one, metres: noise leaves heights truer than places."""
    outline = shapely.Polygon(meshes.shapes[p].posed_footprint(poses[p]))
    here, middle = poses[k, :2], np.array([outline.centroid.x, outline.centroid.y])
    least = np.inf
    for share in _TOWARDS:
        place = here + share * (middle - here)
        height = meshes.lowered(k, np.array([*place, *poses[k, 2:]]), [p], poses)
        least = min(least, abs(height - float(poses[k, 2])) + _ASIDE * float(np.linalg.norm(place - here)))
    return least + _WIDE * float(np.sqrt(outline.area))


def _carried_by(
    meshes: MeshQueries,
    poses: FloatArray,
    boxes: Sequence[tuple[FloatArray, FloatArray]],
    k: int,
    p: int,
) -> tuple[int, tuple[SupportEdge, bool]] | None:
    """How one object could carry another, and whether that rests on it as it is; None where it could not."""
    (low, high), (other_low, other_high) = boxes[k], boxes[p]
    if low[2] < other_low[2] - _SUNK or low[2] > other_high[2] + _GAP:
        return None
    slip = max(_OVER, _SLIPPED * float((high - low)[:2].min()) / 2)
    if (poses[k, :2] > other_high[:2] + slip).any() or (poses[k, :2] < other_low[:2] - slip).any():
        return None
    outline = meshes.shapes[p].posed_footprint(poses[p])
    outside = distance_outside(poses[k, :2], outline)
    if outside > slip:
        return None
    over, own = shapely.Polygon(outline), shapely.Polygon(meshes.shapes[k].posed_footprint(poses[k]))
    depth, is_over = float(other_high[2] - low[2]), outside <= INSIDE_SLACK
    is_within = is_over and depth > _RIM and is_hollow(meshes.shapes[p])
    fits = is_within and own.intersection(over).area >= _FITS * own.area
    touches = meshes.cross(k, poses[k] - (0.0, 0.0, _TOUCH, 0.0), p, poses[p])
    if touches and is_over and not meshes.penetrates(k, poses[k], p, poses[p]):
        return p, (SupportEdge(p, is_within), True)
    if fits:
        return p, (SupportEdge(p, True), False)
    touches = touches or meshes.cross(k, poses[k], p, poses[p])
    if touches and (is_within or depth <= max(_SUNKEN, _HALF * float(other_high[2] - other_low[2]))):
        return p, (SupportEdge(p, is_within), False)
    if is_over and (is_within or depth <= _RIM):
        return p, (SupportEdge(p, is_within), False)
    return None


def _leant_in(
    meshes: MeshQueries,
    poses: FloatArray,
    boxes: Sequence[tuple[FloatArray, FloatArray]],
    k: int,
    p: int,
) -> float | None:
    """How near a container is that what cannot stand alone may have leant in, metres; None where it is none."""
    (low, _), (other_low, other_high) = boxes[k], boxes[p]
    if low[2] < other_low[2] - _SUNK or low[2] > other_high[2] - _RIM:
        return None
    outside = distance_outside(poses[k, :2], meshes.shapes[p].posed_footprint(poses[p]))
    if outside > _TORN or not is_hollow(meshes.shapes[p]):
        return None
    return outside
