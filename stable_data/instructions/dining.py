"""Kinds of task about meals: set and clear the table, pour drinks, serve food, prepare food for cutting."""

import itertools
from collections.abc import Iterator

from stable_data.instructions.containing import some_into
from stable_data.instructions.ends import End
from stable_data.instructions.kind import MAX_LISTED, Finder, Roles, TaskKind
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.instructions.wording.words import type_words
from stable_data.scene import RelationKind

LEFT, RIGHT, BEHIND = RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.BEHIND


_NEAR = 0.06  # largest distance of cutlery or a drink from its plate, metres


def _plate_fork_knife(s: TaskContext) -> Iterator[Roles]:
    for x in s.shuffled(s.of("plate", s.loose)):
        for y, z in s.pairs(s.of("fork", s.loose), s.of("knife", s.loose)):
            done = s.is_beside(y, x, LEFT, _NEAR) and s.is_beside(z, x, RIGHT, _NEAR)
            if not done and s.has_room(y, x, LEFT, (z,)) and s.has_room(z, x, RIGHT, (y,)):
                yield {"x": x, "y": y, "z": z}


def _with_drink(s: TaskContext) -> Iterator[Roles]:
    for roles, w in itertools.product(_plate_fork_knife(s), s.shuffled(s.of("drinkware", s.loose))):
        x, y, z = str(roles["x"]), str(roles["y"]), str(roles["z"])
        if s.has_room(w, x, BEHIND, (y, z)):
            yield {**roles, "w": w}


def _plate_cutlery(s: TaskContext) -> Iterator[Roles]:
    for x, y in s.pairs(s.of("plate", s.loose), s.of("cutlery", s.loose)):
        side = LEFT if "fork" in classes_of(s.objects[y].category) else RIGHT
        if not s.is_beside(y, x, side, _NEAR) and s.has_room(y, x, side):
            yield {"x": x, "y": y, "side": str(side)}


def _beside(base: str, item: str, side: RelationKind) -> Finder:
    """Returns a finder of a standing object of one class and a loose object of another class to put at its side."""

    def find(s: TaskContext) -> Iterator[Roles]:
        for x, y in s.pairs(s.of(base, s.standing), s.of(item, s.loose)):
            if not s.is_beside(y, x, side, _NEAR) and s.has_room(y, x, side):
                yield {"x": x, "y": y}

    return find


def _for_several(s: TaskContext) -> Iterator[Roles]:
    """Two to four plates, and as many objects of one category of cutlery or drinkware."""
    plates = s.of("plate", s.every_loose)
    kinds = s.kinds(s.of("cutlery", s.every_loose)) + s.kinds(s.of("drinkware", s.every_loose))
    for zs in s.shuffled(kinds):
        is_set = all(any(s.gap(z, x) < _NEAR for x in plates) for z in zs)
        if 2 <= len(plates) == len(zs) <= MAX_LISTED and s.is_every(zs) and s.is_every(plates) and not is_set:
            yield {"xs": tuple(plates), "zs": tuple(zs), "thing": " ".join(type_words(s.objects[zs[0]].category))}


def _servings(s: TaskContext) -> Iterator[Roles]:
    for y, x in s.pairs(s.of("serving", s.standing), s.of("food", s.loose)):
        if s.can_carry(x, y) or (y in s.containers and s.fits(x, y)):
            yield {"x": x, "y": y}


def _to_one_side(s: TaskContext) -> Iterator[Roles]:
    for count in (4, 3, 2):
        xs = tuple(s.shuffled(s.of("tableware", s.loose))[:count])
        if len(xs) == count and all("back" not in s.graph.nodes[n]["cell"] for n in xs):
            yield {"xs": xs}


def _all_of_a_kind(s: TaskContext) -> Iterator[Roles]:
    """All objects of a category, none of them at the back."""
    for xs in s.whole_kinds(2, 6, "tableware"):
        if not any("back" in s.graph.nodes[n]["cell"] for n in xs):
            yield {"xs": xs}


def _all_cutlery(s: TaskContext) -> Iterator[Roles]:
    every = s.all_of("cutlery")
    for y in s.shuffled(s.containers):
        if len(every) > 1 and set(every) <= set(s.every_loose) and s.all_fit(every, y):
            yield {"xs": tuple(every), "y": y}


def _pourings(s: TaskContext) -> Iterator[Roles]:
    vessels = [n for n in s.loose if s.objects[n].tilt_angle < 0.5 or s.graph.nodes[n]["container"]]
    for y, x in s.pairs(s.of("drinkware", s.standing), s.of("pourer", vessels)):
        if s.objects[x].size[2] > 0.06 and y not in s.load:
            yield {"x": x, "y": y}


def _waterings(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x, "y": y} for x, y in s.pairs(s.of("waterer", s.loose), s.of("plant", s.standing)))


def _cuttings(s: TaskContext) -> Iterator[Roles]:
    for x, y in s.pairs(s.of("choppable", s.loose), s.of("board", s.standing)):
        item, board = s.objects[x].size, s.objects[y].size
        if y not in s.load and max(item[:2]) <= max(board[:2]) and min(item[:2]) <= min(board[:2]):
            yield {"x": x, "y": y}


def _cuttings_with_knife(s: TaskContext) -> Iterator[Roles]:
    for roles, z in itertools.product(_cuttings(s), s.shuffled(s.of("blade", s.loose))):
        if s.has_room(z, str(roles["y"]), RIGHT):
            yield {**roles, "z": z}


KINDS = (
    TaskKind(
        "set_place",
        _plate_fork_knife,
        (
            "set the table for one: {y:short} to the left of {x}, {z} to its right.",
            "lay {y:short} to the left of {x} and {z:short} to the right of {x:it}",
            "prepare a place setting with {x}, {y} on its left and {z} on its right",
            "one guest is coming. Lay {y} and {z} to the left and right of {x}.",
        ),
        ("{y} {y:is} left of {x}.", "{z} {z:is} right of {x}."),
        ("Pick({y}); PlaceAt(left of {x}); Pick({z}); PlaceAt(right of {x})",),
        theme="meal",
        ends=(
            End("y", "left of", "x"),
            End("y", "beside", "x"),
            End("z", "right of", "x"),
            End("z", "beside", "x"),
        ),
    ),
    TaskKind(
        "set_place_with_drink",
        _with_drink,
        (
            "set the table for one with {x}, {y}, {z} and {w}",
            "lay a full place setting: {y:short} to the left of {x}, {z:short} to the right and {w} behind {x:it}.",
            "lay {y:short} to the left of {x}, {z:short} to the right of {x:it} and put {w} behind",
        ),
        ("{y} {y:is} left of {x}.", "{z} {z:is} right of {x}.", "{w} {w:is} behind {x}."),
        ("Pick({y}); PlaceAt(left of {x}); Pick({z}); PlaceAt(right of {x}); Pick({w}); PlaceAt(behind {x})",),
        theme="meal",
        ends=(
            End("y", "left of", "x"),
            End("y", "beside", "x"),
            End("z", "right of", "x"),
            End("z", "beside", "x"),
            End("w", "behind", "x"),
            End("w", "beside", "x"),
        ),
    ),
    TaskKind(
        "lay_cutlery",
        _plate_cutlery,
        (
            "lay {y:short} to the {side} {x}",
            "{y} {y:is} missing at its place to the {side} {x}. Lay {y:it} there.",
            "set the table: {y:short} go{y:es} to the {side} {x}.",
        ),
        ("{y} {y:is} {side} {x}.",),
        ("Pick({y}); PlaceAt({side} {x})",),
        theme="meal",
        ends=(
            End("y", "{side}", "x"),
            End("y", "beside", "x"),
        ),
    ),
    TaskKind(
        "set_soup",
        _beside("bowl", "spoon", RIGHT),
        (
            "lay {y:short} to the right of {x}",
            "there is soup today. Lay {y:short} to the right of {x}.",
            "set the table for soup with {y} beside {x}, on the right",
        ),
        ("{y} {y:is} right of {x}.",),
        ("Pick({y}); PlaceAt(right of {x})",),
        theme="meal",
        ends=(
            End("y", "right of", "x"),
            End("y", "beside", "x"),
        ),
    ),
    TaskKind(
        "set_drink",
        _beside("plate", "drinkware", BEHIND),
        (
            "set {y} behind {x} for the drinks",
            "[put] {y} behind {x}, where a drink belongs",
            "complete the place at {x}: {y} go{y:es} behind {x:it}.",
        ),
        ("{y} {y:is} behind {x}.",),
        ("Pick({y}); PlaceAt(behind {x})",),
        theme="meal",
        ends=(
            End("y", "behind", "x"),
            End("y", "beside", "x"),
        ),
    ),
    TaskKind(
        "set_for_several",
        _for_several,
        (
            "set the table with {xs} and {zs}, one of each for every guest",
            "lay one {thing} beside each plate{xs:=}{zs:=}",
            "every guest gets a place: arrange {xs} and {zs} in pairs.",
        ),
        ("Beside each plate there is one {thing}.",),
        ("Pick({zs}); PlaceAt(beside a plate)",),
        theme="meal",
    ),
    TaskKind(
        "serve",
        _servings,
        (
            "serve {x} on {y}",
            "[put] {x} on {y} to be eaten",
            "arrange {x} on {y} for the guests",
            "I would like to eat {x}. Serve {x:it} on {y}.",
        ),
        ("{x} {x:is} on {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="meal",
        ends=(End("x", "on", "y"),),
    ),
    TaskKind(
        "clear_table",
        some_into("tableware", "tidy_place", counts=(4, 3, 2)),
        (
            "clear the table: put {xs} into {y}.",
            "collect {xs} in {y} to clear the table",
            "put {xs} into {y} so that they can be carried to the kitchen",
            "use {y} to clear away {xs}",
        ),
        ("{xs} are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="after_meal",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "clear_to_back",
        _to_one_side,
        (
            "clear the front of the table: move {xs} to the back.",
            "move {xs} to the back of the table after the meal",
            "make room at the front: {xs} go to the back of the table.",
        ),
        ("{xs} are at the back of the table.",),
        ("Pick({xs}); PlaceAt(back)",),
        theme="after_meal",
        ends=(End("xs", "at", "back"),),
    ),
    TaskKind(
        "clear_kind",
        _all_of_a_kind,
        (
            "clear away {xs}: move them to the back of the table.",
            "move {xs} out of the way, to the back of the table",
            "nobody needs {xs} any more. Put them at the back of the table.",
        ),
        ("{xs} are at the back of the table.",),
        ("Pick({xs}); PlaceAt(back)",),
        theme="after_meal",
        ends=(End("xs", "at", "back"),),
    ),
    TaskKind(
        "collect_cutlery",
        _all_cutlery,
        (
            "put {xs:=all the cutlery} into {y}",
            "collect {xs:=every piece of cutlery} in {y}",
            "{xs:=the cutlery} belongs in {y}. Put all of it there.",
        ),
        ("All the cutlery is in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="after_meal",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "pour",
        _pourings,
        (
            "pour something from {x} into {y}",
            "fill {y} from {x}",
            "use {x} to fill {y}",
            "take {x} and pour a drink into {y}",
            "{y} {y:is} empty. Pour something in from {x}.",
        ),
        ("{y} {y:is} filled from {x}.", "{x} {x:is} back on the table."),
        ("Pick({x}); PlaceAt(above {y}); PlaceAt(Table)",),
        theme="drink",
    ),
    TaskKind(
        "water",
        _waterings,
        (
            "water {y} with {x}",
            "{y} need{y:s} water. Take {x} and give {y:it} some.",
            "pour a little water from {x} over {y}",
        ),
        ("{y} {y:is} watered from {x}.", "{x} {x:is} back on the table."),
        ("Pick({x}); PlaceAt(above {y}); PlaceAt(Table)",),
    ),
    TaskKind(
        "prepare_to_cut",
        _cuttings,
        (
            "[put] {x} on {y} so that {x:they} can be cut",
            "get {x} ready for cutting on {y}",
            "I am going to slice {x}. [Put] {x:it} on {y}.",
        ),
        ("{x} {x:is} on {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="cook",
        ends=(End("x", "on", "y"),),
    ),
    TaskKind(
        "prepare_to_cut_with_knife",
        _cuttings_with_knife,
        (
            "[put] {x} on {y:short} and lay {z} to the right of {y:short}",
            "prepare the cutting of {x}: {x:it} on {y}, {z} to the right of {y:it}.",
            "first put {x} on {y}, then lay {z} down to the right of {y:it}.",
        ),
        ("{x} {x:is} on {y}.", "{z} {z:is} right of {y}."),
        ("Pick({x}); PlaceOn({y}); Pick({z}); PlaceAt(right of {y})",),
        theme="cook",
        ends=(
            End("x", "on", "y"),
            End("z", "right of", "y"),
            End("z", "beside", "y"),
        ),
    ),
)
