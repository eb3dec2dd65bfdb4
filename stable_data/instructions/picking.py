"""Kinds of task about one object: pick up, show, hand over, move on the table, turn, set upright."""

import itertools
from collections.abc import Iterator

from stable_data.condition import HAND_OVER_REGION
from stable_data.instructions.ends import End
from stable_data.instructions.kind import Roles, TaskKind
from stable_data.instructions.situation import OPPOSITE, SIDES, TaskContext
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.scene import RelationKind

_AT_EDGE = 0.03  # an object closer to an edge than this may be moved away from it, metres
_INWARDS = 0.08  # how far it is moved, metres
_LYING = 0.6  # an upright object has fallen over if its height is less than this share of its length

TOWARDS = {
    RelationKind.LEFT_OF: "to the left",
    RelationKind.RIGHT_OF: "to the right",
    RelationKind.IN_FRONT_OF: "towards the front edge",
    RelationKind.BEHIND: "towards the back edge",
}
DIRECTION = {
    RelationKind.LEFT_OF: "left",
    RelationKind.RIGHT_OF: "right",
    RelationKind.IN_FRONT_OF: "front",
    RelationKind.BEHIND: "back",
}
_PARTS = {
    RelationKind.LEFT_OF: ("left side", ("front_left", "middle_left", "back_left")),
    RelationKind.RIGHT_OF: ("right side", ("front_right", "middle_right", "back_right")),
    RelationKind.IN_FRONT_OF: ("front", ("front_left", "front_middle", "front_right")),
    RelationKind.BEHIND: ("back", ("back_left", "back_middle", "back_right")),
}


def _any(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x} for x in s.shuffled(s.free) if x in s.named)


def _far(s: TaskContext) -> Iterator[Roles]:
    depth = s.scene.table.size_xy[1]
    return ({"x": x} for x in s.shuffled(s.loose) if s.objects[x].position[1] > 0.5 * depth)


def _corners(s: TaskContext) -> Iterator[Roles]:
    for x, row, column in itertools.product(s.shuffled(s.loose), s.shuffled(("front", "back")), s.shuffled(("left", "right"))):
        if s.graph.nodes[x]["cell"] != f"{row}_{column}" and s.has_room_in(x, f"{row}_{column}"):
            yield {"x": x, "corner": f"{row} {column}"}


def _centres(s: TaskContext) -> Iterator[Roles]:
    away = (x for x in s.shuffled(s.loose) if s.graph.nodes[x]["cell"] != "middle_middle")
    return ({"x": x} for x in away if s.has_room_in(x, "middle_middle"))


def _parts(s: TaskContext) -> Iterator[Roles]:
    for x, side in itertools.product(s.shuffled(s.loose), s.shuffled(SIDES)):
        part, cells = _PARTS[side]
        if s.graph.nodes[x]["cell"] not in cells and any(s.has_room_in(x, cell) for cell in cells):
            yield {"x": x, "part": part}


def _at_edges(s: TaskContext) -> Iterator[Roles]:
    for x, side in itertools.product(s.shuffled(s.loose), SIDES):
        if s.margin(x, side) < _AT_EDGE and s.can_slide(x, OPPOSITE[side], _INWARDS):
            yield {"x": x, "edge": DIRECTION[side], "inwards": DIRECTION[OPPOSITE[side]]}


def _pushes(s: TaskContext) -> Iterator[Roles]:
    for x, side, cm in itertools.product(s.shuffled(s.loose), s.shuffled(SIDES), s.shuffled((5, 8, 10, 15))):
        if s.can_slide(x, side, cm / 100):
            yield {"x": x, "towards": TOWARDS[side], "direction": DIRECTION[side], "cm": str(cm)}


def _with_front(s: TaskContext) -> list[str]:
    return s.shuffled(s.of("with_front", s.loose))


def _turned_away(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x} for x in _with_front(s) if "front" not in s.graph.nodes[x]["facing"])


def _turned_from(s: TaskContext) -> Iterator[Roles]:
    for x, y in s.pairs(_with_front(s), s.standing):
        if s.graph.nodes[x]["facing"] != s.facing_towards(x, y) and s.gap(x, y) > 0.05:
            yield {"x": x, "y": y}


def _fallen(s: TaskContext) -> Iterator[Roles]:
    for x in s.shuffled(s.of("upright", s.loose)):
        size = s.objects[x].size
        low = classes_of(s.objects[x].category) & {"cup", "bowl"}  # an upright cup may be wider than high
        if size[2] < (0.45 if low else _LYING) * max(size[:2]) and s.objects[x].tilt_angle > 1.0:
            yield {"x": x}


KINDS = (
    TaskKind(
        "pick_up",
        _any,
        (
            "[pick up] {x}",
            "pick {x:short} up",
            "grasp {x} and raise {x:it} a few centimetres",
            "get a firm hold of {x} and lift {x:it}",
            "lift {x} and keep holding {x:it}",
        ),
        ("{x} {x:is} held above the table.",),
        ("Pick({x})",),
        ends=(End("x", "held"),),
    ),
    TaskKind(
        "show",
        _any,
        (
            "pick up {x} and show {x:it} to me",
            "[hold|lift] {x:short} up to the camera",
            "[raise|lift] {x} so that I can see {x:it} better",
            "let me have a closer look at {x}",
            "I want to inspect {x}. Hold {x:it} up for me.",
            "take {x} and present {x:it} to the camera",
        ),
        ("{x} {x:is} held up in front of the camera.",),
        ("Pick({x}); PlaceAt(in front of camera)",),
        theme="look",
        ends=(End("x", "held"),),
    ),
    TaskKind(
        "hand_over",
        _any,
        (
            "[hand] me {x}",
            "[hand] {x} to the person in front of the table",
            "pick up {x} and hand {x:it} over to me",
            "I need {x}. [Hand|Pass] {x:it} to me.",
            "[fetch|get|bring] me {x}",
            "let me have {x}",
        ),
        ("The person in front of the table holds {x}.",),
        ("Pick({x}); PlaceAt(hand of the person)",),
        ends=(End("x", "held", HAND_OVER_REGION),),
    ),
    TaskKind(
        "within_reach",
        _far,
        (
            "[bring] {x} within my reach, near the front edge",
            "[move] {x} closer to me, up to the front edge",
            "I cannot reach {x}. [Bring|Move] {x:it} to the front of the table.",
            "{x} {x:is} too far away from me. [Put] {x:it} near the front edge.",
            "[put] {x} where I can reach {x:it}, at the front edge",
        ),
        ("{x} {x:is} within reach at the front edge.",),
        ("Pick({x}); PlaceAt(front edge)",),
        ends=(End("x", "at", "front_edge"),),
    ),
    TaskKind(
        "corner",
        _corners,
        (
            "[put] {x} into the {corner} corner of the table",
            "move {x:short} out of the way, to the {corner} corner",
            "I want {x} to be in the {corner} corner of the table.",
            "[carry|take] {x} to the {corner} corner",
            "the {corner} corner is the right place for {x}. [Put] {x:it} there.",
        ),
        ("{x} {x:is} in the {corner} corner.",),
        ("Pick({x}); PlaceAt({corner})",),
        ends=(End("x", "at", "{corner}"),),
    ),
    TaskKind(
        "centre",
        _centres,
        (
            "[bring] {x} to the [middle] of the table",
            "[put] {x} in the [middle] of the table",
            "[move] {x} so that {x:they} stand{x:s} in the middle of the table",
            "I want {x} to be right in the middle of the table.",
        ),
        ("{x} {x:is} in the middle of the table.",),
        ("Pick({x}); PlaceAt(middle)",),
        ends=(End("x", "at", "middle_middle"),),
    ),
    TaskKind(
        "part",
        _parts,
        (
            "[move] {x:short} over to the {part} of the table",
            "[take|carry] {x} to the {part} of the table",
            "{x} should be at the {part} of the table. [Put] {x:it} there.",
            "find a free spot for {x} at the {part} of the table",
        ),
        ("{x} {x:is} at the {part} of the table.",),
        ("Pick({x}); PlaceAt({part})",),
        ends=(End("x", "at", "{part}"),),
    ),
    TaskKind(
        "away_from_edge",
        _at_edges,
        (
            "[move] {x} away from the {edge} edge of the table",
            "{x} {x:is} too close to the {edge} edge. [Move|Push] {x:it} further onto the table.",
            "[push] {x} inwards from the {edge} edge before {x:they} fall{x:s} down",
            "make sure that {x} cannot fall over the {edge} edge: push {x:it} inwards.",
        ),
        ("{x} {x:is} well away from the {edge} edge.",),
        ("Push({x}, {inwards}, 8)",),
        ends=(End("x", "apart", "{edge}_edge"),),
    ),
    TaskKind(
        "push",
        _pushes,
        (
            "[push] {x} {cm} cm {towards}",
            "gently [push] {x} {towards} by about {cm} cm",
            "slide {x} {cm} cm {towards} without lifting {x:it}",
            "give {x} a push of {cm} cm {towards}",
            "{x} should be {cm} cm farther {towards}. [Push|Slide] {x:it} there.",
        ),
        ("{x} {x:is} {cm} cm farther {towards} than before.",),
        ("Push({x}, {direction}, {cm})",),
        ends=(End("x", "moved", "{direction}", "{cm}"),),
    ),
    TaskKind(
        "turn_to_front",
        _turned_away,
        (
            "[turn] {x} so that {x:they} face{x:s} the front edge",
            "[turn] {x} to face me",
            "I am sitting at the front edge and see {x} from the wrong side. Turn {x:it} to me.",
            "[turn] {x} on the spot until {x:its} front points to the front edge",
        ),
        ("{x} face{x:s} the front edge.",),
        ("Pick({x}); PlaceAt(same place, facing front)",),
        ends=(End("x", "facing", "front"),),
    ),
    TaskKind(
        "turn_to",
        _turned_from,
        (
            "[turn] {x} so that {x:they} face{x:s} {y}",
            "[turn] {x} towards {y}",
            "leave {x:short} where {x:they} {x:is}, but turn {x:its} front towards {y}",
            "the front of {x} should point to {y}. [Turn|Rotate] {x:it} that way.",
        ),
        ("{x} face{x:s} {y}.",),
        ("Pick({x}); PlaceAt(same place, facing {y})",),
        ends=(End("x", "facing", "y"),),
    ),
    TaskKind(
        "stand_up",
        _fallen,
        (
            "stand {x:short} upright",
            "{x} {x:is} lying on {x:its} side. Set {x:it} upright.",
            "[pick up] {x} and stand {x:it} on {x:its} base",
            "put {x:short} back on {x:its} base",
        ),
        ("{x} stand{x:s} upright.",),
        ("Pick({x}); PlaceAt(same place, upright)",),
        theme="tidy",
        ends=(End("x", "upright"),),
    ),
)
