"""Backtracking over a graph of relations, after I-Design's placement of furniture.

Çelen et al., "I-Design", 2024, place the objects of a scene graph one after the other, each at a random place where its relations to
those before it hold and its box collides with none; if there is no such place, the object before gets another one.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from models.baselines.placement.candidates import broken_constraints, candidates_of, degrees, holds, why_dropped
from models.baselines.placement.problem import DIRECTIONS, Placement, PlacementProblem, PlacementRelation
from stable_data.scene import FloatArray, SceneObject

_AROUND = 0.35  # half of the places are drawn at most this far from what an object is related to, metres
_FACED = frozenset({PlacementRelation.FACING, PlacementRelation.FACE_TO})


@dataclass(frozen=True, slots=True)
class Backtracking:
    """The search.

    Attributes:
        num_draws: Points that are drawn for an object, each with four yaws.
        num_branches: Places of an object that are kept to come back to.
        patience: Number of dead ends at an object after which it is dropped.
        most_tried: How often objects are tried, at most; afterwards, an object without a place is dropped at once.
    """

    num_draws: int = 400
    num_branches: int = 4
    patience: int = 8
    most_tried: int = 400

    def __call__(self, problem: PlacementProblem) -> Placement:
        """Finds places at which all relations hold; objects for which there is none are dropped."""
        rng, order = np.random.default_rng(problem.seed), problem.order()
        placed: dict[str, SceneObject] = {}
        left: list[list[SceneObject]] = []  # the other places of each object before the present one
        dead_ends = dict.fromkeys((o.instance for o in order), 0)
        num_tried = 0
        while len(left) < len(order):
            o = order[len(left)]
            if o.instance in problem.carriers and problem.support_of(o.instance) not in placed:
                left.append([])  # no other place of it would help
                continue
            places = self._places(o, problem, placed, rng)
            num_tried += 1
            if places:
                placed[o.instance] = places[0]
                left.append(places[1:])
                continue
            dead_ends[o.instance] += 1
            again = next((k for k in reversed(range(len(left))) if left[k]), None)
            if again is None or dead_ends[o.instance] >= self.patience or num_tried >= self.most_tried:
                left.append([])  # without this object
                continue
            for later in order[again + 1 :]:
                placed.pop(later.instance, None)
            placed[order[again].instance] = left[again].pop(0)
            del left[again + 1 :]
        dropped = {o.instance: self._why(o.instance, problem, placed) for o in order if o.instance not in placed}
        objects = tuple(placed[o.instance] for o in problem.objects if o.instance in placed)
        return Placement(objects, dropped, broken_constraints(problem, placed), num_tried)

    def _places(
        self, o: SceneObject, problem: PlacementProblem, placed: Mapping[str, SceneObject], rng: np.random.Generator
    ) -> list[SceneObject]:
        """A few of the places at which the relations of an object to those before it hold, in random order."""
        related = [placed[n] for c in problem.constraints if o.instance in c.members for n in c.members if n in placed]
        poses = candidates_of(o, problem, placed, self._points(problem, related, rng), rng.uniform(-1.0, 1.0, (32, 2)))
        told = degrees(o.instance, poses, problem, placed)
        fits = np.ones(len(poses), np.bool_)
        for _, degree in told:
            fits &= holds(degree)
        if not any(c.subject == o.instance and c.kind in _FACED for c, _ in told):
            front = fits & (poses.yaw == 0)  # an object faces the viewer if it may
            fits = front if front.any() else fits
        rows = np.flatnonzero(fits)[: self.num_branches]
        return [poses.placed(k, o, problem.support_of(o.instance)) for k in rows.tolist()]

    def _points(self, problem: PlacementProblem, related: list[SceneObject], rng: np.random.Generator) -> FloatArray:
        """Points that are drawn on the table, (P, 2), metres: half of them near what an object is related to, in random order."""
        size = np.array(problem.table.size_xy)
        points = rng.uniform(0.0, size, (self.num_draws, 2))
        if related:
            centres = np.array([o.position[:2] for o in related])
            chosen = rng.integers(len(centres), size=self.num_draws // 2)
            points[::2][: len(chosen)] = centres[chosen] + rng.uniform(-_AROUND, _AROUND, (len(chosen), 2))
        return points

    @staticmethod
    def _why(name: str, problem: PlacementProblem, placed: Mapping[str, SceneObject]) -> str:
        stated = [str(c) for c in problem.constraints if name in c.members and c.kind in (*DIRECTIONS, *_FACED)]
        reason = why_dropped(name, problem, placed)
        return f"{reason} where {', '.join(stated)}" if stated and name not in problem.carriers else reason
