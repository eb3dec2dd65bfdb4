"""Depth-first search over a grid of poses with soft scores, after Holodeck's placement of furniture.

Yang et al., "Holodeck", CVPR 2024, place one object after the other: all poses of a grid at which its box collides with no other one
are scored by the relations that they meet, and the best ones are tried first; the best layout that was found within a time limit is
used. Here the limit is a number of tries, so that a rerun gives the same layout.
"""

from dataclasses import dataclass, field

import numpy as np

from models.baselines.placement.candidates import (
    PlaceCandidates,
    broken_constraints,
    candidates_of,
    degrees,
    why_dropped,
)
from models.baselines.placement.problem import Placement, PlacementProblem, PlacementRelation
from stable_data.scene import FloatArray, SceneObject

_WEIGHTS = {
    PlacementRelation.NEAR: 0.8,
    PlacementRelation.FACING: 0.5,
    PlacementRelation.FACE_TO: 0.5,
    PlacementRelation.ALIGNED_WITH: 0.4,
}
"""Score of a relation that holds; 1 for the others."""

_PLACED = 10.0  # score of an object that has a place: no relation outweighs it
_FRONT = 0.3  # of the yaw 0, at which an object faces the viewer, if no relation says where it faces
_EDGE, _EDGE_SCORE = 0.02, -0.3  # nearer to the edge than this, metres, costs so much
_CENTRE_SCORE = -0.5  # of a place at the rim of a carrier
_NOISE = 0.3  # scatters objects about which nothing is said
_DISTINCT = 0.05  # two poses that are tried differ by this much, metres, or by their yaw
_CARRIER_STEPS = 7


@dataclass(frozen=True, slots=True)
class GridSearch:
    """The search.

    Attributes:
        step: Step of the grid on the table, metres.
        num_branches: Poses of an object that are tried, at most.
        most_tried: How often objects are tried, at most, in all restarts together.
        num_restarts: Searches with other random choices; the best result is used.
    """

    step: float = 0.025
    num_branches: int = 3
    most_tried: int = 240
    num_restarts: int = 4

    def __call__(self, problem: PlacementProblem) -> Placement:
        """Finds places; objects for which there is none are dropped."""
        rng, order, best = np.random.default_rng(problem.seed), problem.order(), _Best()
        run = _Run(self, problem, order, rng, best)
        for number in range(self.num_restarts):
            run.until = (number + 1) * self.most_tried // self.num_restarts
            run.search(0, {}, 0.0)
            if best.is_complete or run.num_tried >= self.most_tried:
                break
        dropped = {o.instance: why_dropped(o.instance, problem, best.placed) for o in order if o.instance not in best.placed}
        objects = tuple(best.placed[o.instance] for o in problem.objects if o.instance in best.placed)
        return Placement(objects, dropped, broken_constraints(problem, best.placed), run.num_tried)


@dataclass(slots=True, eq=False)
class _Best:
    """The best layout so far."""

    placed: dict[str, SceneObject] = field(default_factory=dict)
    score: float = -np.inf
    is_complete: bool = False


@dataclass(slots=True, eq=False)
class _Run:
    """The state of a search.

    Attributes:
        until: Number of tries after which the present restart ends.
        num_tried: Number of tries so far.
    """

    settings: GridSearch
    problem: PlacementProblem
    order: list[SceneObject]
    rng: np.random.Generator
    best: _Best
    until: int = 0
    num_tried: int = 0

    def search(self, index: int, placed: dict[str, SceneObject], score: float) -> None:
        """Places the objects from an index on, and keeps the best layout."""
        if index == len(self.order):
            if score > self.best.score:
                self.best.placed, self.best.score = dict(placed), score
                is_whole = len(placed) == len(self.order)
                self.best.is_complete = is_whole and not broken_constraints(self.problem, placed)
            return
        o = self.order[index]
        poses, scores = self._poses(o, placed)
        if not len(poses):
            self.search(index + 1, placed, score)
            return
        for k in _distinct(poses, scores, self.settings.num_branches):
            placed[o.instance] = poses.placed(k, o, self.problem.support_of(o.instance))
            self.search(index + 1, placed, score + _PLACED + float(scores[k]))
            del placed[o.instance]
            # The first descent of a restart is always finished, so that there is a layout.
            if self.best.is_complete or self.num_tried >= self.until:
                return

    def _poses(self, o: SceneObject, placed: dict[str, SceneObject]) -> tuple[PlaceCandidates, FloatArray]:
        """The free poses of an object with their scores; none if what carries it has no place."""
        self.num_tried += 1
        link = self.problem.carriers.get(o.instance)
        if link is not None and link.target not in placed:
            return PlaceCandidates(np.empty((0, 3)), np.empty((0, 3)), np.empty(0)), np.empty(0)
        poses = candidates_of(o, self.problem, placed, self._points(), _carrier_points())
        score = self.rng.uniform(0.0, _NOISE, len(poses))
        faces = False
        for c, degree in degrees(o.instance, poses, self.problem, placed):
            score += _WEIGHTS.get(c.kind, 1.0) * degree
            faces |= c.subject == o.instance and c.kind in (PlacementRelation.FACING, PlacementRelation.FACE_TO)
        if not faces:
            score += _FRONT * (poses.yaw == 0)
        if link is None:
            size = np.array(self.problem.table.size_xy)
            margin = np.minimum(poses.centre[:, :2], size - poses.centre[:, :2]) - poses.half[:, :2]
            score += _EDGE_SCORE * (margin.min(axis=1, initial=np.inf) < _EDGE)
        else:
            base = PlaceCandidates.at(placed[link.target])
            offset = np.abs(poses.centre[:, :2] - base.centre[:, :2]) / base.half[:, :2]
            score += _CENTRE_SCORE * offset.max(axis=1, initial=0.0)
        return poses, score

    def _points(self) -> FloatArray:
        """The grid on the table, (P, 2), metres, shifted at random."""
        step = self.settings.step
        first = self.rng.uniform(0.0, step, 2)
        x, y = (np.arange(f, size, step) for f, size in zip(first, self.problem.table.size_xy, strict=True))
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _carrier_points() -> FloatArray:
    """The grid across a carrier, (P, 2), from -1 to 1."""
    along = np.linspace(-1.0, 1.0, _CARRIER_STEPS)
    return np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)


def _distinct(poses: PlaceCandidates, scores: FloatArray, count: int) -> list[int]:
    """The best poses that differ from each other."""
    chosen: list[int] = []
    for k in np.argsort(-scores, kind="stable").tolist():
        differs = [
            np.linalg.norm(poses.centre[k] - poses.centre[other]) >= _DISTINCT or poses.yaw[k] != poses.yaw[other]
            for other in chosen
        ]
        if all(differs):
            chosen.append(k)
        if len(chosen) == count:
            break
    return chosen
