"""Moves objects until the relations that the instruction states hold, in replies without any other fault.

The reasoner does this only after the last try. Each move is reported as a soft fault.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.relations import cell_of, yawed_rectangle
from stable_data.scene_graph.support_from_boxes import carriers_of
from stable_data.scene_graph.support_tree import SupportTree, ancestors

MOVED = "moved_to_hold"
"""Code of the fault that reports a move."""

_DIRECTION = {
    RelationKind.LEFT_OF: (-1.0, 0.0),
    RelationKind.RIGHT_OF: (1.0, 0.0),
    RelationKind.IN_FRONT_OF: (0.0, -1.0),
    RelationKind.BEHIND: (0.0, 1.0),
}
_GAPS = (0.02, 0.05, 0.1, 0.2, 0.35)  # between two objects side by side, metres, the smallest first
_ASIDE = (0.0, 0.04, -0.04, 0.08, -0.08, 0.15, -0.15)  # at right angles to the gap, metres
_SPOTS_PER_CELL = 5  # along each side of a ninth of the table
_OFF_CENTRE = (0.0, 0.25, -0.25, 0.5, -0.5)  # from the support's centre, in half extents of the support
_ABOVE_BOTTOM = 0.01  # of an object in a container, metres; the correction finds its real height


def repair_relations(
    reply: LayoutReply,
    faults: Sequence[ReplyFault],
    question: ReasonerQuestion,
    check: Callable[[LayoutReply, ReasonerQuestion], Sequence[ReplyFault]],
) -> tuple[LayoutReply, tuple[ReplyFault, ...]] | None:
    """Moves objects of a reply until all relations that the instruction states hold.

    Returns:
        The reply, and soft faults that report the moves; None if the reply has another fault, or no place is found.
    """
    moved = []
    while faults:
        relation = faults[0].relation
        if relation is None or any(f.relation is None for f in faults):
            return None
        for name, candidate in _candidate_replies(reply, relation, question.table):
            left = check(candidate, question)
            # Every accepted move removes a fault, so the loop ends.
            if len(left) < len(faults) and all(f.relation is not None for f in left):
                message = f"{name} is moved so that {relation.subject} is {_relation_words(relation)}, as the instruction says"
                moved.append(ReplyFault(MOVED, message, is_hard=False))
                reply, faults = candidate, left
                break
        else:
            return None
    return reply, tuple(moved)


def _relation_words(relation: Relation) -> str:
    kind = str(relation.kind).removeprefix("is ")
    return f"{kind} {relation.target.replace('_', ' ') if relation.kind is RelationKind.IS_AT else relation.target}"


def _candidate_replies(reply: LayoutReply, relation: Relation, table: Tabletop) -> Iterator[tuple[str, LayoutReply]]:
    """Instances whose move may make a relation hold, each with the reply after the move; the smallest change first."""
    objects = {o.instance: o.to_scene_object() for o in reply.objects}
    if relation.subject not in objects or (relation.kind is not RelationKind.IS_AT and relation.target not in objects):
        return  # an object of an earlier stage, which may not move
    carriers = carriers_of(list(objects.values()), table)
    if relation.kind is RelationKind.IS_AT:
        found = _places_in_cell(relation, objects, carriers, table)
    elif relation.kind in _DIRECTION:
        found = _places_beside(relation, objects, carriers)
    else:
        found = _places_on_or_in(objects[relation.subject], objects[relation.target], relation.kind)
    for name, place in found:
        step = np.subtract(place, objects[name].position)
        yield name, replace(reply, objects=_with_moved(reply.objects, name, step, carriers))


_Place = tuple[str, tuple[float, float, float]]


def _places_beside(relation: Relation, objects: dict[str, SceneObject], carriers: dict[str, str | None]) -> Iterator[_Place]:
    """The subject beside the target, on the target's support or else on the table; then the target beside the subject."""
    direction = np.array(_DIRECTION[relation.kind])
    for one, other, sign in ((relation.subject, relation.target, 1.0), (relation.target, relation.subject, -1.0)):
        mover, anchor = objects[one], objects[other]
        axis = int(direction[1] != 0)
        reach = _half_extent(mover)[axis] + _half_extent(anchor)[axis]
        lows = [0.0]
        if carriers[other] not in (None, TABLE, one):
            lows.insert(0, anchor.bottom)
        elif carriers[one] == TABLE:
            lows = [mover.bottom]
        for low, gap, aside in itertools.product(lows, _GAPS, _ASIDE):
            if abs(aside) < reach + gap:  # the offset along the relation has to be the larger one
                across = np.array((direction[1], direction[0])) * aside
                x, y = anchor.position[:2] + sign * direction * (reach + gap) + across
                yield one, (x, y, low + mover.size[2] / 2)


def _places_in_cell(
    relation: Relation, objects: dict[str, SceneObject], carriers: dict[str, str | None], table: Tabletop
) -> Iterator[_Place]:
    """An object, or one of its supports, in a ninth of the table."""
    names = (relation.subject, *ancestors(carriers, relation.subject))
    for name in reversed(names):  # its lowest support first, so that stacks stay together
        mover = objects[name]
        half, size = _half_extent(mover), np.array(table.size_xy)
        spots = [np.clip(np.array(spot), half, np.maximum(half, size - half)) for spot in _spots(size)]
        offset = objects[relation.subject].position[:2] - np.array(mover.position[:2])
        for spot in sorted(spots, key=lambda s: float(np.linalg.norm(s - mover.position[:2]))):
            x, y = (spot + offset).tolist()
            if cell_of((x, y), table.size_xy) == relation.target:
                low = mover.bottom if carriers[name] == TABLE else 0.0
                yield name, (float(spot[0]), float(spot[1]), low + mover.size[2] / 2)


def _places_on_or_in(subject: SceneObject, target: SceneObject, kind: RelationKind) -> Iterator[_Place]:
    """The subject on the target and in it, whatever the relation: without meshes it is unknown which objects are hollow."""
    half = _half_extent(target)
    lows = (target.top, target.bottom + _ABOVE_BOTTOM)
    for low in reversed(lows) if kind is RelationKind.IN else lows:
        for x, y in itertools.product(_OFF_CENTRE, repeat=2):
            spot = target.position[:2] + half * (x, y)
            yield subject.instance, (float(spot[0]), float(spot[1]), low + subject.size[2] / 2)


def _spots(size: FloatArray) -> Iterator[tuple[float, float]]:
    """Points of a regular grid over the table, :data:`_SPOTS_PER_CELL` along each side of a ninth."""
    steps = (np.arange(3 * _SPOTS_PER_CELL) + 0.5) / (3 * _SPOTS_PER_CELL)
    for x, y in itertools.product(steps, repeat=2):
        yield x * size[0], y * size[1]


def _half_extent(o: SceneObject) -> FloatArray:
    """Half extents of a yawed object along x and y, metres."""
    return np.asarray(np.ptp(yawed_rectangle(o), axis=0) / 2)


def _with_moved(
    objects: Sequence[LayoutObject], name: str, step: FloatArray, carriers: dict[str, str | None]
) -> tuple[LayoutObject, ...]:
    """The objects after a move of one of them together with all that it supports."""
    group = SupportTree(carriers).with_descendants({name})

    def moved(position_cm: Vec3) -> Vec3:
        # + 0.0 turns -0.0 into 0.0, which is rendered differently.
        x, y, z = (round(p + 100 * float(s), 1) + 0.0 for p, s in zip(position_cm, step, strict=True))
        return x, y, z

    return tuple(replace(o, position_cm=moved(o.position_cm)) if o.instance in group else o for o in objects)
