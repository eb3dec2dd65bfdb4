"""The search for a clean layout: rests objects on their carriers, separates them on the table, and audits them exactly."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from models.physics_corrector.certify.asked_relations import AskedRelations
from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.options import CertifyOptions, DroppedObject
from models.physics_corrector.certify.packing_bodies import PackingBodies, directional_relations
from models.physics_corrector.certify.resting_pose import RestingPose, resting_pose, straight_down
from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge, infer_carriers, known_carriers
from models.physics_corrector.packing.packing_problem import AXES, PackingProblem, holds_relation
from models.physics_corrector.packing.separation import separate_bodies
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import TOLERANCE, Audit
from stable_data.scene import FloatArray, Scene

# If the total footprint is over _OVERFULL of the table area, objects are dropped before the search until it is under _PACKED
# (shares of the area). Tuned on: not recorded.
_OVERFULL, _PACKED = 1.2, 0.8
# An object whose underside is this near to the table top (metres) keeps its height. Less than the tolerance, so that the audit
# accepts that height.
_LEVEL = 0.9 * TOLERANCE
# A group that moves less than this along both axes (metres) keeps its pose bit by bit.
_UNMOVED = 1e-7


class LayoutSearch:
    """The search for a clean layout of one scene.

    Args:
        scene: The start layout.
        original: The layout whose relations are preserved and from which movement is measured.
        shapes: The geometry of the objects, in order.
        meshes: The same geometry, for exact queries.
        options: Settings.
        wanted: Index of an object -> the carrier that a relation requires.

    Attributes:
        layout: The present poses and carriers.
        dropped: The dropped objects.
        reason: Why there is no clean layout; empty if there is one.
        num_broken: Relations of the original that the clean layout breaks; see
            :attr:`~models.physics_corrector.certify.options.CertificationResult.num_broken`.
    """

    def __init__(
        self,
        scene: Scene,
        original: Scene,
        shapes: Sequence[Shape],
        meshes: MeshQueries,
        options: CertifyOptions,
        wanted: Mapping[int, SupportEdge],
    ) -> None:
        self._scene, self._original, self._shapes, self._meshes, self._options = scene, original, shapes, meshes, options
        self.dropped: list[DroppedObject] = []
        self.reason = ""
        self.num_broken = 0
        self._outline_pairs: set[frozenset[int]] = set()  # pairs of roots whose outlines must be apart
        self._rested_again: set[int] = set()
        self._floating: set[int] = set()
        self._unsteady: list[int] = []  # objects without a steady place on their carrier
        original_poses = original.poses()
        choices = infer_carriers(meshes, original_poses, known_carriers(scene, shapes, options.still, wanted))
        carried = [choice[0] for choice in choices]
        self._others = [choice[1:] for choice in choices]  # other possible carriers of each object, the likeliest first
        if original is not scene:  # an object that floated may rest on something now
            known = {
                k: c
                for k, c in enumerate(carried)
                if c.parent != TABLE_TOP or self._stood_on_table(k) or scene.objects[k].instance in scene.fixed
            }
            carried = [choice[0] for choice in infer_carriers(meshes, scene.poses(), known)]
        self.layout = LayoutState(scene, shapes, carried, options.fixed, options.still)
        self._asked = AskedRelations(self.layout, options.asked)
        self._orders = self._asked.with_others(directional_relations(self.layout, original_poses))
        self._packing = PackingBodies(self.layout, meshes, original_poses, self._orders, self._asked.cells, options.clearance)
        self._first_carriers = list(carried)

    def find(self) -> Audit | None:
        """Searches for a clean layout.

        Returns:
            The exact audit of ``layout``; None if no clean layout was found, with ``reason`` set.
        """
        self._rest_all()
        audit = None
        for _ in range(self._options.rounds):
            if not self._separate_trees():
                return None
            audit = audit_scene(build_scene(self.layout), [self._shapes[k] for k in self.layout.present()])
            if audit.card().clean or not self._change_refused(audit):
                break
        if audit is None or not audit.card().clean:
            self.reason = self.reason or (
                f"not clean after {self._options.rounds} rounds of exact checks: {remaining_faults(audit)}"
            )
            return None
        self.num_broken = self._count_broken()
        return audit

    def _count_broken(self) -> int:
        """Returns the number of objects without their first carrier, plus the number of broken directional relations."""
        layout, first = self.layout, self._first_carriers
        number = {o.instance: k for k, o in enumerate(self._scene.objects)}
        there = [k for k in layout.present() if first[k].parent != TABLE_TOP and layout.is_there[first[k].parent]]
        broken = sum(first[k].parent not in layout.carriers(k) for k in there)
        for relation in self._orders:
            i, j = number[relation.subject], number[relation.target]
            apart = layout.poses[i, :2] - layout.poses[j, :2]
            broken += layout.is_there[i] and layout.is_there[j] and not holds_relation(apart, np.array(AXES[relation.kind]))
        return broken

    def _stood_on_table(self, k: int) -> bool:
        """Whether an object stood on the table in the original layout."""
        return float(self._meshes.box(k, self._original.poses()[k])[0][2]) <= TOLERANCE

    # --- trees

    def _rest_all(self) -> None:
        layout = self.layout
        for root in layout.roots():
            if not layout.is_fixed[root] and abs(layout.low(root)) > _LEVEL:
                layout.stand(root)
        for root in list(layout.roots()):
            self._rest_tree(root)
        for k in self._unsteady:
            self._rest_on_other_carrier(k)

    def _rest_tree(self, root: int) -> None:
        """Rests all objects of a tree, carriers first; an object without a place on its carrier is put on the table."""
        layout = self.layout
        done, queue, before = [root], [root], layout.poses.copy()
        while queue:
            carrier = queue.pop(0)
            # Fixed objects first, because the others must find room beside them; then from below.
            for c in sorted(layout.children(carrier), key=lambda c: (not layout.is_fixed[c], layout.low(c), c)):
                own = set(layout.tree(c))
                waiting = [m for m in layout.tree(root) if m not in own and m not in done]
                rest = self._resting_pose(c, layout.carried[c], done, waiting)
                if layout.is_fixed[c]:
                    rest = RestingPose(layout.poses[c], True)
                if rest is None or not rest.is_steady:
                    self._unsteady.append(c)
                if rest is None:
                    layout.stand(c)
                    self._rest_tree(c)
                else:
                    layout.carry(c, rest.pose)
                    done.append(c)
                    queue.append(c)
        stayed = [m for m in done[1:] if np.array_equal(layout.poses[m], before[m])]
        for c in stayed if len(stayed) < len(done) - 1 else ():  # an object that stayed may have leaned on one that moved
            own = set(layout.tree(c))
            others = [m for m in done if m not in own]
            rest = None if layout.is_fixed[c] else self._resting_pose(c, layout.carried[c], others)
            if rest is not None:
                layout.carry(c, rest.pose)

    def _rest_on_other_carrier(self, k: int) -> None:
        """Rests an object without a steady place on its own carrier on another possible carrier."""
        layout, own, before = self.layout, set(self.layout.tree(k)), self.layout.poses[k].copy()
        if layout.carried[k].is_in:  # a content stays in its container, even where it is not steady
            return
        stands, root = layout.carried[k].parent == TABLE_TOP, layout.root_of(k)
        stays_within = any(layout.carried[m].is_in for m in layout.carriers(k))
        for carried in self._others[k]:
            if carried.parent == TABLE_TOP or carried.parent in own:
                continue
            if stays_within and layout.root_of(carried.parent) != root:
                continue
            layout.carry(k, self._original.poses()[k])
            there = [m for m in layout.tree(layout.root_of(carried.parent)) if m not in own]
            rest = self._resting_pose(k, carried, there)
            if rest is not None and (rest.is_steady or carried.is_in or stands):
                layout.carried[k] = carried
                layout.carry(k, rest.pose)
                return
            layout.carry(k, before)

    def _resting_pose(
        self, k: int, carried: SupportEdge, done: Sequence[int], waiting: Sequence[int] = ()
    ) -> RestingPose | None:
        """Finds a resting pose: that of a still object straight below, else one at which all holds that is asked of the object."""
        poses = self.layout.poses
        if self._scene.objects[k].instance in self._options.still:
            rest = straight_down(self._meshes, poses, k, carried, done)
            if rest is not None:
                return rest
        if self._asked.is_about(k):
            rest = resting_pose(self._meshes, poses, k, carried, done, waiting, lambda pose: self._asked.allow(k, pose, poses))
            if rest is not None and rest.is_steady:
                return rest
        return resting_pose(self._meshes, poses, k, carried, done, waiting)

    # --- the table

    def _separate_trees(self) -> bool:
        """Separates all trees on the table; drops those without a place. False, with ``reason`` set, if that is not allowed."""
        while True:
            problem, roots = self._packing.problem(self._outline_pairs)
            unplaceable = [b for b in range(len(roots)) if problem.is_free[b] and (problem.low[b] > problem.high[b]).any()]
            if unplaceable:
                least = min(unplaceable, key=lambda b: self._rank(roots[b]))
                if not self._may_drop(roots[least]):
                    self._set_full_reason(roots[b] for b in unplaceable)
                    return False
                self._drop(roots[least])
                continue
            # The order in which bodies may be dropped, for all steps below.
            spare = sorted((b for b in range(len(roots)) if self._may_drop(roots[b])), key=lambda b: self._rank(roots[b]))
            if to_drop := self._to_drop(roots, spare):
                for b in to_drop:
                    self._drop(roots[b])
                continue
            separated = separate_bodies(problem, problem.aims, spare, self._options.tries)
            if separated is None:
                self._set_full_reason(roots[b] for b in range(len(roots)) if problem.is_free[b])
                return False
            shifts, out = separated
            self._apply_shifts(problem, roots, shifts)
            for b in out:
                self._drop(roots[b])
            return True

    def _to_drop(self, groups: Sequence[Sequence[int]], spare: Sequence[int]) -> list[int]:
        """Returns the groups to drop before the search, because all together cover more than the table."""
        area = float(np.prod(self._scene.table.size_xy))
        covered = [self._packing.covered(roots) for roots in groups]
        left, to_drop = sum(covered), list[int]()
        if left > _OVERFULL * area:
            for b in spare:
                if left > _PACKED * area:
                    to_drop.append(b)
                    left -= covered[b]
        return to_drop

    def _may_drop(self, roots: Sequence[int]) -> bool:
        return self._options.when_full == "drop" and all(self.layout.may_drop(r) for r in roots)

    def _rank(self, roots: Sequence[int]) -> tuple[float, float, str]:
        """Returns the key of the order of dropping: the least important first, of these the largest, so that few are dropped."""
        ranks = [self.layout.rank(r) for r in roots]
        return max(rank[0] for rank in ranks), -sum(rank[1] for rank in ranks), ranks[0][2]

    def _set_full_reason(self, groups: Iterable[Sequence[int]]) -> None:
        width, depth = self._scene.table.size_xy
        names = [self._scene.objects[r].instance for roots in groups for r in roots]
        why = "dropping is not allowed" if self._options.when_full == "infeasible" else "too few of them may be dropped"
        self.reason = f"no place on the table of {width:.2f} x {depth:.2f} m for all of {names}, and {why}"

    def _drop(self, roots: Sequence[int]) -> None:
        width, depth = self._scene.table.size_xy
        for r in roots:
            for k in self.layout.drop(r):
                reason = f"no free place was found on the table of {width:.2f} x {depth:.2f} m"
                self.dropped.append(DroppedObject(self._scene.objects[k].instance, reason))

    def _apply_shifts(self, problem: PackingProblem, groups: Sequence[Sequence[int]], shifts: FloatArray) -> None:
        for b, roots in enumerate(groups):
            if problem.is_free[b] and np.abs(shifts[b]).max() > _UNMOVED:
                for r in roots:
                    self.layout.poses[self.layout.tree(r), :2] += shifts[b]

    # --- the exact check

    def _change_refused(self, audit: Audit) -> bool:
        """Changes what the exact audit refuses. False, with ``reason`` set, if nothing can be changed."""
        layout = self.layout
        number = {o.instance: k for k, o in enumerate(self._scene.objects)}
        changed = False
        for pair in audit.pairs:
            if pair.penetration is not None and pair.penetration > TOLERANCE:
                i, j = number[pair.first], number[pair.second]
                one, other = layout.root_of(i), layout.root_of(j)
                if one != other and frozenset((one, other)) not in self._outline_pairs:
                    self._outline_pairs.add(frozenset((one, other)))
                    changed = True
                elif one == other:
                    changed |= self._rest_again(i if layout.carried[j].parent == TABLE_TOP or j in layout.tree(i) else j)
        self._floating = {number[o.instance] for o in audit.objects if o.floats}
        for o in audit.objects:
            if o.floats or o.table_penetration > TOLERANCE:
                changed |= self._rest_again(number[o.instance])
        if not changed:
            self.reason = f"the exact audit refuses objects that cannot be moved: {remaining_faults(audit)}"
        return changed

    def _rest_again(self, k: int) -> bool:
        """Rests an object on its carrier again; the second time, puts it on the table."""
        layout = self.layout
        if layout.stiffness(layout.root_of(k)) == float("inf") and layout.is_fixed[k]:
            return False
        if layout.carried[k].parent != TABLE_TOP and k not in self._rested_again:
            self._rested_again.add(k)
            own = set(layout.tree(k))
            others = [m for m in layout.tree(layout.root_of(k)) if m not in own and m not in self._floating]
            rest = self._resting_pose(k, layout.carried[k], others)
            self._floating.discard(k)
            if rest is not None and not np.array_equal(rest.pose, layout.poses[k]):
                layout.carry(k, rest.pose)
                return True
        was_standing = layout.carried[k].parent == TABLE_TOP and abs(layout.low(k)) <= _LEVEL
        layout.stand(k)
        self._rest_tree(k)
        return not was_standing


def build_scene(layout: LayoutState) -> Scene:
    """Returns a layout as a scene; an object that has not moved is the input object itself."""
    before = layout.scene.poses()
    objects = []
    for k in layout.present():
        o, pose = layout.scene.objects[k], layout.poses[k]
        if not np.array_equal(pose, before[k]):
            x, y, z, yaw = pose.tolist()
            o = o.moved((x, y, z), yaw)
        objects.append(o)
    return replace(layout.scene, objects=tuple(objects))


def remaining_faults(audit: Audit | None) -> str:
    """Returns what is not clean, the first five faults."""
    if audit is None:
        return "nothing was checked"
    pairs = [f"{p.first} is in {p.second}" for p in audit.pairs if p.penetration is None or p.penetration > audit.tolerance]
    alone = [f"{o.instance} floats" for o in audit.objects if o.floats]
    alone += [f"{o.instance} is off its area" for o in audit.objects if o.is_outside]
    alone += [f"{o.instance} is in the table" for o in audit.objects if o.table_penetration > audit.tolerance]
    return "; ".join([*pairs, *alone][:5])
