"""Kinds of task that operate an object in place: press, switch on, open, close."""

from collections.abc import Iterator

from stable_data.instructions.kind import Roles, TaskKind
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.vocabulary import classes_of, control_part

_OPEN, _CLOSED = 0.3, 0.15  # least height of an open and largest height of a closed laptop, as shares of its longer side


def _pressed(s: TaskContext) -> Iterator[Roles]:
    for x in s.shuffled(n for n in s.standing if n not in s.load):
        part = control_part(s.objects[x].category)
        if part is not None:
            yield {"x": x, "part": part}


def _switched(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x} for x in s.shuffled(s.of("switched", s.standing)))


def _dispensers(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x} for x in s.shuffled(s.standing) if control_part(s.objects[x].category) == "the pump")


def _height_share(s: TaskContext, x: str) -> float:
    size = s.objects[x].size
    return size[2] / max(size[:2])


def _closed(s: TaskContext) -> Iterator[Roles]:
    laptops = [n for n in s.of("laptop", s.standing) if _height_share(s, n) < _CLOSED]
    boxes = [n for n in s.of("hinged", s.standing) if not s.graph.nodes[n]["container"]]
    return ({"x": x} for x in s.shuffled(n for n in [*laptops, *boxes] if n not in s.load))


def _opened(s: TaskContext) -> Iterator[Roles]:
    return ({"x": x} for x in s.shuffled(s.of("laptop", s.standing)) if _height_share(s, x) > _OPEN and x not in s.load)


def _cleared_and_opened(s: TaskContext) -> Iterator[Roles]:
    """A closed laptop or box with one object on it."""
    for x in s.shuffled(s.of("laptop", s.standing) + s.of("hinged", s.standing)):
        on_it = s.load.get(x, [])
        is_closed = _height_share(s, x) < _CLOSED if "laptop" in classes_of(s.objects[x].category) else True
        if len(on_it) == 1 and on_it[0] in s.free and is_closed and not s.graph.nodes[x]["container"]:
            yield {"x": on_it[0], "y": x}


KINDS = (
    TaskKind(
        "press",
        _pressed,
        (
            "[press] {part} of {x}",
            "press {part} on {x:short} once",
            "find {part} of {x} and press it",
            "go to {x} and press {part}",
        ),
        ("{part} of {x} has been pressed.",),
        ("Press({x})",),
    ),
    TaskKind(
        "switch_on",
        _switched,
        (
            "[switch|turn] on {x}",
            "[switch|turn] {x:short} on",
            "I need {x} now. Switch {x:it} on.",
            "press the switch so that {x} come{x:s} on",
        ),
        ("{x} {x:is} switched on.",),
        ("Press({x})",),
        theme="work",
    ),
    TaskKind(
        "get_soap",
        _dispensers,
        (
            "get me some soap from {x}",
            "my hands are dirty. Press the pump of {x} for me.",
            "use {x} to give me a little soap",
        ),
        ("The pump of {x} has been pressed.",),
        ("Press({x})",),
    ),
    TaskKind(
        "open",
        _closed,
        (
            "open {x}",
            "open the lid of {x}",
            "{x} {x:is} closed. Open {x:it}.",
            "lift the lid of {x} until {x:they} {x:is} open",
        ),
        ("{x} {x:is} open.",),
        ("RevoluteJointOpen({x})",),
        theme="work",
    ),
    TaskKind(
        "close",
        _opened,
        (
            "close {x}",
            "close the lid of {x}",
            "{x} {x:is} open. Close {x:it}.",
            "fold {x:short} shut",
        ),
        ("{x} {x:is} closed.",),
        ("RevoluteJointClose({x})",),
        theme="done",
    ),
    TaskKind(
        "clear_and_open",
        _cleared_and_opened,
        (
            "take {x} off {y} and open {y:it}",
            "{x} {x:is} on {y:short}. Take {x:it} away, then open {y:short}.",
            "first lift {x} off {y}. Then open {y:it}.",
        ),
        ("{x} {x:is} on the table.", "{y} {y:is} open."),
        ("Pick({x}); PlaceAt(Table); RevoluteJointOpen({y})",),
        (("x", None, "y"),),
        theme="work",
    ),
)
