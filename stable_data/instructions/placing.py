"""Kinds of task about positions of objects relative to each other on the table."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np

from stable_data.instructions.ends import End
from stable_data.instructions.kind import Roles, TaskKind
from stable_data.instructions.naming import SIDE_WORDS, holds_relation
from stable_data.instructions.picking import DIRECTION
from stable_data.instructions.situation import OPPOSITE, SIDES, TaskContext
from stable_data.scene import RelationKind

_FAR = 0.12  # an object is put next to another only if it is farther away than this, metres
_CLOSE = 0.05  # an object is moved away from another only if it is closer than this, metres
_ROOM = 0.02  # distance between an object and its two neighbours, metres


def _sides(s: TaskContext) -> Iterator[Roles]:
    """An object to another side of a second object."""
    return _free_sides(s, lambda x, y, side: not s.is_beyond(x, y, side))


def _near_sides(s: TaskContext) -> Iterator[Roles]:
    """A distant object close to a second object, maybe on the same side as before."""
    return _free_sides(s, lambda x, y, _: s.gap(x, y) > _FAR)


def _free_sides(s: TaskContext, is_allowed: Callable[[str, str, RelationKind], bool]) -> Iterator[Roles]:
    for x, y in s.pairs(s.loose, s.standing):
        for side in s.shuffled(SIDES):
            if is_allowed(x, y, side) and s.has_room(x, y, side):
                yield {"x": x, "y": y, "side": SIDE_WORDS[side], "at": str(side)}


def _nexts(s: TaskContext) -> Iterator[Roles]:
    for x, y in s.pairs(s.loose, s.standing):
        if s.gap(x, y) > _FAR and any(s.has_room(x, y, side) for side in SIDES):
            yield {"x": x, "y": y}


def _betweens(s: TaskContext) -> Iterator[Roles]:
    standing = s.shuffled(s.standing)
    # The bound limits the time in a crowded scene, where the triples grow with the cube of the number of objects.
    for (y, z), x in itertools.islice(itertools.product(itertools.combinations(standing, 2), s.shuffled(s.loose)), 600):
        if x not in (y, z) and _has_gap_for(s, x, y, z):
            yield {"x": x, "y": y, "z": z}


def _has_gap_for(s: TaskContext, x: str, y: str, z: str) -> bool:
    """Whether ``x`` fits into the middle between ``y`` and ``z`` and is not there yet."""
    one, other = (np.array(s.objects[n].position[:2]) for n in (y, z))
    gap = s.gap(y, z)
    if not max(s.objects[x].size[:2]) + 2 * _ROOM <= gap <= 0.5:
        return False
    middle = (one + other) / 2
    if np.linalg.norm(np.array(s.objects[x].position[:2]) - middle) < gap / 2:
        return False
    return s.is_free(s.box(x, (float(middle[0]), float(middle[1]))), (x,), clearance=0.005)


def _swaps(s: TaskContext) -> Iterator[Roles]:
    for x, y in s.pairs(s.loose, s.loose):
        at_x, at_y = (s.objects[n].position[:2] for n in (x, y))
        if s.gap(x, y) > 0.02 and s.is_free(s.box(x, at_y), (x, y), 0.0) and s.is_free(s.box(y, at_x), (x, y), 0.0):
            yield {"x": x, "y": y}


def _too_close(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x, "y": y} for x, y in s.pairs(s.loose, s.standing) if s.gap(x, y) < _CLOSE)


def _in_the_way(s: TaskContext) -> Iterator[Roles]:
    """The only object close in front of another object, which covers a part of it as the person sees it."""
    for y in s.shuffled(s.standing):
        before = [n for n in s.standing if n != y and s.is_beside(n, y, RelationKind.IN_FRONT_OF, 0.2)]
        if len(before) == 1 and before[0] in s.loose and holds_relation(s.graph, before[0], RelationKind.IN_FRONT_OF, y):
            x = before[0]
            distances = {side: s.clearing_distance(x, y, side) for side in (RelationKind.LEFT_OF, RelationKind.RIGHT_OF)}
            if min(distances.values()) <= 0:
                continue  # it stands in front, but not in the way
            for side in s.shuffled(tuple(distances)):
                cm = int(np.ceil(100 * distances[side])) + 1
                if s.can_slide(x, side, cm / 100):
                    yield {"x": x, "y": y, "direction": DIRECTION[side], "cm": str(cm)}


def _crossings(s: TaskContext) -> Iterator[Roles]:
    """An object close to a side of another object, with room at the opposite side."""
    for x, y in s.pairs(s.loose, s.standing):
        for side in SIDES:
            is_there = s.is_beside(x, y, side) and holds_relation(s.graph, x, side, y)
            if is_there and s.has_room(x, y, OPPOSITE[side]):
                after = OPPOSITE[side]
                yield {"x": x, "y": y, "here": SIDE_WORDS[side], "link": str(side), "side": SIDE_WORDS[after], "at": str(after)}


KINDS = (
    TaskKind(
        "side_of",
        _sides,
        (
            "[put] {x} {side} {y}",
            "[move] {x} so that {x:they} stand{x:s} {side} {y}",
            "[pick up|take] {x} and put {x:it} down {side} {y}",
            "I would like {x} to be {side} {y}.",
            "{side} {y} is where {x} belong{x:s}. [Put] {x:it} there.",
            "arrange things so that {x} {x:is} {side} {y}",
        ),
        ("{x} {x:is} {side} {y}.",),
        ("Pick({x}); PlaceAt({at} {y})",),
        ends=(End("x", "{at}", "y"),),
    ),
    TaskKind(
        "close_to_side",
        _near_sides,
        (
            "[put] {x} directly {side} {y}",
            "[bring|move] {x} close to {y}, {side} {y:it}",
            "find a place for {x} close to {y}, {side} {y:it}, and [put] {x:it} there",
        ),
        ("{x} {x:is} {side} {y}, close to {y:it}.",),
        ("Pick({x}); PlaceAt({at} {y})",),
        ends=(
            End("x", "{at}", "y"),
            End("x", "beside", "y"),
        ),
    ),
    TaskKind(
        "next_to",
        _nexts,
        (
            "[put] {x} [next to] {y}",
            "[move] {x:short} over to {y}, so that the two stand side by side",
            "leave {y:short} where {y:they} {y:is} and [put] {x} [next to] {y:it}",
            "{x} belong{x:s} [next to] {y}. [Put] {x:it} there.",
            "bring {x} close to {y}",
        ),
        ("{x} {x:is} next to {y}.",),
        ("Pick({x}); PlaceAt(next to {y})",),
        ends=(End("x", "beside", "y"),),
    ),
    TaskKind(
        "between",
        _betweens,
        (
            "[put] {x} between {y} and {z}",
            "fill the gap between {y} and {z} with {x}",
            "[move] {x} into the space between {y} and {z}",
            "I want {x} to stand between {y} and {z}.",
            "there is room between {y} and {z}. [Put] {x} there.",
        ),
        ("{x} {x:is} between {y} and {z}.",),
        ("Pick({x}); PlaceAt(between {y} and {z})",),
        ends=(End("x", "between", "y, z"),),
    ),
    TaskKind(
        "swap",
        _swaps,
        (
            "swap {x} and {y}",
            "let {x} and {y} change places",
            "exchange the positions of {x} and {y}",
            "put {x:short} where {y:short} {y:is} now, and {y:short} where {x:short} {x:is}",
            "{x} and {y} should trade places.",
        ),
        ("{x} {x:is} where {y} {y:was}.", "{y} {y:is} where {x} {x:was}."),
        ("Pick({x}); PlaceAt(free spot); Pick({y}); PlaceAt(former {x}); Pick({x}); PlaceAt(former {y})",),
        ends=(
            End("x", "at", "y"),
            End("y", "at", "x"),
        ),
    ),
    TaskKind(
        "away_from",
        _too_close,
        (
            "[move] {x} away from {y}",
            "{x} {x:is} too close to {y}. [Move|Take] {x:it} farther away.",
            "move {x} a little so that there is more space between {x:it} and {y}",
            "[move|shift] {x} until there is a clear gap between {x:it} and {y}",
        ),
        ("There is a clear gap between {x} and {y}.",),
        ("Pick({x}); PlaceAt(away from {y})",),
        theme="room",
        ends=(End("x", "apart", "y"),),
    ),
    TaskKind(
        "make_room",
        _in_the_way,
        (
            "{x} {x:is} in front of {y}. [Push|Slide|Move] {x:it} aside, to the {direction}.",
            "make room in front of {y} by pushing {x} to the {direction}",
            "clear the space in front of {y} by moving {x} to the {direction}",
            "{x} {x:is} in the way in front of {y}. Push {x:it} to the {direction}.",
        ),
        ("Nothing stands in front of {y}.",),
        ("Push({x}, {direction}, {cm})",),
        (("x", RelationKind.IN_FRONT_OF, "y"),),
        theme="room",
        ends=(End("x", "moved", "{direction}", "{cm}"),),
    ),
    TaskKind(
        "cross_over",
        _crossings,
        (
            "{x} {x:is} {here} {y}. [Move|Take] {x:it} to the other side.",
            "{x} {x:is} {here} {y} but should be {side} {y:it}. Move {x:it}.",
        ),
        ("{x} {x:is} {side} {y}.",),
        ("Pick({x}); PlaceAt({at} {y})",),
        (("x", "link", "y"),),
        ends=(End("x", "{at}", "y"),),
    ),
)
