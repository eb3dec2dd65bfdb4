"""Objects that need places on a table, and the relations that shall hold between them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import TypeAlias

from stable_data.scene import TABLE, SceneObject, Tabletop


class PlacementRelation(StrEnum):
    """The relations that a search knows; directions are those of the viewer and compare centres, as in the scene graph."""

    ON = "on"
    IN = "in"
    LEFT_OF = "left of"
    RIGHT_OF = "right of"
    IN_FRONT_OF = "in front of"
    BEHIND = "behind"
    NEAR = "near"
    ALIGNED_WITH = "aligned with"
    FACING = "facing"
    FACE_TO = "face to"
    IS_AT = "is at"


CARRYING = frozenset({PlacementRelation.ON, PlacementRelation.IN})
"""Relations of an object to the one that carries it."""

DIRECTIONS: Mapping[PlacementRelation, tuple[int, int]] = {
    PlacementRelation.LEFT_OF: (0, -1),
    PlacementRelation.RIGHT_OF: (0, 1),
    PlacementRelation.IN_FRONT_OF: (1, -1),
    PlacementRelation.BEHIND: (1, 1),
}
"""Relation -> the axis along which the subject differs most from the target, and the sign of the difference."""

UNARY = frozenset({PlacementRelation.FACE_TO, PlacementRelation.IS_AT})
"""Relations whose target is a direction, or a cell of the table."""


@dataclass(frozen=True, slots=True)
class Constraint:
    """A relation that shall hold.

    Attributes:
        subject: Instance.
        kind: The relation.
        target: Instance; for ``face to`` a direction such as ``left``, for ``is at`` a cell such as ``back_left``.
    """

    subject: str
    kind: PlacementRelation
    target: str

    def __str__(self) -> str:
        """Returns ``subject kind target``."""
        return f"{self.subject} {self.kind} {self.target}"

    @property
    def members(self) -> tuple[str, ...]:
        """The instances that it is about."""
        return (self.subject,) if self.kind in UNARY else (self.subject, self.target)


@dataclass(frozen=True, eq=False)
class PlacementProblem:
    """Objects to be placed.

    Attributes:
        table: The table.
        objects: The objects; of each, ``size`` is its box at yaw 0, and ``position`` and ``yaw`` are not read.
        constraints: The relations; at most one of a subject is ``on`` or ``in``, these have no cycle, and all instances are of ``objects``.
        obstacles: Objects that stay where they are.
        seed: Seed of all random choices.
    """

    table: Tabletop
    objects: tuple[SceneObject, ...]
    constraints: tuple[Constraint, ...] = ()
    obstacles: tuple[SceneObject, ...] = ()
    seed: int = 0

    @cached_property
    def carriers(self) -> dict[str, Constraint]:
        """Instance -> the relation to what carries it, for objects that do not stand on the table."""
        return {c.subject: c for c in self.constraints if c.kind in CARRYING}

    def support_of(self, name: str) -> str:
        """What carries an object: an instance, or the table."""
        return self.carriers[name].target if name in self.carriers else TABLE

    def below(self, name: str) -> list[str]:
        """The instances that carry an object, directly or through others, nearest first."""
        found: list[str] = []
        while name in self.carriers:
            name = self.carriers[name].target
            found.append(name)
        return found

    def order(self) -> list[SceneObject]:
        """The objects in the order in which they are placed.

        An object comes after what carries it. Those on the table come first, each time the one with the most relations to those that are
        placed, of equal ones the largest.
        """
        level = {o.instance: len(self.below(o.instance)) for o in self.objects}
        ordered: list[SceneObject] = []
        placed: set[str] = set()
        waiting = list(self.objects)
        while waiting:
            lowest = min(level[o.instance] for o in waiting)
            best = max(
                (o for o in waiting if level[o.instance] == lowest),
                key=lambda o: (self._num_related(o.instance, placed), o.size[0] * o.size[1]),
            )
            waiting.remove(best)
            ordered.append(best)
            placed.add(best.instance)
        return ordered

    def _num_related(self, name: str, placed: set[str]) -> int:
        """How many relations link an object to those that are placed; one to a place of the table counts too."""
        return sum(
            c.kind is PlacementRelation.IS_AT or not placed.isdisjoint(set(c.members) - {name})
            for c in self.constraints
            if name in c.members
        )


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """The result of a search.

    Attributes:
        objects: The placed objects with position, yaw and support, in the order of the problem.
        dropped: Instance -> why it has no place.
        broken: Relations between placed objects that do not hold.
        num_tried: How often an object was tried.
    """

    objects: tuple[SceneObject, ...]
    dropped: Mapping[str, str]
    broken: tuple[Constraint, ...] = ()
    num_tried: int = 0


Search: TypeAlias = Callable[[PlacementProblem], Placement]
"""Finds places. Its effort is bounded by a number of tries and not by time, so that the same problem has the same result everywhere."""
