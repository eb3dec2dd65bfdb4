"""Rules that the relations of a draft have to obey before objects can be placed by them: I-Design's check of its scene graph.

A relation that breaks a rule is left out; the fault says why, for a model or a person.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import networkx as nx

from models.baselines.layout.draft import RelationText
from models.baselines.placement.problem import CARRYING, DIRECTIONS, UNARY, Constraint, PlacementRelation
from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.scene import TABLE

UNRELATED = "unrelated"
"""Code of the fault that no relation says where an object is."""

_SINGLE = frozenset({PlacementRelation.FACE_TO, PlacementRelation.FACING})
_SLACK = 1.05  # a content may be this much larger than its container: sizes are estimates


@dataclass(frozen=True, slots=True)
class CheckedRelations:
    """The relations that obey the rules, and what is wrong with the others.

    Attributes:
        constraints: The relations, in their order.
        faults: One for each relation that is left out, and one for all objects without any relation.
        num_related: Number of objects that some relation places.
    """

    constraints: tuple[Constraint, ...]
    faults: tuple[ReplyFault, ...]
    num_related: int


def check_relations(stated: Sequence[RelationText | Constraint], objects: Sequence[LayoutObject]) -> CheckedRelations:
    """Checks relations one after the other; of two that exclude each other, the first one stays.

    Args:
        stated: The relations.
        objects: The objects that they may name.
    """
    checks = _Checks({o.instance: o for o in objects})
    faults = []
    for relation in stated:
        reason = checks.add(relation)
        if reason is not None:
            faults.append(ReplyFault(reason[0], f"{relation}: {reason[1]}", is_hard=False))
    kept = tuple(checks.kept)
    about = {name for c in kept for name in c.members} | checks.on_table
    alone = [o.instance for o in objects if o.instance not in about]
    if alone:
        message = f"no relation says where {', '.join(alone)} {'is' if len(alone) == 1 else 'are'}"
        faults.append(ReplyFault(UNRELATED, message, is_hard=False))
    return CheckedRelations(kept, tuple(faults), len(objects) - len(alone))


class _Checks:
    """The relations that were accepted so far.

    Args:
        objects: The objects by instance.
    """

    def __init__(self, objects: Mapping[str, LayoutObject]) -> None:
        self._objects = objects
        self.kept: list[Constraint] = []
        self._carriers: dict[str, str] = {}
        self._directions: set[frozenset[str]] = set()
        self._order: tuple[nx.DiGraph[str], nx.DiGraph[str]] = nx.DiGraph(), nx.DiGraph()  # along x, along y
        self._single: set[tuple[str, bool]] = set()
        self.on_table: set[str] = set()

    def add(self, relation: RelationText | Constraint) -> tuple[str, str] | None:
        """Accepts a relation, or returns the code and the reason why not."""
        c = relation if isinstance(relation, Constraint) else relation.constraint
        if c is None:
            return "relation_unknown", "there is no such relation, direction or part of the table"
        if c.kind in CARRYING and c.target == TABLE:
            if c.subject not in self._objects:
                return "object_unknown", f"{c.subject} is not one of the objects"
            self.on_table.add(c.subject)
            return None  # what nothing else carries is on the table
        for name in c.members:
            if name not in self._objects:
                return "object_unknown", f"{name} is not one of the objects"
        if c in self.kept:
            return None
        if c.kind not in UNARY and c.subject == c.target:
            return "relation_circle", "an object has no relation to itself"
        reason = self._reason(c)
        if reason is None:
            self.kept.append(c)
        return reason

    def _reason(self, c: Constraint) -> tuple[str, str] | None:
        if c.kind in CARRYING:
            return self._carry(c)
        if c.kind in DIRECTIONS:
            return self._direct(c)
        if c.kind in _SINGLE or c.kind is PlacementRelation.IS_AT:
            key = c.subject, c.kind in _SINGLE
            if key in self._single:
                return "relation_conflict", f"it {'faces' if key[1] else 'is'} elsewhere already"
            self._single.add(key)
        return None

    def _carry(self, c: Constraint) -> tuple[str, str] | None:
        if c.subject in self._carriers:
            return "relation_conflict", f"it is on or in {self._carriers[c.subject]} already"
        if c.subject in self._above(c.target) or c.subject == c.target:
            return "relation_circle", f"{c.target} is on or in {c.subject} itself"
        if frozenset((c.subject, c.target)) in self._directions:
            return "relation_conflict", "one is beside the other already"
        content, container = (sorted(self._objects[name].size_cm[:2]) for name in (c.subject, c.target))
        if c.kind is PlacementRelation.IN and any(a > _SLACK * b for a, b in zip(content, container, strict=True)):
            return "does_not_fit", f"{c.subject} is larger than {c.target}"
        self._carriers[c.subject] = c.target
        return None

    def _above(self, name: str) -> list[str]:
        """What carries an object, directly or through others."""
        found = []
        while name in self._carriers:
            name = self._carriers[name]
            found.append(name)
        return found

    def _direct(self, c: Constraint) -> tuple[str, str] | None:
        pair = frozenset((c.subject, c.target))
        if pair in self._directions:
            return "relation_conflict", "another direction between the two is stated already"
        if c.subject in self._above(c.target) or c.target in self._above(c.subject):
            return "relation_conflict", "one of the two carries the other"
        axis, sign = DIRECTIONS[c.kind]
        low, high = (c.subject, c.target) if sign < 0 else (c.target, c.subject)
        order = self._order[axis]
        if low in order and high in order and nx.has_path(order, high, low):
            return "relation_circle", "other relations together say the opposite"
        order.add_edge(low, high)
        self._directions.add(pair)
        return None
