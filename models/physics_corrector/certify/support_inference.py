"""Inference of supports in a layout that is not at rest: which object carries or contains which.

In a layout before its correction, contents penetrate the walls of their container, and an object on a plate may have slid half
off. The carrier of an object above the table is therefore the first of these: the carrier by the scene's relations; the object on
which it rests; among the objects that it touches from above, is in, or is nearly over, the one on which it comes to rest with the
least change of height.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import shapely

from models.physics_corrector.certify import constants
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.static_stability import stands_alone, steadiness
from models.physics_corrector.packing.slab_outline import BoolArray
from stable_data.geometry.leaning import RIM_MARGIN
from stable_data.geometry.shape import Shape
from stable_data.metrics.verdicts import TOLERANCE
from stable_data.scene import TABLE, FloatArray, RelationKind, Scene
from stable_data.scene_graph.relations import INSIDE_SLACK
from stable_data.scene_graph.support_tree import ancestors

TABLE_TOP = -1
"""Stands for the table as a carrier."""


@dataclass(frozen=True, slots=True)
class SupportEdge:
    """The support of an object.

    Attributes:
        parent: Index of the carrier, or ``TABLE_TOP``.
        is_in: Whether the object is in the carrier.
    """

    parent: int = TABLE_TOP
    is_in: bool = False


_hollow: "WeakKeyDictionary[Shape, bool]" = WeakKeyDictionary()


def is_hollow(shape: Shape) -> bool:
    """Whether a shape can contain objects: seen from above, a hollow is deep below the top and has walls on all four sides.

    An object that is stuck in a solid one is not its content, and no correction could leave it there.
    """
    if shape not in _hollow:
        low, high = shape.footprint.min(axis=0), shape.footprint.max(axis=0)
        shares = (np.arange(constants.HOLLOW_GRID) + 0.5) / constants.HOLLOW_GRID
        points = (low + (high - low) * np.stack(np.meshgrid(shares, shares, indexing="ij"), axis=2)).reshape(-1, 2)
        height = float(shape.size[2])
        found = _top_heights(points, shape.vertices[shape.faces], -height / 2)
        walled = _are_walled(points, found + constants.HOLLOW_WALL * height, shape)
        over = shapely.contains_xy(shapely.Polygon(shape.footprint), *points.T)
        deep = over & walled & (height / 2 - found > constants.HOLLOW_DEPTH * height)
        _hollow[shape] = bool(deep.sum() >= constants.HOLLOW_SHARE * over.sum() > 0)
    return _hollow[shape]


def _are_walled(points: FloatArray, heights: FloatArray, shape: Shape) -> BoolArray:
    """Whether each of the points (P, 2) has a wall on all four sides at its height (P,), rounded down to a layer."""
    size, triangles = float(shape.size[2]), shape.vertices[shape.faces]
    layer = np.floor((heights / size + 0.5) * constants.WALL_LAYERS).astype(int)
    walled = np.zeros(len(points), bool)
    for n in np.unique(layer[(layer > 0) & (layer < constants.WALL_LAYERS)]):
        here = np.flatnonzero(layer == n)
        ends = _section(triangles, (n / constants.WALL_LAYERS - 0.5) * size)
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
    """Returns the section of triangles at a height: ends of segments seen from above, (S, 2, 2), metres."""
    above = triangles[:, :, 2] > height
    mixed = triangles[above.any(axis=1) & ~above.all(axis=1)]
    other = mixed[:, [1, 2, 0]]
    passes = (mixed[:, :, 2] > height) != (other[:, :, 2] > height)
    first, second = mixed[passes], other[passes]
    share = ((height - first[:, 2]) / (second[:, 2] - first[:, 2]))[:, None]
    return np.asarray((first[:, :2] + share * (second - first)[:, :2]).reshape(-1, 2, 2))


def _top_heights(points: FloatArray, triangles: FloatArray, floor: float) -> FloatArray:
    """Returns the height of the highest face at each of the points (P, 2), ``floor`` without a face, (P,) metres."""
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
    """Returns how far a point (2,) is outside a convex outline (K, 2), counter-clockwise, metres; negative inside."""
    edges = np.roll(outline, -1, axis=0) - outline
    length = np.maximum(np.linalg.norm(edges, axis=1), 1e-12)
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / length[:, None]
    return float(((point - outline) * normals).sum(axis=1).max())


def expected_carriers(scene: Scene) -> Mapping[int, SupportEdge]:
    """Returns the carriers by the scene's relations ``on`` and ``in``, without cycles. Objects on the table are left out."""
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


def known_carriers(
    scene: Scene, shapes: Sequence[Shape], still: Set[str], wanted: Mapping[int, SupportEdge]
) -> Mapping[int, SupportEdge]:
    """Adds to wanted carriers those of still objects, which stay as the scene states them, whatever has come near.

    Nothing carries the objects of the surroundings.

    Args:
        scene: The scene.
        shapes: The geometry of its objects.
        still: Instances that hardly move.
        wanted: Index of an object -> its support, without cycles.
    """
    number = {o.instance: k for k, o in enumerate(scene.objects)}
    found = dict(wanted) | {number[name]: SupportEdge() for name in scene.fixed & number.keys()}
    parents = {k: found[k].parent if k in found else TABLE_TOP for k in number.values()}
    for k, o in enumerate(scene.objects):
        if o.instance not in still or k in found or o.support is None:
            continue
        parent = number.get(o.support, TABLE_TOP)
        if parent == TABLE_TOP:
            if o.support == TABLE:
                found[k] = SupportEdge()
        elif k not in (parent, *ancestors(parents, parent)):
            is_in = is_hollow(shapes[parent]) and o.bottom < scene.objects[parent].top - RIM_MARGIN
            found[k], parents[k] = SupportEdge(parent, is_in), parent
    return found


def infer_carriers(meshes: MeshQueries, poses: FloatArray, wanted: Mapping[int, SupportEdge]) -> list[list[SupportEdge]]:
    """Infers the possible supports of each object, the likeliest first. The first ones form no cycle.

    Args:
        meshes: The objects.
        poses: Their poses, (N, 4).
        wanted: Index of an object -> its support, if known.
    """
    boxes = [meshes.box(k, pose) for k, pose in enumerate(poses)]
    found = {k: [carried] for k, carried in wanted.items()}
    parents = {k: wanted[k].parent if k in wanted else TABLE_TOP for k in range(len(poses))}
    # From below: the carriers of lower objects are known, so a choice that would close a cycle can be excluded.
    for k in sorted(range(len(poses)), key=lambda k: (float(boxes[k][0][2]), k)):
        if k not in found:
            others = [p for p in range(len(poses)) if p != k and k not in ancestors(parents, p)]
            found[k] = _rank_supports(meshes, poses, boxes, k, others)
            parents[k] = found[k][0].parent
    return [found[k] for k in range(len(poses))]


def _rank_supports(
    meshes: MeshQueries, poses: FloatArray, boxes: Sequence[tuple[FloatArray, FloatArray]], k: int, others: Sequence[int]
) -> list[SupportEdge]:
    """Returns the possible supports of an object, the likeliest first; at least the table."""
    low, leans = float(boxes[k][0][2]), not stands_alone(meshes.shapes[k])
    # On the table by its height: exact queries are not needed.
    if low <= TOLERANCE and not leans:
        return [SupportEdge()]
    found = [option for p in others if (option := _possible_support(meshes, poses, boxes, k, p)) is not None]
    exact = sorted((float(meshes.shapes[p].size[:2].prod()), p, carried) for p, (carried, is_exact) in found if is_exact)
    if exact and steadiness(meshes, k, poses[k], [p for _, p, _ in exact], poses) >= constants.STEADY:
        return [exact[0][2]]
    if not found and leans:
        containers = [(near, p) for p in others if (near := _leaning_distance(meshes, poses, boxes, k, p)) is not None]
        return [SupportEdge(p, True) for _, p in sorted(containers)] or [SupportEdge()]
    costs = [_lowering_cost(meshes, poses, k, p) + constants.TOUCHED_COST * is_exact for p, (_, is_exact) in found]
    ranked = [(cost, p, carried) for cost, (p, (carried, _)) in zip(costs, found, strict=True)]
    ranked.append((low + (constants.LYING_TABLE_COST if leans else constants.TABLE_COST), TABLE_TOP, SupportEdge()))
    return [carried for _, _, carried in sorted(ranked, key=lambda option: option[:2])]


def _lowering_cost(meshes: MeshQueries, poses: FloatArray, k: int, p: int) -> float:
    """Returns the cost of an object's way down onto another one, metres. Noise changes heights less than places."""
    outline = shapely.Polygon(meshes.shapes[p].posed_footprint(poses[p]))
    here, middle = poses[k, :2], np.array([outline.centroid.x, outline.centroid.y])
    least = np.inf
    for share in constants.APPROACH_SHARES:
        place = here + share * (middle - here)
        height = meshes.resting_height(k, np.array([*place, *poses[k, 2:]]), [p], poses)
        least = min(least, abs(height - float(poses[k, 2])) + constants.APPROACH_COST * float(np.linalg.norm(place - here)))
    return least + constants.WIDTH_COST * float(np.sqrt(outline.area))


def _possible_support(
    meshes: MeshQueries, poses: FloatArray, boxes: Sequence[tuple[FloatArray, FloatArray]], k: int, p: int
) -> tuple[int, tuple[SupportEdge, bool]] | None:
    """Returns how object p could carry object k, and whether k already rests on it; None if it could not."""
    (low, high), (other_low, other_high) = boxes[k], boxes[p]
    if low[2] < other_low[2] - constants.SUPPORT_SINK or low[2] > other_high[2] + constants.SUPPORT_GAP:
        return None
    slip = max(constants.OVERHANG, constants.OVERHANG_SHARE * float((high - low)[:2].min()) / 2)
    if (poses[k, :2] > other_high[:2] + slip).any() or (poses[k, :2] < other_low[:2] - slip).any():
        return None
    outline = meshes.shapes[p].posed_footprint(poses[p])
    outside = distance_outside(poses[k, :2], outline)
    if outside > slip:
        return None
    over, own = shapely.Polygon(outline), shapely.Polygon(meshes.shapes[k].posed_footprint(poses[k]))
    depth, is_over = float(other_high[2] - low[2]), outside <= INSIDE_SLACK
    is_within = is_over and depth > constants.RIM_DEPTH and is_hollow(meshes.shapes[p])
    fits = is_within and own.intersection(over).area >= constants.CONTAINER_COVER * own.area
    touches = meshes.cross(k, poses[k] - (0.0, 0.0, constants.SUPPORT_TOUCH, 0.0), p, poses[p])
    if touches and is_over and not meshes.penetrates(k, poses[k], p, poses[p]):
        return p, (SupportEdge(p, is_within), True)
    if fits:
        return p, (SupportEdge(p, True), False)
    touches = touches or meshes.cross(k, poses[k], p, poses[p])
    most = max(constants.TOUCH_DEPTH, constants.TOUCH_DEPTH_SHARE * float(other_high[2] - other_low[2]))
    if touches and (is_within or depth <= most):
        return p, (SupportEdge(p, is_within), False)
    if is_over and (is_within or depth <= constants.RIM_DEPTH):
        return p, (SupportEdge(p, is_within), False)
    return None


def _leaning_distance(
    meshes: MeshQueries, poses: FloatArray, boxes: Sequence[tuple[FloatArray, FloatArray]], k: int, p: int
) -> float | None:
    """Returns the distance of a container in which an object that cannot stand alone may have leaned, metres; else None."""
    (low, _), (other_low, other_high) = boxes[k], boxes[p]
    if low[2] < other_low[2] - constants.SUPPORT_SINK or low[2] > other_high[2] - constants.RIM_DEPTH:
        return None
    outside = distance_outside(poses[k, :2], meshes.shapes[p].posed_footprint(poses[p]))
    if outside > constants.LEAN_DISTANCE or not is_hollow(meshes.shapes[p]):
        return None
    return outside
