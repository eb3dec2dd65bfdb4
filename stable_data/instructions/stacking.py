"""Kinds of task about objects on objects: put on, stack, take off, restack, clear."""

import itertools
from collections.abc import Iterator

from stable_data.condition import HAND_OVER_REGION
from stable_data.instructions.ends import End
from stable_data.instructions.kind import MAX_LISTED, Roles, TaskKind
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.scene import RelationKind

ON = RelationKind.ON


def _put_ons(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x, "y": y} for y, x in s.pairs(s.standing, s.loose) if s.can_carry(x, y))


def _can_stack(s: TaskContext, x: str, y: str) -> bool:
    """Whether ``x`` and ``y`` are of one kind, and ``x`` can be stacked on ``y``."""
    a, b = s.objects[x], s.objects[y]
    common = classes_of(a.category) & classes_of(b.category)
    alike = a.category == b.category or common & {"plate", "bowl", "book"}
    fits = all(p <= 1.2 * q for p, q in zip(sorted(a.size[:2]), sorted(b.size[:2]), strict=True))
    return "stackable" in common and bool(alike) and fits and a.tilt_angle < 0.1 > b.tilt_angle


def _stacks(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x, "y": y} for x, y in s.pairs(s.loose, s.loose) if _can_stack(s, x, y))


def _piles(s: TaskContext) -> Iterator[Roles]:
    """Three or four objects of a kind, the largest first."""
    loose = s.of("stackable", s.loose)
    for seed in s.shuffled(loose):
        like = [n for n in loose if n == seed or _can_stack(s, n, seed) or _can_stack(s, seed, n)]
        like.sort(key=lambda n: (-s.objects[n].size[0] * s.objects[n].size[1], n))
        if 3 <= len(like) <= MAX_LISTED and all(_can_stack(s, b, a) for a, b in itertools.pairwise(like)):
            yield {"x": like[0], "xs": tuple(like[1:])}


def _take_offs(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x, "y": y} for x, y in s.linked(ON))


def _restacks(s: TaskContext) -> Iterator[Roles]:
    for (x, y), z in itertools.product(s.linked(ON), s.shuffled(s.standing)):
        if z != y and s.can_carry(x, z):
            yield {"x": x, "y": y, "z": z}


def _turned_over(s: TaskContext) -> Iterator[Roles]:
    """Two objects, one on the other, that can be stacked in the opposite order."""
    for x, y in s.linked(ON):
        base = s.objects[y]
        if y in s.standing and len(s.load[y]) == 1 and max(base.size[:2]) <= 0.4 and _can_stack(s, y, x):
            yield {"x": x, "y": y}


def _cleared(s: TaskContext) -> Iterator[Roles]:
    return ({"y": y, "xs": xs} for y, xs in s.filled(ON, 2) if len(xs) <= MAX_LISTED)


def _cleared_at_once(s: TaskContext) -> Iterator[Roles]:
    return ({"y": y, "xs": xs} for y, xs in s.filled(ON, 1) if not s.parts(y, RelationKind.IN))


def _replaced(s: TaskContext) -> Iterator[Roles]:
    for (x, y), z in itertools.product(s.linked(ON), s.shuffled(s.loose)):
        if s.load[y] == [x] and z != y and s.can_carry(z, y, besides=x):
            yield {"x": x, "y": y, "z": z}


def _lids(s: TaskContext) -> Iterator[Roles]:
    for x, y in s.pairs(s.of("lid", s.free), s.of("pot", s.standing)):
        lid, pot = s.objects[x], s.objects[y]
        if 0.8 * min(pot.size[:2]) <= max(lid.size[:2]) <= 1.4 * max(pot.size[:2]) and y not in s.load:
            yield {"x": x, "y": y}


def _freed(s: TaskContext) -> Iterator[Roles]:
    """An object that can be picked up after the only object on it is removed."""
    for x, y in s.linked(ON):
        size = s.objects[y].size
        if y in s.standing and s.load[y] == [x] and max(size[:2]) <= 0.4 and min(size) <= 0.15:
            yield {"x": x, "y": y}


KINDS = (
    TaskKind(
        "put_on",
        _put_ons,
        (
            "[put] {x} [onto] {y}",
            "set {x:short} down on {y}",
            "[pick up|take] {x} and [put|place|lay] {x:it} on {y}",
            "{x} should be on {y}. [Put] {x:it} there.",
            "use {y} as a base for {x}",
        ),
        ("{x} {x:is} on {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        ends=(End("x", "on", "y"),),
    ),
    TaskKind(
        "stack",
        _stacks,
        (
            "[stack] {x} on top of {y}",
            "make a stack of two, {y} below and {x} above",
            "[stack] {x} on {y} to save space",
            "[put] {x} on {y} so that they form a stack",
        ),
        ("{x} {x:is} on {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("x", "on", "y"),),
    ),
    TaskKind(
        "pile_up",
        _piles,
        (
            "build a stack: {x} at the bottom, then {xs}.",
            "stack {xs} on {x}",
            "pile {xs:short} up on top of {x}",
            "make one neat stack with {x} at the bottom and {xs} above",
        ),
        ("{xs} are stacked on {x}.",),
        ("Pick({xs}); PlaceOn({x})",),
        theme="tidy",
        ends=(End("xs", "on", "x", is_chain=True),),
    ),
    TaskKind(
        "take_off",
        _take_offs,
        (
            "[lift|take] {x} off {y} and [lay] {x:it} on the table",
            "[take|lift] {x} off {y}",
            "remove {x} from {y}",
            "{x} {x:is} on {y}. [Take|Move|Lift] {x:it} down to the table.",
            "{y} should not carry {x} any more. Take {x:it} off.",
        ),
        ("{x} {x:is} on the table.", "{x} {x:is} not on {y}."),
        ("Pick({x}); PlaceAt(Table)",),
        (("x", None, "y"),),
        ends=(
            End("x", "on", "table"),
            End("x", "on", "y", is_negated=True),
        ),
    ),
    TaskKind(
        "restack",
        _restacks,
        (
            "[take|lift] {x} off {y} and [put] {x:it} on {z}",
            "move {x} from {y} onto {z}",
            "{x} {x:is} on {y} but should be on {z}. Move {x:it} over.",
            "{x} {x:is} on {y}, though {z} would be a better base. Move {x:it} over.",
        ),
        ("{x} {x:is} on {z}.", "{x} {x:is} not on {y}."),
        ("Pick({x}); PlaceOn({z})",),
        (("x", None, "y"),),
        ends=(
            End("x", "on", "z"),
            End("x", "on", "y", is_negated=True),
        ),
    ),
    TaskKind(
        "reverse_stack",
        _turned_over,
        (
            "{x} {x:is} on {y}. Stack them the other way round.",
            "take {x} off {y:short} and put {y:short} on top of {x:it} instead",
            "reverse the stack: take {x:short} off {y:short}, then put {y:short} on {x:short}.",
        ),
        ("{y} {y:is} on {x}.",),
        ("Pick({x}); PlaceAt(Table); Pick({y}); PlaceOn({x})",),
        (("x", None, "y"),),
        ends=(End("y", "on", "x"),),
    ),
    TaskKind(
        "clear_off",
        _cleared,
        (
            "take {xs} off {y}",
            "clear {y} by lifting {xs} off it",
            "{xs} are on {y}. Put them on the table.",
            "remove {xs} from {y}",
        ),
        ("{xs} are on the table.", "Nothing is on {y}."),
        ("Pick({xs}); PlaceAt(Table)",),
        (("xs", None, "y"),),
        theme="tidy",
        ends=(
            End("xs", "on", "table"),
            End("y", "empty", "on"),
        ),
    ),
    TaskKind(
        "clear_off_all",
        _cleared_at_once,
        (
            "clear {y}{xs:=}",
            "take {xs:=everything} off {y}",
            "I need {y}. Take {xs:=what lies on top} off first.",
            "nothing should be on {y} any more. Put {xs:=what is there} on the table.",
        ),
        ("Nothing is on {y}.",),
        ("Pick({xs}); PlaceAt(Table)",),
        (("xs", None, "y"),),
        ends=(End("y", "empty", "on"),),
    ),
    TaskKind(
        "replace_on",
        _replaced,
        (
            "replace {x} on {y} with {z}",
            "take {x} off {y} and put {z} there instead",
            "first take {x} off {y}, then put {z} on {y:it}.",
            "{y} should carry {z} instead of {x}. Take {x} off first.",
        ),
        ("{x} {x:is} on the table.", "{z} {z:is} on {y}."),
        ("Pick({x}); PlaceAt(Table); Pick({z}); PlaceOn({y})",),
        (("x", None, "y"),),
        ends=(
            End("x", "on", "table"),
            End("z", "on", "y"),
        ),
    ),
    TaskKind(
        "cover",
        _lids,
        (
            "[put] {x} on {y}",
            "cover {y} with {x}",
            "close {y} with {x}",
            "{y} should be covered. [Put] {x} on {y:it}.",
        ),
        ("{x} {x:is} on {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="cook",
        ends=(End("x", "on", "y"),),
    ),
    TaskKind(
        "uncover_and_hand_over",
        _freed,
        (
            "I need {y}. Take {x:short} off and hand {y:it} to me.",
            "take {x} off {y:short}, then [hand] me {y:short}",
            "first lift {x} off {y:short}. After that, bring {y:short} to me.",
            "[hand] me {y:short} after taking {x} off {y:it}",
        ),
        ("{x} {x:is} on the table.", "The person in front of the table holds {y}."),
        ("Pick({x}); PlaceAt(Table); Pick({y}); PlaceAt(hand of the person)",),
        (("x", None, "y"),),
        ends=(End("x", "on", "table"), End("y", "held", HAND_OVER_REGION)),
    ),
)
