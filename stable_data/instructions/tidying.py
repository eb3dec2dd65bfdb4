"""Kinds of task that put objects where they belong: pens, fruit, toys, books, soap, toothbrushes, cosmetics, cups."""

from collections.abc import Iterator

from stable_data.instructions.containing import some_into
from stable_data.instructions.ends import End
from stable_data.instructions.kind import MAX_LISTED, Finder, Roles, TaskKind
from stable_data.instructions.situation import TaskContext

_BELONGS_IN = (
    ("writing", "writing_place"),
    ("fruit", "fruit_place"),
    ("toothbrush", "toothbrush_place"),
    ("toy", "toy_place"),
    ("cosmetics", "cosmetics_place"),
)
_BELONGS_ON = (("soap", "soap_place"), ("cup", "saucer"))


def _belongings_in(s: TaskContext) -> Iterator[Roles]:
    for item_class, place_class in s.shuffled(_BELONGS_IN):
        for x, y in s.pairs(s.of(item_class, s.loose), s.of(place_class, s.containers)):
            if s.fits(x, y):
                yield {"x": x, "y": y}


def _belongings_on(s: TaskContext) -> Iterator[Roles]:
    for item_class, place_class in s.shuffled(_BELONGS_ON):
        for x, y in s.pairs(s.of(item_class, s.loose), s.of(place_class, s.standing)):
            item, base = s.objects[x].size, s.objects[y].size
            if y not in s.load and max(item[:2]) <= 1.3 * max(base[:2]) and base[2] < 0.06:
                yield {"x": x, "y": y}


def _all_into(item_class: str, place_class: str) -> Finder:
    """Returns a finder of all objects of a class, none of them in or on another object, and a container for them."""

    def find(s: TaskContext) -> Iterator[Roles]:
        every = s.all_of(item_class)
        if len(every) < 2 or not set(every) <= set(s.every_loose):
            return
        for y in s.shuffled(s.of(place_class, s.containers)):
            if s.all_fit(every, y):
                yield {"xs": tuple(every), "y": y}

    return find


def _books(s: TaskContext) -> Iterator[Roles]:
    """All books, if each of them lies flat on the table."""
    books = s.all_of("book")
    flat = all(n in s.every_loose and s.objects[n].size[2] < 0.5 * min(s.objects[n].size[:2]) for n in books)
    if 2 <= len(books) <= 6 and flat:
        yield {"xs": tuple(sorted(books, key=lambda n: (-s.objects[n].size[0] * s.objects[n].size[1], n)))}


def _clutter(s: TaskContext) -> Iterator[Roles]:
    """All objects at the middle of the front edge, the working area."""
    here = [n for n in s.objects if s.graph.nodes[n]["cell"] == "front_middle"]
    if 2 <= len(here) <= MAX_LISTED and set(here) <= set(s.loose):
        yield {"xs": tuple(here)}


KINDS = (
    TaskKind(
        "belongs_in",
        _belongings_in,
        (
            "[put] {x:short} back [into] {y}",
            "[put] {x} where {x:they} belong{x:s}, in {y}",
            "{x} belong{x:s} in {y}. [Put] {x:it} there.",
            "{y} {y:is} the place for {x}. [Put] {x:it} in there.",
            "tidy up by returning {x} to {y}",
        ),
        ("{x} {x:is} in {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("x", "in", "y"),),
    ),
    TaskKind(
        "belongs_on",
        _belongings_on,
        (
            "[put] {x} on {y}, where {x:they} belong{x:s}",
            "{x} belong{x:s} on {y}. [Put] {x:it} there.",
            "return {x} to {y}",
        ),
        ("{x} {x:is} on {y}.",),
        ("Pick({x}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("x", "on", "y"),),
    ),
    TaskKind(
        "pens",
        _all_into("writing", "writing_place"),
        (
            "put {xs:=everything to write with} into {y}",
            "collect {xs:=all the writing things} in {y}",
            "tidy the desk: {xs:=all pens and pencils} go into {y}.",
        ),
        ("All the writing things are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="done",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "fruit",
        _all_into("fruit", "fruit_place"),
        (
            "put {xs:=all the fruit} into {y}",
            "collect {xs:=every piece of fruit} in {y}",
            "{xs:=the fruit} belongs in {y}. Put all of it there.",
            "fill {y} with {xs:=all the fruit} on the table",
        ),
        ("All the fruit is in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "fruit_by_name",
        some_into("fruit", "fruit_place", counts=(3, 2)),
        (
            "arrange {xs} in {y}",
            "fill {y} with {xs}",
            "{xs} belong in {y}. Put them there.",
        ),
        ("{xs} are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="meal",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "toys",
        _all_into("toy", "toy_place"),
        (
            "put {xs:=all the toys} into {y}",
            "clear {xs:=the toys} away into {y}, every one of them",
            "playtime is over. Put {xs:=all the toys} into {y}.",
        ),
        ("All the toys are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "toys_by_name",
        some_into("toy", "toy_place", counts=(3, 2)),
        (
            "put {xs} back into {y} after playing",
            "{xs} are toys and belong in {y}. Put them there.",
            "clear the toys away: {xs} go into {y}.",
        ),
        ("{xs} are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "cosmetics",
        _all_into("cosmetics", "cosmetics_place"),
        (
            "put {xs:=all the cosmetics} into {y}",
            "clear {xs:=all the make-up things} away into {y}",
            "store {xs:=everything for hair and face} in {y}",
        ),
        ("All the cosmetics are in {y}.",),
        ("Pick({xs}); PlaceOn({y})",),
        theme="tidy",
        ends=(End("xs", "in", "y"),),
    ),
    TaskKind(
        "books",
        _books,
        (
            "make one tidy stack of {xs:=all the books}",
            "stack {xs:=all the books}, the largest at the bottom",
            "pile {xs:=the books} up in one place, large ones below small ones",
        ),
        ("All the books form one stack.",),
        ("Pick({xs}); PlaceAt(stack)",),
        theme="done",
        ends=(End("xs", "on", is_chain=True),),
    ),
    TaskKind(
        "work_space",
        _clutter,
        (
            "clear the space at the middle of the front edge by moving {xs} away",
            "I need the place right in front of me. Move {xs} out of the way.",
            "make room for my work in front of me: {xs} must go.",
        ),
        ("Nothing stands at the middle of the front edge.",),
        ("Pick({xs}); PlaceAt(elsewhere)",),
        theme="work",
        ends=(End("xs", "at", "front_middle", is_negated=True),),
    ),
)
