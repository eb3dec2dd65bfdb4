"""Puts things where their instruction says that they are, in replies whose only fault is that they are elsewhere.

This is the last resort, after every answer had the same fault: a scene in which the mug stands to the left of the plate is what
was asked for, whoever put it there. What was moved is said.
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
"""Code of the fault that says what was moved."""

_TOWARDS = {
    RelationKind.LEFT_OF: (-1.0, 0.0),
    RelationKind.RIGHT_OF: (1.0, 0.0),
    RelationKind.IN_FRONT_OF: (0.0, -1.0),
    RelationKind.BEHIND: (0.0, 1.0),
}
_GAPS = (0.02, 0.05, 0.1, 0.2, 0.35)  # between two things side by side, metres, the nearest first
_ASIDE = (0.0, 0.04, -0.04, 0.08, -0.08, 0.15, -0.15)  # across that, metres
_IN_CELL = 5  # places along each side of a ninth of the table
_OFF_CENTRE = (0.0, 0.25, -0.25, 0.5, -0.5)  # of what carries, in halves of its extent
_ABOVE_BOTTOM = 0.01  # where a thing in another one may lie, metres; how deep it really lies is for the correction


def repair_relations(
    reply: LayoutReply,
    faults: Sequence[ReplyFault],
    ask: ReasonerQuestion,
    check: Callable[[LayoutReply, ReasonerQuestion], Sequence[ReplyFault]],
) -> tuple[LayoutReply, tuple[ReplyFault, ...]] | None:
    """A reply with things moved until all that the instruction says of the start is so.

    Args:
        reply: The reply.
        faults: What is wrong with it.
        ask: What it answers.
        check: Finds faults.

    Returns:
        The reply, and soft faults that say what was moved; None where something else is wrong, or no place is found.
    """
    moved = []
    while faults:
        relation = faults[0].relation
        if relation is None or any(f.relation is None for f in faults):
            return None
        for name, tried in _places(reply, relation, ask.table):
            left = check(tried, ask)
            if len(left) < len(faults) and all(f.relation is not None for f in left):
                message = f"{name} is moved so that {relation.subject} is {_words(relation)}, as the instruction says"
                moved.append(ReplyFault(MOVED, message, is_hard=False))
                reply, faults = tried, left
                break
        else:
            return None
    return reply, tuple(moved)


def _words(relation: Relation) -> str:
    kind = str(relation.kind).removeprefix("is ")
    return f"{kind} {relation.target.replace('_', ' ') if relation.kind is RelationKind.IS_AT else relation.target}"


def _places(reply: LayoutReply, relation: Relation, table: Tabletop) -> Iterator[tuple[str, LayoutReply]]:
    """What could be moved for a relation to hold, and the reply with it moved, the gentlest first."""
    there = {o.instance: o.to_scene_object() for o in reply.objects}
    if relation.subject not in there or (relation.kind is not RelationKind.IS_AT and relation.target not in there):
        return  # it is not the reply's to place
    carriers = carriers_of(list(there.values()), table)
    if relation.kind is RelationKind.IS_AT:
        found = _in_cell(relation, there, carriers, table)
    elif relation.kind in _TOWARDS:
        found = _beside(relation, there, carriers)
    else:
        found = _carried(there[relation.subject], there[relation.target], relation.kind)
    for name, place in found:
        yield name, replace(reply, objects=_shifted(reply.objects, name, np.subtract(place, there[name].position), carriers))


Place = tuple[str, tuple[float, float, float]]


def _beside(relation: Relation, there: dict[str, SceneObject], carriers: dict[str, str | None]) -> Iterator[Place]:
    """One thing beside the other, on what that stands on, or else on the table; then the other way about."""
    way = np.array(_TOWARDS[relation.kind])
    for one, other, sign in ((relation.subject, relation.target, 1.0), (relation.target, relation.subject, -1.0)):
        mover, anchor = there[one], there[other]
        axis = int(way[1] != 0)
        reach = _half(mover)[axis] + _half(anchor)[axis]
        lows = [0.0]
        if carriers[other] not in (None, TABLE, one):
            lows.insert(0, anchor.bottom)
        elif carriers[one] == TABLE:
            lows = [mover.bottom]
        for low, gap, aside in itertools.product(lows, _GAPS, _ASIDE):
            if abs(aside) < reach + gap:
                across = np.array((way[1], way[0])) * aside
                x, y = anchor.position[:2] + sign * way * (reach + gap) + across
                yield one, (x, y, low + mover.size[2] / 2)


def _in_cell(
    relation: Relation, there: dict[str, SceneObject], carriers: dict[str, str | None], table: Tabletop
) -> Iterator[Place]:
    """A thing, or what carries it, in a ninth of the table."""
    names = (relation.subject, *ancestors(carriers, relation.subject))
    for name in reversed(names):  # with what carries it before alone
        mover = there[name]
        half, size = _half(mover), np.array(table.size_xy)
        spots = [np.clip(np.array(spot), half, np.maximum(half, size - half)) for spot in _grid(size)]
        off = there[relation.subject].position[:2] - np.array(mover.position[:2])
        for spot in sorted(spots, key=lambda s: float(np.linalg.norm(s - mover.position[:2]))):
            where = spot + off
            if cell_of((float(where[0]), float(where[1])), table.size_xy) == relation.target:
                low = mover.bottom if carriers[name] == TABLE else 0.0
                yield name, (float(spot[0]), float(spot[1]), low + mover.size[2] / 2)


def _carried(subject: SceneObject, target: SceneObject, kind: RelationKind) -> Iterator[Place]:
    """A thing on another one or in it; without meshes nobody knows what is hollow."""
    half = _half(target)
    lows = (target.top, target.bottom + _ABOVE_BOTTOM)
    for low in reversed(lows) if kind is RelationKind.IN else lows:
        for x, y in itertools.product(_OFF_CENTRE, repeat=2):
            spot = target.position[:2] + half * (x, y)
            yield subject.instance, (float(spot[0]), float(spot[1]), low + subject.size[2] / 2)


def _grid(size: FloatArray) -> Iterator[tuple[float, float]]:
    """Places all over a table, so many along each side of a ninth."""
    steps = (np.arange(3 * _IN_CELL) + 0.5) / (3 * _IN_CELL)
    for x, y in itertools.product(steps, repeat=2):
        yield x * size[0], y * size[1]


def _half(o: SceneObject) -> FloatArray:
    """Half of an object's extent along x and y as it stands, metres."""
    return np.asarray(np.ptp(yawed_rectangle(o), axis=0) / 2)


def _shifted(
    objects: Sequence[LayoutObject], name: str, step: FloatArray, carriers: dict[str, str | None]
) -> tuple[LayoutObject, ...]:
    """Objects with one moved, and all that it carries with it."""
    gone = SupportTree(carriers).with_descendants({name})

    def moved(position_cm: Vec3) -> Vec3:
        x, y, z = (round(p + 100 * float(s), 1) + 0.0 for p, s in zip(position_cm, step, strict=True))
        return x, y, z

    return tuple(replace(o, position_cm=moved(o.position_cm)) if o.instance in gone else o for o in objects)
