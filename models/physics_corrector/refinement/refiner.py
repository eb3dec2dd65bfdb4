"""Refines layouts in batches, and judges exactly what came of them.

Scenes that are not clean are refined again, with a larger clearance. A refined scene is solved if it is clean by the exact audit,
each object is on or in its carrier and steady there, and no directional relation is broken. All others are for ``certify``.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace
from typing import TypeVar

import numpy as np
import shapely
import torch
from torch import Tensor

from models.device_batches import DeviceBatches
from models.physics_corrector.certify import constants
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.resting_pose import is_at_rest, resting_pose
from models.physics_corrector.certify.static_stability import stands_alone
from models.physics_corrector.certify.static_stability import steadiness as exact_steadiness
from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge, expected_carriers, known_carriers
from models.physics_corrector.refinement.contact_shapes import ContactShapeCache
from models.physics_corrector.refinement.layouts import LayoutToRefine, RefinedLayout
from models.physics_corrector.refinement.problem import RefinementProblem
from models.physics_corrector.refinement.resting import lower_onto, stand_on_table, step_aside, unrested
from models.physics_corrector.refinement.separation import separate_bodies
from models.physics_corrector.refinement.steadiness import steadiness
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.leaning import RIM_MARGIN
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import ROUNDING, TOLERANCE, Audit
from stable_data.rotations import YAW_ARM
from stable_data.scene import TABLE, FloatArray, Scene

T = TypeVar("T")

# Tuned on: the proposals of 48 generated scenes, 132 layouts.
_ROUNDS = ((4e-4, 60), (1e-3, 100), (2e-3, 200))  # clearance in metres and iterations of each round
_ASIDE_STEPS, _ASIDE_CLEARANCE = 20, 3e-4  # iterations of the steps aside within bodies, and their clearance in metres
_STEADY_STEPS, _STEADY_STEP = 5, 6e-3  # steps of an object that would tip, and by how much each is longer than the last, metres
_STILL = 5e-4  # an object that has moved less than this on its carrier stays as it stayed before, metres
_UNMOVED = 1e-6  # metres and radians: what has moved less keeps its pose bit by bit, because float32 rounds
_BATCH = 64  # scenes in one batch


class Refiner:
    """Refines layouts.

    Args:
        store: Meshes of the assets.
        grids: Their signed-distance grids.
        depth: Allowed penetration of solved scenes, metres.
        device: Device of the tensors.
    """

    def __init__(self, store: AssetStore, grids: ContactGrids, depth: float = TOLERANCE, device: str = "cpu") -> None:
        self._cache, self._depth, self._device = ContactShapeCache(store, grids), depth, device
        self._batches = DeviceBatches("refinement", _BATCH)

    @torch.no_grad()
    def rest(self, layouts: Sequence[LayoutToRefine]) -> list[Scene]:
        """Gives objects the heights that follow from geometry: on the table, or in contact with what carries them.

        Returns:
            The scenes, in order; positions along the table and yaws are unchanged. A layout with a mesh that gives no grid or
            samples is unchanged.
        """
        rested = self._run(layouts, self._rested_batch)
        return [layout.scene if scene is None else scene for layout, scene in zip(layouts, rested, strict=True)]

    def _rested_batch(self, layouts: Sequence[LayoutToRefine]) -> list[Scene]:
        scenes, fixed = [one.scene for one in layouts], [one.fixed for one in layouts]
        problem = RefinementProblem.of(scenes, [one.shapes for one in layouts], fixed, scenes, self._cache).to(self._device)
        poses = stand_on_table(problem.layout.poses, problem)
        if bool(problem.carried.any()):
            poses = lower_onto(poses, problem, unrested(poses, problem, problem.carried))[0]
        return [_moved(layout, own) for layout, own in zip(layouts, poses.double().cpu().numpy(), strict=True)]

    def refine(self, layouts: Sequence[LayoutToRefine]) -> list[RefinedLayout | None]:
        """Refines layouts.

        Returns:
            One result per layout, in order; it depends on the other layouts only by rounding. None if a mesh of a layout gives no
            grid or samples, or if the objects do not fit on the table.
        """
        return self._run(layouts, self._refined_batch, _may_fit)

    def _run(
        self,
        layouts: Sequence[LayoutToRefine],
        compute: Callable[[Sequence[LayoutToRefine]], list[T]],
        suits: Callable[[LayoutToRefine], bool] = lambda _: True,
    ) -> list[T | None]:
        """Computes something of each layout that suits, in batches; None for others, without objects, or without grid or samples."""
        usable = [
            k
            for k, layout in enumerate(layouts)
            if layout.scene.objects and suits(layout) and self.has_shapes(layout.scene, layout.shapes)
        ]
        found: list[T | None] = [None] * len(layouts)
        for k, result in zip(usable, self._batches.run([layouts[k] for k in usable], compute), strict=True):
            found[k] = result
        return found

    def has_shapes(self, scene: Scene, shapes: Sequence[Shape]) -> bool:
        """Whether all meshes of a scene can be refined: they give grids and samples, which are made here."""
        try:
            self._cache.make(scene, shapes)
        except MeshError:
            return False
        return True

    @torch.no_grad()
    def _refined_batch(self, layouts: Sequence[LayoutToRefine]) -> list[RefinedLayout]:
        done: dict[int, RefinedLayout] = {}
        now = list(layouts)
        left, unsteady = list(range(len(layouts))), [frozenset[str]() for _ in layouts]
        for clearance, iterations in _ROUNDS:
            some, origins = [now[b] for b in left], [layouts[b].scene for b in left]
            shapes, fixed = [one.shapes for one in some], [one.fixed for one in some]
            problem = RefinementProblem.of([one.scene for one in some], shapes, fixed, origins, self._cache).to(self._device)
            problem, resting = _rest_exactly(problem, some, [unsteady[b] for b in left])
            poses = refine_poses(problem, clearance, iterations, resting)
            keeps_order, steady = _keeps_order(poses, problem), _steadiness(poses, problem)
            found = poses.double().cpu().numpy()
            for row, b in enumerate(left):
                now[b] = replace(now[b], scene=_moved(now[b], found[row]))
                unsteady[b] = _unsteady(layouts[b], now[b].scene, steady[row])
                judged = self._judged(layouts[b], now[b].scene, bool(keeps_order[row]), not unsteady[b])
                if b not in done or judged.is_solved or done[b].audit.card().clean is not True:  # else the earlier one stays
                    done[b] = judged
            left = [b for b in left if not done[b].is_solved and (unsteady[b] or not done[b].audit.card().clean)]
            if not left:
                break
        return [done[b] for b in range(len(layouts))]

    def _judged(self, start: LayoutToRefine, scene: Scene, keeps_order: bool, is_steady: bool) -> RefinedLayout:
        """The result of a layout.

        Args:
            start: The layout before.
            scene: The scene after.
            keeps_order: Whether no directional relation is broken.
            is_steady: Whether all objects stay on their carriers.
        """
        audit = audit_scene(scene, start.shapes)
        deepest = max((p.penetration or 0.0 for p in audit.pairs), default=0.0)
        is_clean = audit.card().clean is True and deepest <= self._depth + ROUNDING
        return RefinedLayout(scene, audit, is_clean and keeps_order and is_steady and _are_carried(scene, audit))


def refine_poses(problem: RefinementProblem, clearance: float, iterations: int, resting: Tensor | None = None) -> Tensor:
    """Rests what is carried and separates the bodies.

    Args:
        problem: The scenes.
        clearance: Wanted distance of bodies, metres.
        iterations: Largest number of steps of the separation.
        resting: Objects that are known to rest on their carriers, (B * N,) bool: they stay there.

    Returns:
        Refined poses, (B, N, 4) float32.
    """
    poses = stand_on_table(problem.layout.poses, problem)
    carried = problem.carried
    if bool(carried.any()):
        moving = unrested(poses, problem, carried if resting is None else carried & ~resting)
        if bool(moving.any()):
            poses = step_aside(poses, problem, moving, _ASIDE_CLEARANCE, _ASIDE_STEPS)
            poses = lower_onto(poses, problem, moving)[0]
            poses = _steadied(poses, problem, moving)
    return separate_bodies(poses, problem, clearance, iterations)


def _steadied(poses: Tensor, problem: RefinementProblem, moving: Tensor) -> Tensor:
    """Steps objects that would tip towards the middle of their carriers, farther each time, and rests them there."""
    forest = problem.forest
    for number in range(1, _STEADY_STEPS + 1):
        tipping = steadiness(poses, problem, moving) < constants.STEADY
        if not bool(tipping.any()):
            break
        poses = poses.clone()
        flat = poses.view(-1, 4)
        way = flat[forest.parent, :2] - flat[:, :2]
        step = way * (number * _STEADY_STEP / way.norm(dim=1, keepdim=True).clamp_min(number * _STEADY_STEP))
        mover = forest.nearest(tipping)
        flat[:, :2] += torch.where((mover >= 0)[:, None], step[mover.clamp_min(0)], 0)
        poses = step_aside(poses, problem, tipping, _ASIDE_CLEARANCE, _ASIDE_STEPS)
        poses = lower_onto(poses, problem, tipping)[0]
    return poses


def _may_fit(layout: LayoutToRefine) -> bool:
    """Whether the footprints of what stands on the table cover at most the table; else only leaving out objects helps."""
    carried = expected_carriers(layout.scene)
    covered = 0.0
    for k, (o, shape) in enumerate(zip(layout.scene.objects, layout.shapes, strict=True)):
        if k not in carried and o.support in (None, TABLE):
            covered += shapely.Polygon(shape.footprint).area
    return covered <= float(np.prod(layout.scene.table.size_xy))


def _rest_exactly(
    problem: RefinementProblem, layouts: Sequence[LayoutToRefine], unsteady: Sequence[Set[str]]
) -> tuple[RefinementProblem, Tensor]:
    """Uses the meshes for carried objects for which grids are too coarse.

    Grids have errors of tenths of a millimetre, which would move a pen that leans in its cup to a place where it does not lean. So
    what is at rest by the meshes stays. What is not, and cannot stand by itself, gets a pose at which it leans; what is at rest but
    does not stay there gets another pose. Both may be turned.

    Args:
        problem: The layouts as tensors.
        layouts: The layouts.
        unsteady: The objects of each layout that do not stay where they rest.

    Returns:
        The problem with these poses, and the objects that rest, (B * N,) bool.
    """
    num_slots = problem.layout.mask.shape[1]
    poses = stand_on_table(problem.layout.poses, problem).clone()
    suspects, carried = unrested(poses, problem, problem.carried).cpu(), problem.carried.cpu()
    root, level, stood = problem.forest.root.cpu(), problem.forest.level.cpu(), poses.double().cpu().numpy()
    resting = torch.zeros_like(suspects)
    for b, layout in enumerate(layouts):
        first, names = b * num_slots, [o.instance for o in layout.scene.objects]
        tipping = {k for k, name in enumerate(names) if name in unsteady[b] and carried[first + k]}
        found = {*suspects[first : first + len(names)].nonzero()[:, 0].tolist(), *tipping}
        if not found:
            continue
        meshes = MeshQueries([shape.as_mesh() for shape in layout.shapes])
        edges = known_carriers(layout.scene, layout.shapes, set(names), expected_carriers(layout.scene))
        waiting = set(found)
        for k in sorted(found, key=lambda k: (int(level[first + k]), k)):  # a carrier before what it carries
            tree = _carried_by(edges, k)
            body = (root[first : first + len(names)] == root[first + k]).nonzero()[:, 0].tolist()
            beside = [j for j in body if j != k and j not in tree]
            rests = is_at_rest(meshes, stood[b], k, stood[b, k], beside)
            searches = k in tipping or not (rests or stands_alone(meshes.shapes[k]))
            carrier = edges[k].parent if k in edges else TABLE_TOP
            if searches and carrier != TABLE_TOP and carrier not in waiting:
                done = [j for j in beside if j not in waiting]
                pose = resting_pose(meshes, stood[b], k, edges[k], done)
                if pose is not None and (pose.is_steady or not rests):
                    _carry(stood[b], k, pose.pose, tree)
                    poses[b, [k, *tree]] = torch.from_numpy(stood[b, [k, *tree]]).to(poses)
                    rests = True
            resting[first + k] = rests
            if rests:
                waiting.discard(k)
    return replace(problem, layout=replace(problem.layout, poses=poses)), resting.to(problem.mobility.device)


def _carried_by(edges: Mapping[int, SupportEdge], k: int) -> list[int]:
    """The objects that an object carries, directly or on others."""
    found, waiting = list[int](), [k]
    while waiting:
        below = waiting.pop()
        above = [j for j, edge in edges.items() if edge.parent == below]
        found, waiting = found + above, waiting + above
    return found


def _carry(poses: FloatArray, k: int, pose: FloatArray, tree: Sequence[int]) -> None:
    """Moves an object to a pose (4,), and what it carries with it, in place; poses (N, 4)."""
    before, turn = poses[k].copy(), pose[3] - poses[k, 3]
    c, s = np.cos(turn), np.sin(turn)
    for j in tree:
        x, y = poses[j, :2] - before[:2]
        poses[j, :2] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
        poses[j, 2:] += pose[2] - before[2], turn
    poses[k] = pose


def _keeps_order(poses: Tensor, problem: RefinementProblem) -> list[bool]:
    """Whether each scene keeps its directional relations, B of them."""
    orders, flat = problem.orders, poses.view(-1, 4)
    apart = flat[orders.subject, :2] - flat[orders.target, :2]
    along = orders.sign * apart.gather(1, orders.axis[:, None])[:, 0]
    broken = along <= apart.gather(1, 1 - orders.axis[:, None])[:, 0].abs()
    keeps = torch.ones(len(poses), dtype=torch.bool, device=poses.device)
    keeps[orders.subject[broken] // poses.shape[1]] = False
    found: list[bool] = keeps.tolist()
    return found


def _steadiness(poses: Tensor, problem: RefinementProblem) -> FloatArray:
    """The steadiness of all carried objects by their margins, (B, N) float64; inf for other objects."""
    found: FloatArray = steadiness(poses, problem, problem.carried).view(problem.layout.mask.shape).double().cpu().numpy()
    return found


def _are_carried(scene: Scene, audit: Audit) -> bool:
    """Whether all objects are on or in the carriers that the scene's relations name, by the exact audit."""
    supports = {o.instance: o.supports for o in audit.objects}
    names = [o.instance for o in scene.objects]
    for k, edge in expected_carriers(scene).items():
        carrier, below, waiting = names[edge.parent], {names[k]}, [names[k]]
        while waiting:  # a content may rest on another one
            new = [name for name in supports.get(waiting.pop(), ()) if name not in below and name != TABLE]
            below.update(new)
            waiting += new
        if carrier not in below:
            return False
        if edge.is_in and scene.objects[k].bottom >= scene.objects[edge.parent].top - RIM_MARGIN:
            return False
    return True


def _unsteady(start: LayoutToRefine, scene: Scene, steady: FloatArray) -> frozenset[str]:
    """The carried objects that do not stay on their carriers.

    Those stay that are known to and have not moved on them; of the others, statics with friction decides where the margin alone does
    not, as for a pen that leans in its cup.

    Args:
        start: The layout before.
        scene: The scene after.
        steady: The steadiness of each carried object by its margin, (N,); inf for other objects.
    """
    before = {o.instance: o for o in start.scene.objects}
    doubtful = []
    for k, o in enumerate(scene.objects):
        if steady[k] >= constants.STEADY or o.instance in start.fixed:
            continue
        if o.instance in start.steady and o.support in before:
            shift = np.subtract(o.position, before[o.instance].position)
            carrier = np.subtract(scene[o.support].position, before[o.support].position)
            turn = (o.yaw - before[o.instance].yaw) - (scene[o.support].yaw - before[o.support].yaw)
            if max(np.abs(shift - carrier).max(), abs(turn) * YAW_ARM) <= _STILL:
                continue
        doubtful.append(k)
    if not doubtful:
        return frozenset()
    meshes, poses = MeshQueries([shape.as_mesh() for shape in start.shapes]), scene.poses()

    def stays(k: int) -> bool:
        others = [j for j in range(len(poses)) if j != k]
        return exact_steadiness(meshes, k, poses[k], others, poses) >= constants.STEADY

    return frozenset(scene.objects[k].instance for k in doubtful if not stays(k))


def _moved(layout: LayoutToRefine, poses: FloatArray) -> Scene:
    """Returns the scene of a layout at other poses, (N or more, 4); fixed objects, and those that have not moved, keep theirs."""
    scene = layout.scene
    own = poses[: len(scene.objects)]
    if not len(own) or not np.isfinite(own).all():  # coordinates that overflow float32
        return scene
    before = scene.poses()
    own = np.where(np.abs(own - before) < _UNMOVED, before, own)
    stays = (own == before).all(axis=1) | np.array([o.instance in layout.fixed for o in scene.objects], np.bool_)
    objects = tuple(
        o if is_still else o.moved((x, y, z), yaw)
        for o, is_still, (x, y, z, yaw) in zip(scene.objects, stays, own.tolist(), strict=True)
    )
    return replace(scene, objects=objects)
