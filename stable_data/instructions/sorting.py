"""Kinds of task about several objects together: rows, order by size, spacing, groups."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from stable_data.condition import BY_HEIGHT, BY_SIZE, NAME_SEPARATOR
from stable_data.instructions.ends import End
from stable_data.instructions.kind import Roles, TaskKind
from stable_data.instructions.situation import SIDES, TaskContext
from stable_data.scene import FloatArray, RelationKind

_CLEARLY = 1.2  # least ratio of two sizes that are put in order
_SCATTERED = 0.25  # objects of a kind are scattered if two of them are at least this far apart, metres
_UNEVEN = 0.25  # a row is uneven if a step differs from the mean by this share of it
_MAX_ROW = 8  # largest number of objects in a row or a group

LEFT, RIGHT = RelationKind.LEFT_OF, RelationKind.RIGHT_OF


def _places(s: TaskContext, xs: Sequence[str]) -> FloatArray:
    return np.array([s.objects[n].position[:2] for n in xs])


def _is_row(s: TaskContext, xs: Sequence[str]) -> bool:
    """Whether objects are in one row already, parallel to an edge of the table."""
    spread = np.ptp(_places(s, xs), axis=0)
    return bool(spread.min() < 0.03)


def _goes_into_a_row(s: TaskContext, xs: Sequence[str]) -> bool:
    """Whether the table is wide enough for a row of the objects."""
    return sum(max(s.objects[n].size[:2]) + 0.04 for n in xs) < s.scene.table.size_xy[0]


def _threes(s: TaskContext) -> Iterator[tuple[str, ...]]:
    for _ in range(6):
        xs = tuple(s.shuffled(s.loose)[:3])
        if len(xs) == 3 and _goes_into_a_row(s, xs):
            yield xs


def _line_ups(s: TaskContext) -> Iterator[Roles]:
    return ({"xs": xs} for xs in _threes(s) if not _is_row(s, xs))


def _line_up_kinds(s: TaskContext) -> Iterator[Roles]:
    return ({"xs": xs} for xs in s.whole_kinds(3, _MAX_ROW) if not _is_row(s, xs) and _goes_into_a_row(s, xs))


def _by_size(s: TaskContext) -> Iterator[Roles]:
    for xs in _threes(s):
        volume = [float(np.prod(s.objects[n].size)) for n in xs]
        ordered = sorted(volume)
        # All three sides may grow by the factor, so volumes differ by its cube.
        clear = all(b > _CLEARLY**3 * a for a, b in itertools.pairwise(ordered))
        small = [n for _, n in sorted(zip(volume, xs, strict=True))]
        at_x = [s.objects[n].position[0] for n in small]
        if clear and not _is_row(s, xs) and at_x not in (sorted(at_x), sorted(at_x, reverse=True)):
            yield {"xs": xs, "order": NAME_SEPARATOR.join(small)}


def _by_height(s: TaskContext) -> Iterator[Roles]:
    for xs in _threes(s):
        ordered = sorted(xs, key=lambda n: s.objects[n].size[2])
        clear = all(s.objects[b].size[2] > _CLEARLY * s.objects[a].size[2] for a, b in itertools.pairwise(ordered))
        at_x = [s.objects[n].position[0] for n in ordered]
        if clear and at_x not in (sorted(at_x), sorted(at_x, reverse=True)):
            yield {"xs": xs, "order": NAME_SEPARATOR.join(ordered)}


def _crowded(s: TaskContext) -> Iterator[Roles]:
    """Three or four unevenly spaced objects; the outer two leave room for even steps."""
    for count in s.shuffled((3, 4)):
        for _ in range(4):
            xs = sorted(s.shuffled(s.loose)[:count], key=lambda n: s.objects[n].position[0])
            steps = np.diff(_places(s, xs)[:, 0]) if len(xs) == count else np.zeros(1)
            mean = float(steps.mean())
            widest = max((max(s.objects[n].size[:2]) for n in xs), default=0.0)
            if mean > widest + 0.03 and np.abs(steps - mean).max() > _UNEVEN * mean:
                yield {"xs": tuple(xs)}


def _scattered(s: TaskContext) -> Iterator[Roles]:
    for xs in s.whole_kinds(2, _MAX_ROW):
        if max(s.gap(a, b) for a, b in itertools.combinations(xs, 2)) > _SCATTERED:
            yield {"xs": xs}


def _two_kinds(s: TaskContext) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    yield from itertools.permutations(itertools.islice(s.whole_kinds(2, _MAX_ROW), 6), 2)


def _two_rows(s: TaskContext) -> Iterator[Roles]:
    for xs, zs in _two_kinds(s):
        if not (_is_row(s, xs) and _is_row(s, zs)) and _goes_into_a_row(s, xs) and _goes_into_a_row(s, zs):
            yield {"xs": xs, "zs": zs}


def _two_sides(s: TaskContext) -> Iterator[Roles]:
    """Two kinds of objects, some of them on the wrong half of the table."""
    half = s.scene.table.size_xy[0] / 2
    for xs, zs in _two_kinds(s):
        misplaced = [n for n in xs if s.objects[n].position[0] > half] + [n for n in zs if s.objects[n].position[0] < half]
        if misplaced and len(xs) + len(zs) <= _MAX_ROW:
            yield {"xs": xs, "zs": zs}


def _two_containers(s: TaskContext) -> Iterator[Roles]:
    for xs, zs in _two_kinds(s):
        for y, w in itertools.permutations(s.shuffled(s.containers)[:4], 2):
            if s.all_fit(xs, y) and s.all_fit(zs, w) and not {y, w} & {*xs, *zs}:
                yield {"xs": xs, "zs": zs, "y": y, "w": w}


def _pairs_to_side(s: TaskContext) -> Iterator[Roles]:
    """Two objects on one half of the table, both to the other side."""
    half = s.scene.table.size_xy[0] / 2
    for x, z in s.pairs(s.loose, s.loose):
        side = s.pick((LEFT, RIGHT))
        _, sign = SIDES[side]
        cells = [f"{row}_{side.split()[0]}" for row in ("front", "middle", "back")]
        wrong = all(sign * (s.objects[n].position[0] - half) < 0 for n in (x, z))
        if wrong and all(any(s.has_room_in(n, cell) for cell in cells) for n in (x, z)):
            yield {"xs": (x, z), "direction": side.split()[0]}


KINDS = (
    TaskKind(
        "line_up",
        _line_ups,
        (
            "line up {xs} from left to right",
            "[arrange] {xs} in one straight row",
            "make a row of {xs}",
            "{xs} should stand in one line. Arrange them.",
            "put {xs} side by side in a row along the front edge",
        ),
        ("{xs} stand in one row.",),
        ("Pick({xs}); PlaceAt(row)",),
        ends=(End("xs", "in a row"),),
    ),
    TaskKind(
        "line_up_kind",
        _line_up_kinds,
        (
            "line up {xs}",
            "[arrange] {xs} in a row",
            "form a straight line with {xs}",
            "I want {xs} to stand in a row.",
        ),
        ("{xs} stand in one row.",),
        ("Pick({xs}); PlaceAt(row)",),
        theme="tidy",
        ends=(End("xs", "in a row"),),
    ),
    TaskKind(
        "order_by_size",
        _by_size,
        (
            "sort {xs} by size, the smallest on the left",
            "[arrange] {xs} in a row from small to large",
            "line up {xs} with the largest on the right",
            "order {xs} by how big they are, from left to right",
        ),
        ("{xs} stand in one row, the smallest on the left.",),
        ("Pick({xs}); PlaceAt(row)",),
        ends=(
            End("xs", "in a row"),
            End("{order}", "ordered", BY_SIZE),
        ),
    ),
    TaskKind(
        "order_by_height",
        _by_height,
        (
            "sort {xs} by height, the tallest on the right",
            "[arrange] {xs} in a row from low to high",
            "line up {xs} so that they get taller from left to right",
        ),
        ("{xs} stand in one row, the tallest on the right.",),
        ("Pick({xs}); PlaceAt(row)",),
        ends=(
            End("xs", "in a row"),
            End("{order}", "ordered", BY_HEIGHT),
        ),
    ),
    TaskKind(
        "space_out",
        _crowded,
        (
            "space {xs:short} out evenly",
            "leave equal gaps between {xs}",
            "[arrange] {xs} so that they are equally far apart",
            "{xs} should be evenly spaced from left to right.",
        ),
        ("{xs} are equally spaced from left to right.",),
        ("Pick({xs}); PlaceAt(evenly spaced)",),
        theme="tidy",
        ends=(End("xs", "evenly spaced"),),
    ),
    TaskKind(
        "group",
        _scattered,
        (
            "put {xs} close together in one place",
            "bring {xs} together",
            "group {xs} in one spot",
            "{xs} are scattered over the table. Put them together.",
            "collect {xs} in one corner of the table",
        ),
        ("{xs} stand close together.",),
        ("Pick({xs}); PlaceAt(one place)",),
        theme="tidy",
        ends=(End("xs", "together"),),
    ),
    TaskKind(
        "sort_into_rows",
        _two_rows,
        (
            "sort {xs} and {zs} into two rows",
            "make one row of {xs} and another row of {zs}",
            "line up {xs} in front and {zs} behind them",
            "{xs} and {zs} should stand in two separate rows.",
        ),
        ("{xs} stand in one row.", "{zs} stand in another row."),
        ("Pick({xs}); PlaceAt(first row)", "Pick({zs}); PlaceAt(second row)"),
        theme="tidy",
        ends=(
            End("xs", "in a row"),
            End("zs", "in a row"),
        ),
    ),
    TaskKind(
        "sort_to_sides",
        _two_sides,
        (
            "move {xs} to the left and {zs} to the right",
            "separate {xs} from {zs}: the former go left, the latter right.",
            "sort the table: {xs} belong on the left half, {zs} on the right half.",
        ),
        ("{xs} are on the left half of the table.", "{zs} are on the right half of the table."),
        ("Pick({xs}); PlaceAt(left)", "Pick({zs}); PlaceAt(right)"),
        theme="tidy",
        ends=(
            End("xs", "at", "left_half"),
            End("zs", "at", "right_half"),
        ),
    ),
    TaskKind(
        "sort_into_containers",
        _two_containers,
        (
            "sort {xs} into {y} and {zs} into {w}",
            "put {xs} into {y} and {zs} into {w}",
            "{xs} go into {y}, {zs} go into {w}. Sort them.",
        ),
        ("{xs} are in {y}.", "{zs} are in {w}."),
        ("Pick({xs}); PlaceOn({y})", "Pick({zs}); PlaceOn({w})"),
        theme="tidy",
        ends=(
            End("xs", "in", "y"),
            End("zs", "in", "w"),
        ),
    ),
    TaskKind(
        "both_to_side",
        _pairs_to_side,
        (
            "move {xs} to the {direction} side of the table",
            "[take|bring|carry] {xs} over to the {direction} side",
            "{xs} should both be at the {direction} side of the table.",
        ),
        ("{xs} are at the {direction} side of the table.",),
        ("Pick({xs}); PlaceAt({direction} side)",),
        ends=(End("xs", "at", "{direction}"),),
    ),
)
