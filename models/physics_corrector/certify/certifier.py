"""The whole of it: lower, nest, part, check exactly, and send back what the check refuses."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import ThreadpoolController

from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.options import CertificationResult, CertifyOptions, CorrectionStatus, DroppedObject
from models.physics_corrector.certify.packing_bodies import PackingBodies, directional
from models.physics_corrector.certify.resting_pose import RestingPose, resting_pose
from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge, carriers_of, wanted_carriers
from models.physics_corrector.packing.packing_problem import AXES, PackingProblem, holds
from models.physics_corrector.packing.separation import part
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import BOUNDS_SLACK, Audit, audit_scene
from stable_data.metrics.collision import TOLERANCE
from stable_data.scene import FloatArray, Relation, Scene

if TYPE_CHECKING:
    from stable_data.simulation.settling import RigidBody, SettleResult

_DEFAULT = CertifyOptions()
_OVERFULL, _PACKED = 1.2, 0.8  # where things cover more of a table than the one, some go unsearched until they cover the other
_LEVEL = 0.9 * TOLERANCE  # what stands so near to the table top stays at its height, metres


def certify(
    scene: Scene,
    shapes: Sequence[Shape],
    options: CertifyOptions = _DEFAULT,
    *,
    original: Scene | None = None,
    bodies: Sequence["RigidBody"] | None = None,
) -> CertificationResult:
    """Makes a scene exactly clean, moving little and keeping relations.

    Args:
        scene: The layout; positions are box centres (``AssetStore.resolved``).
        shapes: The geometry of each object, in the scene's order.
        options: Settings.
        original: The layout whose relations are to be kept and from which movement is measured; else ``scene`` itself.
        bodies: The objects as the physics engine sees them (``stable_data.simulation.collision_bodies.bodies_of``), in the
            scene's order. With them the engine is asked what of the clean scene stays at rest, and what does not is put where
            it does, if that is found.

    Returns:
        The corrected scene with its audit, or why there is none. It never holds a collision that is not said.

    Raises:
        SceneError: Shapes, ``bodies``, ``original`` or ``options.fixed`` do not belong to the scene.
    """
    certifier = Certifier(scene, shapes, options, original)
    certified = certifier.certified()
    return certified if bodies is None else certifier.rested(certified, bodies)


@cache
def _thread_pools() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def _on_one_thread() -> Iterator[None]:
    """Its many small matrices gain nothing from more threads, and lose much where those wait for each other."""
    with _thread_pools().limit(limits=1, user_api="blas"):
        yield


class Certifier:
    """One scene being made exactly clean, and then steady; see :func:`certify`, whose errors it raises."""

    def __init__(
        self, scene: Scene, shapes: Sequence[Shape], options: CertifyOptions = _DEFAULT, original: Scene | None = None
    ) -> None:
        if len(shapes) != len(scene.objects):
            found = f"{len(shapes)} shapes for {len(scene.objects)} objects"
            raise SceneError(f"{scene.scene_id}: {found}, expected one each; pass AssetStore.resolved", "shapes_differ")
        names = [o.instance for o in scene.objects]
        if original is not None and [o.instance for o in original.objects] != names:
            raise SceneError(
                f"{scene.scene_id}: the original has other objects, expected the same in order", "original_differs"
            )
        if unknown := sorted(options.fixed - set(names)):
            raise SceneError(f"{scene.scene_id}: fixed {unknown} are not in the scene, expected its instances", "fixed_unknown")
        original = original or scene
        self.scene, self.given, self.options, self.original = scene, shapes, options, original
        # A box that stands in is checked like a mesh; that it proves nothing is said at the end.
        self.shapes = [s if s.is_exact else Shape(s.vertices, s.faces) for s in shapes]
        self.meshes = MeshQueries(self.shapes, options.depth)
        self.dropped: list[DroppedObject] = []
        self.strict: set[frozenset[int]] = set()
        self.resettled: set[int] = set()
        self.shaky: set[int] = set()
        self.others: list[list[SupportEdge]] = []  # what else may carry each object, the likeliest first
        self.restless: list[int] = []  # what has found no rest on what carried it
        self.reason = ""
        self.is_laid_out = False

    def certified(self) -> CertificationResult:
        """The correction."""
        with _on_one_thread():
            return self._certified()

    def rested(self, done: CertificationResult, bodies: Sequence["RigidBody"]) -> CertificationResult:
        """A correction that the engine has judged; what did not stay is elsewhere now, if it was found where it does.

        Args:
            done: What :meth:`certified` gave; the engine is not asked again of what it has judged.
            bodies: As for :func:`certify`.
        """
        if [body.name for body in bodies] != [o.instance for o in self.scene.objects]:
            raise SceneError(
                f"{self.scene.scene_id}: the bodies are of other objects, expected the same in order", "bodies_differ"
            )
        with _on_one_thread():
            return done if done.scene is None else self._rested(done, done.scene, bodies)

    def _certified(self) -> CertificationResult:
        wanted = wanted_carriers(self.scene) if self.options.restore else {}
        if not wanted and (audit := self._clean_as_it_is()) is not None:
            return self._concluded(self.scene, audit)
        original_poses = self.original.poses()
        choices = carriers_of(self.meshes, original_poses, wanted)
        carried = [choice[0] for choice in choices]
        self.others = [choice[1:] for choice in choices]
        if self.original is not self.scene:  # what hung in the air may have been brought to something
            known = {k: c for k, c in enumerate(carried) if c.parent != TABLE_TOP or self._stood(k)}
            now = carriers_of(self.meshes, self.scene.poses(), known)
            carried = [choice[0] for choice in now]
        self.layout, self.is_laid_out = LayoutState(self.scene, self.shapes, carried, self.options.fixed), True
        orders = directional(self.layout, original_poses)
        self.standing = PackingBodies(self.layout, self.meshes, original_poses, orders, self.options.clearance)
        meant = list(carried)
        self._stand_and_nest()
        audit = None
        for _ in range(self.options.rounds):
            if not self._part():
                return CertificationResult(None, CorrectionStatus.INFEASIBLE, self.reason, tuple(self.dropped))
            audit = audit_scene(self._scene(), [self.shapes[k] for k in self.layout.present()])
            if audit.card().clean or not self._send_back(audit):
                break
        if audit is None or not audit.card().clean:
            reason = self.reason or f"not clean after {self.options.rounds} rounds of exact checks: {_what_is_left(audit)}"
            return CertificationResult(None, CorrectionStatus.INFEASIBLE, reason, tuple(self.dropped))
        return replace(self._concluded(self._scene(), audit), num_broken=self._num_broken(meant, orders))

    def _num_broken(self, meant: Sequence[SupportEdge], orders: Sequence[Relation]) -> int:
        """How many of the carriers that were meant no longer carry, and of the directional relations no longer hold."""
        layout, number = self.layout, {o.instance: k for k, o in enumerate(self.scene.objects)}
        there = [k for k in layout.present() if meant[k].parent != TABLE_TOP and layout.is_there[meant[k].parent]]
        broken = sum(meant[k].parent not in layout.carriers(k) for k in there)
        for relation in orders:
            i, j = number[relation.subject], number[relation.target]
            apart = layout.poses[i, :2] - layout.poses[j, :2]
            broken += layout.is_there[i] and layout.is_there[j] and not holds(apart, np.array(AXES[relation.kind]))
        return broken

    def _stood(self, k: int) -> bool:
        """Did an object stand on the table in the original layout?"""
        return float(self.meshes.box(k, self.original.poses()[k])[0][2]) <= TOLERANCE

    def _concluded(self, scene: Scene, audit: Audit) -> CertificationResult:
        if self.dropped and not scene.objects:
            reason = f"of all that is there {self.dropped[0].reason}"
            return CertificationResult(None, CorrectionStatus.INFEASIBLE, reason, tuple(self.dropped))
        there = {o.instance for o in scene.objects}
        missing = [o.instance for o, s in zip(self.scene.objects, self.given, strict=True) if not s.is_exact]
        if kept := [name for name in missing if name in there]:
            shapes = [s for o, s in zip(self.scene.objects, self.given, strict=True) if o.instance in there]
            reason = f"boxes stand in for the meshes of {kept}: clean by boxes, which proves nothing"
            return CertificationResult(scene, CorrectionStatus.UNKNOWN, reason, tuple(self.dropped), audit_scene(scene, shapes))
        reason = "; ".join(f"{d.instance} dropped: {d.reason}" for d in self.dropped)
        return CertificationResult(
            scene, CorrectionStatus.DROPPED if self.dropped else CorrectionStatus.CERTIFIED, reason, tuple(self.dropped), audit
        )

    def _clean_as_it_is(self) -> Audit | None:
        """The audit of the layout where it is clean already. Looks first for what is quickly seen to be wrong."""
        poses, size = self.scene.poses(), np.array(self.scene.table.size_xy)
        boxes = [self.meshes.box(k, pose) for k, pose in enumerate(poses)]
        for low, high in boxes:
            if low[2] < -TOLERANCE or (low[:2] < -BOUNDS_SLACK).any() or (high[:2] > size + BOUNDS_SLACK).any():
                return None
        for k in range(len(poses)):
            near = self.meshes.near(k, poses[k], range(k), poses)
            if any(self.meshes.penetrates(k, poses[k], j, poses[j]) for j in near):
                return None
        audit = audit_scene(self.scene, self.shapes)
        return audit if audit.card().clean else None

    def _rested(self, done: CertificationResult, scene: Scene, bodies: Sequence["RigidBody"]) -> CertificationResult:
        from models.physics_corrector.certify.settle_repair import SettleRepair  # the engine takes long to import
        from stable_data.simulation.settling import PhysicsOptions, settle

        body_of = {body.name: body for body in bodies}

        def verdict(of: Scene) -> "SettleResult":
            placed = [replace(body_of[o.instance], position=o.position, yaw=o.yaw) for o in of.objects]
            return settle(placed, of.table, PhysicsOptions(hurries=not self.options.places))

        rest = done.rest or verdict(scene)
        if rest.stable is None:
            reason = "; ".join(filter(None, (done.reason, f"the engine cannot be asked: {rest.reason}")))
            return replace(done, reason=reason)
        if not rest.stable and self.options.places:
            if not self.is_laid_out:
                carried = [choice[0] for choice in carriers_of(self.meshes, self.scene.poses(), {})]
                self.layout, self.is_laid_out = LayoutState(self.scene, self.shapes, carried, self.options.fixed), True
            layout, was, unsteady = self.layout, self.layout.poses.copy(), set(rest.unsteady)
            moved = [k for k in layout.present() if self.scene.objects[k].instance in unsteady]
            orders = directional(layout, self.original.poses())
            SettleRepair(layout, self.meshes, bodies, orders, self.options.places).settle(moved)
            if not np.array_equal(layout.poses, was):
                mended = self._scene()
                audit = audit_scene(mended, [self.shapes[k] for k in layout.present()])
                after = verdict(mended)
                if audit.card().clean and after.num_restless <= rest.num_restless:
                    done, rest = self._concluded(mended, audit), after
        return replace(done, rest=rest)

    # --- trees

    def _stand_and_nest(self) -> None:
        layout = self.layout
        for root in layout.roots():
            if not layout.is_fixed[root] and abs(layout.low(root)) > _LEVEL:
                layout.stand(root)
        for root in list(layout.roots()):
            self._nest(root)
        for k in self.restless:
            self._nest_elsewhere(k)

    def _nest(self, root: int) -> None:
        """Brings all that a root carries to rest, from below; what finds no rest there stands on the table itself."""
        layout = self.layout
        done, queue, was = [root], [root], layout.poses.copy()
        while queue:
            carrier = queue.pop(0)
            for c in sorted(layout.children(carrier), key=lambda c: (not layout.is_fixed[c], layout.low(c), c)):
                own = set(layout.tree(c))
                waiting = [m for m in layout.tree(root) if m not in own and m not in done]
                rest = resting_pose(self.meshes, layout.poses, c, layout.carried[c], done, waiting)
                if layout.is_fixed[c]:
                    rest = RestingPose(layout.poses[c], True)
                if rest is None or not rest.is_steady:
                    self.restless.append(c)
                if rest is None:
                    layout.stand(c)
                    self._nest(c)
                else:
                    layout.carry(c, rest.pose)
                    done.append(c)
                    queue.append(c)
        stayed = [m for m in done[1:] if np.array_equal(layout.poses[m], was[m])]
        for c in stayed if len(stayed) < len(done) - 1 else ():  # it may have leant on what has moved away
            own = set(layout.tree(c))
            others = [m for m in done if m not in own]
            rest = None if layout.is_fixed[c] else resting_pose(self.meshes, layout.poses, c, layout.carried[c], others)
            if rest is not None:
                layout.carry(c, rest.pose)

    def _nest_elsewhere(self, k: int) -> None:
        """Brings what has found no rest on what carries it, or would not stay there, to rest on what else may carry it."""
        layout, own, was = self.layout, set(self.layout.tree(k)), self.layout.poses[k].copy()
        if layout.carried[k].is_in:  # there it stays, if not just so
            return
        stands, root = layout.carried[k].parent == TABLE_TOP, layout.root_of(k)
        stays_within = any(layout.carried[m].is_in for m in layout.carriers(k))
        for carried in self.others[k]:
            if carried.parent == TABLE_TOP or carried.parent in own:
                continue
            if stays_within and layout.root_of(carried.parent) != root:
                continue
            layout.carry(k, self.original.poses()[k])
            there = [m for m in layout.tree(layout.root_of(carried.parent)) if m not in own]
            rest = resting_pose(self.meshes, layout.poses, k, carried, there)
            if rest is not None and (rest.is_steady or carried.is_in or stands):
                layout.carried[k] = carried
                layout.carry(k, rest.pose)
                return
            layout.carry(k, was)

    # --- the table

    def _part(self) -> bool:
        """Parts all trees; drops what has no place. False where that is not allowed, with ``reason`` set."""
        while True:
            crowd, roots = self.standing.crowd(self.strict)
            homeless = [b for b in range(len(roots)) if crowd.is_free[b] and (crowd.low[b] > crowd.high[b]).any()]
            if homeless:
                least = min(homeless, key=lambda b: self._rank(roots[b]))
                if not self._may_drop(roots[least]):
                    self._say_full(roots[b] for b in homeless)
                    return False
                self._drop(roots[least])
                continue
            spare = sorted((b for b in range(len(roots)) if self._may_drop(roots[b])), key=lambda b: self._rank(roots[b]))
            if surplus := self._surplus(roots, spare):
                for b in surplus:
                    self._drop(roots[b])
                continue
            parted = part(crowd, crowd.aims, spare, self.options.tries)
            if parted is None:
                self._say_full(roots[b] for b in range(len(roots)) if crowd.is_free[b])
                return False
            shifts, out = parted
            self._accept(crowd, roots, shifts)
            for b in out:
                self._drop(roots[b])
            return True

    def _surplus(self, groups: Sequence[Sequence[int]], spare: Sequence[int]) -> list[int]:
        """Which of those that may go have to before a search is worth it: all together they cover more than there is."""
        area = float(np.prod(self.scene.table.size_xy))
        covered = [self.standing.covered(roots) for roots in groups]
        left, surplus = sum(covered), list[int]()
        if left > _OVERFULL * area:
            for b in spare:
                if left > _PACKED * area:
                    surplus.append(b)
                    left -= covered[b]
        return surplus

    def _may_drop(self, roots: Sequence[int]) -> bool:
        return self.options.when_full == "drop" and all(self.layout.may_drop(r) for r in roots)

    def _rank(self, roots: Sequence[int]) -> tuple[float, float, str]:
        """What makes room first comes first: the least important, of those the largest, so that few have to go."""
        ranks = [self.layout.rank(r) for r in roots]
        return max(rank[0] for rank in ranks), -sum(rank[1] for rank in ranks), ranks[0][2]

    def _say_full(self, groups: Iterable[Sequence[int]]) -> None:
        width, depth = self.scene.table.size_xy
        names = [self.scene.objects[r].instance for roots in groups for r in roots]
        why = "dropping is not allowed" if self.options.when_full == "infeasible" else "too little of it may be dropped"
        self.reason = f"no place on the table of {width:.2f} x {depth:.2f} m for all of {names}, and {why}"

    def _drop(self, roots: Sequence[int]) -> None:
        width, depth = self.scene.table.size_xy
        for r in roots:
            for k in self.layout.drop(r):
                reason = f"no free place was found on the table of {width:.2f} x {depth:.2f} m"
                self.dropped.append(DroppedObject(self.scene.objects[k].instance, reason))

    def _accept(self, crowd: PackingProblem, groups: Sequence[Sequence[int]], shifts: FloatArray) -> None:
        for b, roots in enumerate(groups):
            if crowd.is_free[b] and np.abs(shifts[b]).max() > 1e-7:
                for r in roots:
                    self.layout.poses[self.layout.tree(r), :2] += shifts[b]

    # --- the exact check

    def _send_back(self, audit: Audit) -> bool:
        """Changes what the exact check refuses. False where nothing can be changed, with ``reason`` set."""
        layout = self.layout
        number = {o.instance: k for k, o in enumerate(self.scene.objects)}
        changed = False
        for pair in audit.pairs:
            if pair.penetration is not None and pair.penetration > TOLERANCE:
                i, j = number[pair.first], number[pair.second]
                one, other = layout.root_of(i), layout.root_of(j)
                if one != other and frozenset((one, other)) not in self.strict:
                    self.strict.add(frozenset((one, other)))
                    changed = True
                elif one == other:
                    changed |= self._uproot(i if layout.carried[j].parent == TABLE_TOP or j in layout.tree(i) else j)
        self.shaky = {number[o.instance] for o in audit.objects if o.floats}
        for o in audit.objects:
            if o.floats or o.table_penetration > TOLERANCE:
                changed |= self._uproot(number[o.instance])
        if not changed:
            self.reason = f"the exact check refuses what cannot be moved: {_what_is_left(audit)}"
        return changed

    def _uproot(self, k: int) -> bool:
        """Lets what does not rest where it is come to rest anew there, or, at the second time, on the table itself."""
        layout = self.layout
        if layout.stiffness(layout.root_of(k)) == float("inf") and layout.is_fixed[k]:
            return False
        if layout.carried[k].parent != TABLE_TOP and k not in self.resettled:
            self.resettled.add(k)
            own = set(layout.tree(k))
            others = [m for m in layout.tree(layout.root_of(k)) if m not in own and m not in self.shaky]
            rest = resting_pose(self.meshes, layout.poses, k, layout.carried[k], others)
            self.shaky.discard(k)
            if rest is not None and not np.array_equal(rest.pose, layout.poses[k]):
                layout.carry(k, rest.pose)
                return True
        was_standing = layout.carried[k].parent == TABLE_TOP and abs(layout.low(k)) <= _LEVEL
        layout.stand(k)
        self._nest(k)
        return not was_standing

    def _scene(self) -> Scene:
        """The layout as it is now; what has not moved is the very object that was given."""
        layout, given = self.layout, self.scene.poses()
        objects = []
        for k in layout.present():
            o, pose = self.scene.objects[k], layout.poses[k]
            if not np.array_equal(pose, given[k]):
                x, y, z, yaw = pose.tolist()
                o = o.moved((x, y, z), yaw)
            objects.append(o)
        return replace(self.scene, objects=tuple(objects))


def _what_is_left(audit: Audit | None) -> str:
    if audit is None:
        return "nothing was checked"
    pairs = [f"{p.first} is in {p.second}" for p in audit.pairs if p.penetration is None or p.penetration > audit.tolerance]
    alone = [f"{o.instance} floats" for o in audit.objects if o.floats]
    alone += [f"{o.instance} is off its area" for o in audit.objects if o.is_outside]
    alone += [f"{o.instance} is in the table" for o in audit.objects if o.table_penetration > audit.tolerance]
    return "; ".join([*pairs, *alone][:5])
