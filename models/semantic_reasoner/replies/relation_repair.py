"""Moves objects until the relations that the instruction states hold, in replies without any other fault.

The reasoner does this only after the last try. Each move is reported as a soft fault.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import TypeAlias

from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.replies.places import (
    DIRECTION,
    places_beside,
    places_between,
    places_in_cell,
    places_in_layers,
    places_on_or_in,
)
from models.semantic_reasoner.replies.rearrangement import rearrangements
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutReply
from stable_data.metrics.alignment import members
from stable_data.scene import Relation, RelationKind, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.support_from_boxes import carriers_of
from stable_data.scene_graph.support_tree import SupportTree, ancestors

MOVED = "moved_to_hold"
"""Code of the fault that reports a move."""

_MOST_PAIRS = 20_000
"""Pairs of objects in all layouts that are checked, at most: two hundred layouts of ten objects, or twelve of forty."""

_MOST_ARRANGEMENTS = 4
"""Arrangements of several objects that are checked, at most."""

_Moves: TypeAlias = Mapping[str, Relation]
"""The instances that move, and the relation that each of them moves for."""


def repair_relations(
    reply: LayoutReply,
    faults: Sequence[ReplyFault],
    question: ReasonerQuestion,
    check: Callable[[LayoutReply, ReasonerQuestion], Sequence[ReplyFault]],
    stated: Sequence[Relation] = (),
) -> tuple[LayoutReply, tuple[ReplyFault, ...]] | None:
    """Moves objects of a reply until all relations that the instruction states hold.

    Args:
        reply: The reply.
        faults: Its faults.
        question: The question.
        check: Finds the faults of a reply.
        stated: All relations that the instruction states, in the names of the reply. With them, objects are arranged anew together
            where moves of single ones do not suffice.

    Returns:
        The reply, and soft faults: those that report the moves, and those that remain; None if the reply has a hard fault, or no
        place is found.
    """
    if any(f.is_hard for f in faults):
        return None
    moved: list[ReplyFault] = []
    num_checks = 1 + _MOST_PAIRS // max(1, len(reply.objects)) ** 2
    while broken := [f.relation for f in faults if f.relation is not None]:
        single = islice(_candidate_replies(reply, broken, question.table), num_checks)
        anew = islice(_arranged_anew(reply, broken, stated, question), _MOST_ARRANGEMENTS)
        for moves, candidate in chain(single, anew):
            num_checks = max(0, num_checks - 1)
            left = check(candidate, question)
            # Every accepted move removes a fault, so the loop ends.
            if not any(f.is_hard for f in left) and sum(f.relation is not None for f in left) < len(broken):
                moved += (_moved(name, relation) for name, relation in moves.items())
                reply, faults = candidate, left
                break
        else:
            return None
    return reply, (*moved, *faults)


def _moved(name: str, relation: Relation) -> ReplyFault:
    message = f"{name} is moved so that {relation.subject} is {_relation_words(relation)}, as the instruction says"
    return ReplyFault(MOVED, message, is_hard=False)


def _relation_words(relation: Relation) -> str:
    kind = str(relation.kind).removeprefix("is ")
    if relation.kind is RelationKind.BETWEEN:
        return f"{kind} {relation.target.replace(', ', ' and ')}"
    return f"{kind} {relation.target.replace('_', ' ') if relation.kind is RelationKind.IS_AT else relation.target}"


def _candidate_replies(reply: LayoutReply, broken: Sequence[Relation], table: Tabletop) -> Iterator[tuple[_Moves, LayoutReply]]:
    """Replies in which more relations may hold: first with all contents in their carriers, then with one move for one relation."""
    names = {o.instance for o in reply.objects}  # an object of an earlier stage may not move
    carried = {r.subject: r for r in broken if r.kind in (RelationKind.IN, RelationKind.ON) and set(members(r)) <= names}
    if len(carried) > 1 and (candidate := _with_all_carried(reply, carried, table)) is not None:
        yield carried, candidate
    if set(members(broken[0])) <= names:
        yield from (({name: broken[0]}, candidate) for name, candidate in _with_one_moved(reply, broken[0], table))


def _arranged_anew(
    reply: LayoutReply, broken: Sequence[Relation], stated: Sequence[Relation], question: ReasonerQuestion
) -> Iterator[tuple[_Moves, LayoutReply]]:
    """Replies in which all stated relations hold by boxes: contents go to their carriers, then several objects move together."""
    movable = {o.instance for o in reply.objects}
    carried = {r.subject: r for r in broken if r.kind in (RelationKind.IN, RelationKind.ON) and set(members(r)) <= movable}
    whole = _with_all_carried(reply, carried, question.table) if carried else reply
    if whole is None or not stated:
        return
    objects = {o.instance: o.to_scene_object() for o in (*question.layout, *whole.objects)}
    carriers = carriers_of(list(objects.values()), question.table)
    for places in rearrangements(objects, carriers, movable, stated, broken, question.table):
        moves, candidate = dict(carried), whole
        for name, place in places.items():
            group = SupportTree(carriers).with_descendants({name})
            # Of alike objects, a broken relation may name another one than the stated relation.
            moves[name] = next(r for r in (*stated, *broken) if group & set(members(r)))
            candidate = _with_moved(candidate, name, place, carriers)
        yield moves, candidate


def _with_all_carried(reply: LayoutReply, carried: _Moves, table: Tabletop) -> LayoutReply | None:
    """The reply with objects side by side on or in their carriers, or in layers; None if a carrier has no room for them."""
    target = {name: r.target for name, r in carried.items()}
    now = carriers_of([o.to_scene_object() for o in reply.objects], table)
    num_placed = Counter(carrier for name, carrier in now.items() if name not in carried)
    for name in sorted(carried, key=lambda name: len(list(ancestors(target, name)))):  # carriers before their contents
        objects = {o.instance: o.to_scene_object() for o in reply.objects}
        places = places_in_layers(objects[name], objects[target[name]], carried[name].kind)
        found = next(islice(places, num_placed[target[name]], None), None)
        if found is None:
            return None
        num_placed[target[name]] += 1
        reply = _with_moved(reply, name, found[1], carriers_of(list(objects.values()), table))
    return reply


def _with_one_moved(reply: LayoutReply, relation: Relation, table: Tabletop) -> Iterator[tuple[str, LayoutReply]]:
    """Instances whose move may make a relation hold, each with the reply after the move; the smallest change first."""
    objects = {o.instance: o.to_scene_object() for o in reply.objects}
    carriers: Mapping[str, str | None] = carriers_of(list(objects.values()), table)
    if relation.kind is RelationKind.IS_AT:
        found = places_in_cell(relation, objects, carriers, table)
    elif relation.kind in DIRECTION:
        found = places_beside(relation, objects, carriers)
    elif relation.kind is RelationKind.BETWEEN:
        found = places_between(relation, objects, carriers)
    else:
        if relation.subject in ancestors(carriers, relation.target):
            reply, carriers = _with_target_below(reply, relation, objects, carriers)
            objects = {o.instance: o.to_scene_object() for o in reply.objects}
        found = places_on_or_in(objects[relation.subject], objects[relation.target], relation.kind)
    for name, place in found:
        yield name, _with_moved(reply, name, place, carriers)


def _with_target_below(
    reply: LayoutReply, relation: Relation, objects: Mapping[str, SceneObject], carriers: Mapping[str, str | None]
) -> tuple[LayoutReply, Mapping[str, str | None]]:
    """The reply with the target of a relation, which its subject carries, where the subject stands; and the supports after that."""
    subject, target = objects[relation.subject], objects[relation.target]
    place = (*subject.position[:2], subject.bottom + target.size[2] / 2)
    return _with_moved(reply, target.instance, place, carriers), {**carriers, target.instance: carriers[subject.instance]}


def _with_moved(reply: LayoutReply, name: str, place: Vec3, carriers: Mapping[str, str | None]) -> LayoutReply:
    """The reply after a move of one object, together with all that it supports."""
    group = SupportTree(carriers).with_descendants({name})
    was = next(o.position_cm for o in reply.objects if o.instance == name)

    def moved(position_cm: Vec3) -> Vec3:
        # + 0.0 turns -0.0 into 0.0, which is rendered differently.
        x, y, z = (round(p + 100 * to - old, 1) + 0.0 for p, to, old in zip(position_cm, place, was, strict=True))
        return x, y, z

    return replace(
        reply, objects=tuple(replace(o, position_cm=moved(o.position_cm)) if o.instance in group else o for o in reply.objects)
    )
