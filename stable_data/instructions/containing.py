"""Kinds of task about objects in containers: put in, take out, move to another container, fill, empty."""

import itertools
from collections.abc import Iterator

from stable_data.condition import HAND_OVER_REGION
from stable_data.instructions.ends import End
from stable_data.instructions.kind import MAX_LISTED, Finder, Roles, TaskKind
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.scene import RelationKind

IN = RelationKind.IN


def _put_ins(s: TaskContext) -> Iterator[Roles]:
    for y, x in s.pairs(s.containers, s.loose):
        if s.fits(x, y):
            yield {"x": x, "y": y}


def _put_aways(s: TaskContext) -> Iterator[Roles]:
    for y, x in s.pairs(s.of("tidy_place", s.containers), s.loose):
        if s.fits(x, y) and not classes_of(s.objects[x].category) & {"tidy_place", "pot"}:
            yield {"x": x, "y": y}


def _take_outs(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x, "y": y} for x, y in s.linked(IN))


def _transfers(s: TaskContext) -> Iterator[Roles]:
    for (x, y), z in itertools.product(s.linked(IN), s.shuffled(s.containers)):
        if z != y and s.fits(x, z):
            yield {"x": x, "y": y, "z": z}


def some_into(item_class: str, place_class: str, counts: tuple[int, ...]) -> Finder:
    """Returns a finder of some loose objects of a class, named one by one, and a container of another class for them."""

    def find(s: TaskContext) -> Iterator[Roles]:
        for y, count in itertools.product(s.shuffled(s.of(place_class, s.containers)), counts):
            xs = tuple(s.shuffled(n for n in s.of(item_class, s.loose) if s.fits(n, y))[:count])
            if len(xs) == count and s.all_fit(xs, y):
                yield {"xs": xs, "y": y}

    return find


def _gathers(s: TaskContext) -> Iterator[Roles]:
    """Two or three objects that fit into one container together."""
    for y in s.shuffled(s.containers):
        fitting = s.shuffled(x for x in s.loose if s.fits(x, y))
        for count in s.shuffled((2, 3)):
            xs = tuple(fitting[:count])
            if len(xs) == count and s.all_fit(xs, y):
                yield {"xs": xs, "y": y}


def _all_of_a_kind(s: TaskContext) -> Iterator[Roles]:
    for y, xs in itertools.product(s.shuffled(s.containers), s.whole_kinds(2)):
        if s.all_fit(xs, y):
            yield {"xs": xs, "y": y}


def _shares(s: TaskContext) -> Iterator[Roles]:
    """Two objects, each into another container."""
    for x, z in s.pairs(s.loose, s.loose):
        places = ((y, w) for y, w in itertools.permutations(s.shuffled(s.containers)[:4], 2) if s.fits(x, y) and s.fits(z, w))
        yield from ({"x": x, "y": y, "z": z, "w": w} for y, w in places)


def _emptied(s: TaskContext) -> Iterator[Roles]:
    return ({"y": y, "xs": xs} for y, xs in s.filled(IN, 2) if len(xs) <= MAX_LISTED)


def _emptied_at_once(s: TaskContext) -> Iterator[Roles]:
    return ({"y": y, "xs": xs} for y, xs in s.filled(IN, 1))


def _poured_over(s: TaskContext) -> Iterator[Roles]:
    """All contents of one container into another."""
    for (y, xs), z in itertools.product(s.filled(IN, 2), s.shuffled(s.containers)):
        if z != y and s.all_fit(xs, z):
            yield {"y": y, "xs": xs, "z": z}


def _replaced(s: TaskContext) -> Iterator[Roles]:
    for (x, y), z in itertools.product(s.linked(IN), s.shuffled(s.loose)):
        if s.graph.nodes[y]["container"] and s.fits(z, y):
            yield {"x": x, "y": y, "z": z}


def _loaded(s: TaskContext) -> Iterator[Roles]:
    """A container that can be carried with its new contents."""
    return (roles for roles in _put_ins(s) if roles["y"] in s.loose)


def _loaded_off_centre(s: TaskContext) -> Iterator[Roles]:
    return (roles for roles in _loaded(s) if s.graph.nodes[str(roles["y"])]["cell"] != "middle_middle")


KINDS = (
    TaskKind(
        "put_in",
        _put_ins,
        (
            "[put] {x} [into] {y}",
            "pick up {x} and drop {x:it} [into] {y}",
            "{y} should hold {x}. [Put] {x:it} in there.",
            "put {x:short} away in {y}",
            "use {y} to hold {x}",
            "I want to find {x} in {y} later. [Put] {x:it} there.",
        ),
        ("{x} {x:is} in {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        ends=(End("x", "in", "y"),),
    ),
    TaskKind(
        "put_away",
        _put_aways,
        (
            "clear {x:short} away into {y}",
            "I do not need {x} any more. [Put] {x:it} [into] {y}.",
            "tidy {x:short} away by putting {x:it} into {y}",
            "[put] {x} [into] {y} to get {x:it} off the table",
            "store {x} in {y}",
        ),
        ("{x} {x:is} in {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("x", "in", "y"),),
    ),
    TaskKind(
        "take_out",
        _take_outs,
        (
            "[take] {x} out of {y} and [put] {x:it} on the table",
            "[take] {x} out of {y}",
            "remove {x} from {y}",
            "{x} {x:is} in {y}. [Lift|Take] {x:it} out and [lay] {x:it} on the table.",
            "reach into {y} and take out {x}",
            "{x} do{x:es} not belong in {y}. Take {x:it} out.",
        ),
        ("{x} {x:is} on the table.", "{x} {x:is} not in {y}."),
        ("Pick({x}); PlaceAt(Table)",),
        (("x", None, "y"),),
        ends=(
            End("x", "on", "table"),
            End("x", "in", "y", is_negated=True),
        ),
    ),
    TaskKind(
        "transfer",
        _transfers,
        (
            "[take] {x} out of {y} and [put] {x:it} [into] {z}",
            "move {x} from {y} to {z}",
            "transfer {x} from {y} into {z}",
            "{x} {x:is} in {y} but belong{x:s} in {z}. Move {x:it} over.",
            "[take] {x} out of {y} and drop {x:it} into {z}",
        ),
        ("{x} {x:is} in {z}.", "{x} {x:is} not in {y}."),
        ("Pick({x}); PlaceOn({z})",),
        (("x", None, "y"),),
        ends=(
            End("x", "in", "z"),
            End("x", "in", "y", is_negated=True),
        ),
    ),
    TaskKind(
        "gather",
        _gathers,
        (
            "[collect] {xs} in {y}",
            "[put] {xs} [into] {y}",
            "{xs} belong in {y}. [Put] them there.",
            "[put] {xs} [into] {y}, one after the other",
        ),
        ("{xs} are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "gather_kind",
        _all_of_a_kind,
        (
            "[collect] {xs} in {y}",
            "[put] {xs} [into] {y}",
            "pick up {xs} one by one and drop them into {y}",
            "I want to see {xs} in {y}.",
            "use {y} to collect {xs}",
        ),
        ("{xs} are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "share_out",
        _shares,
        (
            "[put] {x} [into] {y} and {z} [into] {w}",
            "sort these: {x} goes into {y}, {z} into {w}.",
            "{x} belong{x:s} in {y} and {z} in {w}. Sort them.",
        ),
        ("{x} {x:is} in {y}.", "{z} {z:is} in {w}."),
        ("Pick({x}); PlaceOn({y}); Pick({z}); PlaceOn({w})",),
        theme="tidy",
        ends=(
            End("x", "in", "y"),
            End("z", "in", "w"),
        ),
    ),
    TaskKind(
        "empty",
        _emptied,
        (
            "empty {y} by taking out {xs}",
            "[take] {xs} out of {y}",
            "{xs} are in {y}. Take them out one by one.",
            "remove {xs} from {y} and [put] them on the table",
        ),
        ("{xs} are on the table.", "Nothing is in {y}."),
        ("Pick({xs}); PlaceAt(Table)",),
        (("xs", None, "y"),),
        ends=(
            End("xs", "on", "table"),
            End("y", "empty", "in"),
        ),
    ),
    TaskKind(
        "empty_all",
        _emptied_at_once,
        (
            "empty {y}{xs:=}",
            "take {xs:=everything} out of {y}",
            "clear out {y}: {xs:=whatever is in there} goes onto the table.",
            "I need {y} empty. Put {xs:=what is in there} on the table.",
        ),
        ("Nothing is in {y}.",),
        ("Pick({xs}); PlaceAt(Table)",),
        (("xs", None, "y"),),
        ends=(End("y", "empty", "in"),),
    ),
    TaskKind(
        "move_contents",
        _poured_over,
        (
            "move {xs:=everything} that is in {y} over to {z}",
            "empty {y} into {z}, {xs:=piece by piece}",
            "take {xs:=everything} out of {y} and put it all into {z}",
        ),
        ("Nothing is in {y}.", "What was in {y} is now in {z}."),
        ("Pick({xs}); PlaceOn({z})",),
        (("xs", None, "y"),),
        ends=(
            End("xs", "in", "z"),
            End("y", "empty", "in"),
        ),
    ),
    TaskKind(
        "replace_in",
        _replaced,
        (
            "[take] {x} out of {y} and put {z} in instead",
            "replace {x} in {y} with {z}",
            "{y} should hold {z} instead of {x}. Take {x} out first.",
            "first take {x} out of {y}, then put {z} in.",
        ),
        ("{x} {x:is} on the table.", "{z} {z:is} in {y}."),
        ("Pick({x}); PlaceAt(Table); Pick({z}); PlaceOn({y})",),
        (("x", None, "y"),),
        ends=(
            End("x", "on", "table"),
            End("z", "in", "y"),
        ),
    ),
    TaskKind(
        "load_and_bring",
        _loaded,
        (
            "[put] {x} [into] {y:short} and [then|after that] bring {y:short} to me",
            "[put] {x} [into] {y}, then hand me both together",
            "first [put] {x} [into] {y:short}. After that, bring {y:short} to the front edge.",
        ),
        ("{x} {x:is} in {y}.", "{y} {y:is} at the front edge."),
        ("Pick({x}); PlaceOn({y}); Pick({y}); PlaceAt(front edge)",),
        ends=(
            End("x", "in", "y"),
            End("y", "at", "front_edge"),
        ),
    ),
    TaskKind(
        "load_and_centre",
        _loaded_off_centre,
        (
            "[put] {x} [into] {y:short} and move {y:short} to the [middle] of the table",
            "first [put] {x} [into] {y:short}. Then move {y:short} to the middle of the table.",
            "[put] {x} [into] {y}, which shall then stand in the middle of the table",
        ),
        ("{x} {x:is} in {y}.", "{y} {y:is} in the middle of the table."),
        ("Pick({x}); PlaceOn({y}); Pick({y}); PlaceAt(middle)",),
        ends=(
            End("x", "in", "y"),
            End("y", "at", "middle_middle"),
        ),
    ),
    TaskKind(
        "unload_and_hand_over",
        _take_outs,
        (
            "[take] {x} out of {y} and [hand] {x:it} to me",
            "I need {x}. [Get|Take] {x:it} out of {y} and hand {x:it} over.",
            "[hand] me {x} from {y}",
            "first take {x} out of {y}, then give {x:it} to me.",
        ),
        ("The person in front of the table holds {x}.", "{x} {x:is} not in {y}."),
        ("Pick({x}); PlaceAt(hand of the person)",),
        (("x", None, "y"),),
        ends=(End("x", "held", HAND_OVER_REGION), End("x", "in", "y", is_negated=True)),
    ),
)
