"""Moves objects until the relations that the instruction states hold, in replies without any other fault.

The reasoner does this only after the last try. Each move is reported as a soft fault.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.replies.places import DIRECTION, places_beside, places_between, places_in_cell, places_on_or_in
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.metrics.alignment import members
from stable_data.scene import FloatArray, Relation, RelationKind, Tabletop, Vec3
from stable_data.scene_graph.support_from_boxes import carriers_of
from stable_data.scene_graph.support_tree import SupportTree

MOVED = "moved_to_hold"
"""Code of the fault that reports a move."""


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
    if relation.kind is RelationKind.BETWEEN:
        return f"{kind} {relation.target.replace(', ', ' and ')}"
    return f"{kind} {relation.target.replace('_', ' ') if relation.kind is RelationKind.IS_AT else relation.target}"


def _candidate_replies(reply: LayoutReply, relation: Relation, table: Tabletop) -> Iterator[tuple[str, LayoutReply]]:
    """Instances whose move may make a relation hold, each with the reply after the move; the smallest change first."""
    objects = {o.instance: o.to_scene_object() for o in reply.objects}
    if not set(members(relation)) <= objects.keys():
        return  # an object of an earlier stage, which may not move
    carriers = carriers_of(list(objects.values()), table)
    if relation.kind is RelationKind.IS_AT:
        found = places_in_cell(relation, objects, carriers, table)
    elif relation.kind in DIRECTION:
        found = places_beside(relation, objects, carriers)
    elif relation.kind is RelationKind.BETWEEN:
        found = places_between(relation, objects, carriers)
    else:
        found = places_on_or_in(objects[relation.subject], objects[relation.target], relation.kind)
    for name, place in found:
        step = np.subtract(place, objects[name].position)
        yield name, replace(reply, objects=_with_moved(reply.objects, name, step, carriers))


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
