"""Tasks made up from a scene graph: templates that say only what is true in the scene.

Types and names come from the categories: ``nesting_cup`` is the type ``NestingCup`` and the words ``nesting cup``.
"""

import hashlib
import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from stable_data.errors import SceneError
from stable_data.relations import SceneGraph
from stable_data.scene import TABLE, Relation, RelationKind, Scene, TaskInfo


def type_words(name: str) -> tuple[str, ...]:
    """Lower-case words of a type or category: ``NestingCup``, ``nesting_cup`` and ``nesting cup`` are the same two."""
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return tuple(word.lower() for word in words)


def type_name(category: str) -> str:
    """A category as a type: ``nesting_cup`` is ``NestingCup``."""
    return "".join(word.capitalize() for word in type_words(category))


_MOVABLE_WIDTH, _MOVABLE_LENGTH = 0.15, 0.4  # what one arm picks up, metres
_FIT = 0.9  # contents are at most this share of their container's width
_APART = 0.01  # a leftmost object is left of the next by at least this, metres
_DIRECTIONS = {"left": (0, -1), "right": (0, 1), "front": (1, -1), "back": (1, 1)}  # axis, sign
_ROOM = 0.15  # room that a push needs, metres

_Roles: TypeAlias = dict[str, str]
"""Instances by role (``x``, ``x2``, ``x3``, ``y``, ``z``) and other words of a template."""


@dataclass(frozen=True, slots=True)
class _Template:
    """A kind of task: its words, with ``{x}`` for a role's name and ``{X}`` for its type, and where it applies."""

    kind: str
    find: Callable[["_Teller"], Iterator[_Roles]]
    texts: tuple[str, ...]
    goal: tuple[str, ...]
    actions: tuple[str, ...]
    links: tuple[tuple[str, str], ...] = ()  # roles of which the words say that the first is in or on the second


@dataclass(frozen=True, slots=True)
class _Teller:
    """What templates may say about a scene: only its ``steady`` objects are spoken of."""

    scene: Scene
    graph: SceneGraph
    steady: frozenset[str]

    def loose(self) -> list[str]:
        """Objects on the table that carry nothing and can be picked up."""
        carriers = {about.get("support") for _, about in self.graph.nodes(data=True)}
        free = (o for o in self.scene.objects if o.instance in self.steady and o.instance not in carriers)
        small = (o for o in free if min(o.size[:2]) <= _MOVABLE_WIDTH and max(o.size[:2]) <= _MOVABLE_LENGTH)
        return [o.instance for o in small if self.graph.nodes[o.instance]["support"] == TABLE]

    def standing(self) -> list[str]:
        """Objects on the table."""
        return [n for n in sorted(self.steady) if self.graph.nodes[n]["support"] == TABLE]

    def linked(self, kind: RelationKind) -> list[tuple[str, str]]:
        """Objects with nothing on them that are in or on another, with that other."""
        carriers = {about.get("support") for _, about in self.graph.nodes(data=True)}
        edges = ((a, b) for a, b, k in self.graph.edges(keys=True) if k == kind and b != TABLE and a not in carriers)
        return sorted(e for e in edges if self.steady.issuperset(e))

    def containers(self) -> list[str]:
        """Containers on the table."""
        return [n for n in self.standing() if self.graph.nodes[n]["container"]]

    def fits(self, x: str, y: str) -> bool:
        """Is one narrow enough for the other?"""
        return x != y and max(self.scene[x].size[:2]) <= _FIT * min(self.scene[y].size[:2])

    def can_carry(self, x: str, y: str) -> bool:
        """Is one flat and wide enough for the other to be put onto?"""
        sx, sy = self.scene[x].size, self.scene[y].size
        is_flat = sy[2] <= 0.7 * min(sy[:2]) and not self.graph.nodes[y]["container"]
        return x != y and is_flat and max(sx[:2]) <= 1.2 * min(sy[:2])


def _linked(kind: RelationKind) -> Callable[[_Teller], Iterator[_Roles]]:
    return lambda t: ({"x": x, "y": y} for x, y in t.linked(kind))


def _transfers(t: _Teller) -> Iterator[_Roles]:
    return ({"x": x, "y": y, "z": z} for x, y in t.linked(RelationKind.IN) for z in t.containers() if z != y and t.fits(x, z))


def _put_ins(t: _Teller) -> Iterator[_Roles]:
    return ({"x": x, "y": y} for x, y in itertools.product(t.loose(), t.containers()) if t.fits(x, y))


def _gathers(t: _Teller) -> Iterator[_Roles]:
    loose = t.loose()
    for y in t.containers():
        fitting = [x for x in loose if t.fits(x, y)]
        yield from ({"x": a, "x2": b, "y": y} for a, b in itertools.combinations(fitting, 2))


def _stacks(t: _Teller) -> Iterator[_Roles]:
    return ({"x": x, "y": y} for x, y in itertools.permutations(t.loose(), 2) if t.can_carry(x, y))


def _besides(t: _Teller) -> Iterator[_Roles]:
    sides = {"left of": "left", "right of": "right", "in front of": "front", "behind": "back"}
    movable = set(t.loose())
    at = {o.instance: o.position for o in t.scene.objects}
    for x, y in itertools.permutations(t.standing(), 2):
        for side, (axis, sign) in ((s, _DIRECTIONS[d]) for s, d in sides.items()):
            if x in movable and sign * (at[x][axis] - at[y][axis]) < 0:
                yield {"x": x, "y": y, "side": side}


def _clears(t: _Teller) -> Iterator[_Roles]:
    for kind in (RelationKind.ON, RelationKind.IN):
        pairs = t.linked(kind)
        for (a, y), (b, other) in itertools.combinations(pairs, 2):
            if y == other:
                yield {"x": a, "x2": b, "y": y, "spot": str(kind)}


def _pushes(t: _Teller) -> Iterator[_Roles]:
    for x, (word, (axis, sign)) in itertools.product(t.loose(), _DIRECTIONS.items()):
        at, size = t.scene[x].position[axis], t.scene.table.size_xy[axis]
        if (size - at if sign > 0 else at) > _ROOM:
            yield {"x": x, "direction": word, "cm": "5"}


def _corners(t: _Teller) -> Iterator[_Roles]:
    for x, row, column in itertools.product(t.loose(), ("front", "back"), ("left", "right")):
        if t.graph.nodes[x]["cell"] != f"{row}_{column}":
            yield {"x": x, "corner": f"{row} {column}"}


def _centres(t: _Teller) -> Iterator[_Roles]:
    return ({"x": x} for x in t.loose() if t.graph.nodes[x]["cell"] != "middle_middle")


def _hand_overs(t: _Teller) -> Iterator[_Roles]:
    return ({"x": x} for x in t.loose())


def _swaps(t: _Teller) -> Iterator[_Roles]:
    return ({"x": x, "y": y} for x, y in itertools.combinations(t.loose(), 2))


def _line_ups(t: _Teller) -> Iterator[_Roles]:
    return ({"x": a, "x2": b, "x3": c} for a, b, c in itertools.combinations(t.loose(), 3))


_TABLE_GOAL = "The {x} {is_x} on the table."
_TO_TABLE = ("Pick({X})", "PlaceAt(Table)")
_TEMPLATES = (
    _Template(
        "take_out",
        _linked(RelationKind.IN),
        ("Take the {x} out of the {y} and put it on the table.", "Get the {x} out of the {y}."),
        (_TABLE_GOAL, "The {x} {is_x} not in the {y}."),
        _TO_TABLE,
        (("x", "y"),),
    ),
    _Template(
        "unstack",
        _linked(RelationKind.ON),
        ("Lift the {x} off the {y} and lay it on the table.", "Take the {x} off the {y}."),
        (_TABLE_GOAL, "The {x} {is_x} not on the {y}."),
        _TO_TABLE,
        (("x", "y"),),
    ),
    _Template(
        "transfer",
        _transfers,
        ("Take the {x} out of the {y} and put it into the {z}.",),
        ("The {x} {is_x} in the {z}.", "The {x} {is_x} not in the {y}."),
        ("Pick({X})", "PlaceOn({Z})"),
        (("x", "y"),),
    ),
    _Template(
        "put_in",
        _put_ins,
        ("Put the {x} into the {y}.", "Pick up the {x} and drop it into the {y}."),
        ("The {x} {is_x} in the {y}.",),
        ("Pick({X})", "PlaceOn({Y})"),
    ),
    _Template(
        "gather",
        _gathers,
        ("Collect the {x} and the {x2} in the {y}.",),
        ("The {x} {is_x} in the {y}.", "The {x2} {is_x2} in the {y}."),
        ("Pick({X})", "PlaceOn({Y})", "Pick({X2})", "PlaceOn({Y})"),
    ),
    _Template(
        "stack",
        _stacks,
        ("Stack the {x} on top of the {y}.", "Place the {x} on the {y}."),
        ("The {x} {is_x} on top of the {y}.",),
        ("Pick({X})", "PlaceOn({Y})"),
    ),
    _Template(
        "beside",
        _besides,
        ("Move the {x} so that it stands {side} the {y}.",),
        ("The {x} {is_x} {side} the {y}.",),
        ("Pick({X})", "PlaceAt({side} {Y})"),
    ),
    _Template(
        "clear",
        _clears,
        ("Take the {x} and the {x2} that are {spot} the {y} and put both on the table.",),
        (_TABLE_GOAL, "The {x2} {is_x2} on the table."),
        (*_TO_TABLE, "Pick({X2})", "PlaceAt(Table)"),
        (("x", "y"), ("x2", "y")),
    ),
    _Template(
        "push",
        _pushes,
        ("Push the {x} {cm} cm towards the {direction} of the table.",),
        ("The {x} {is_x} farther to the {direction} than before.",),
        ("Push({X}, {direction}, {cm})",),
    ),
    _Template(
        "corner",
        _corners,
        ("Put the {x} into the {corner} corner of the table.",),
        ("The {x} {is_x} in the {corner} corner.",),
        ("Pick({X})", "PlaceAt({corner})"),
    ),
    _Template(
        "centre",
        _centres,
        ("Bring the {x} to the middle of the table.",),
        ("The {x} {is_x} in the middle of the table.",),
        ("Pick({X})", "PlaceAt(middle)"),
    ),
    _Template(
        "hand_over",
        _hand_overs,
        ("Hand the {x} to the person in front of the table.",),
        ("The {x} {is_x} within reach at the front edge.",),
        ("Pick({X})", "PlaceAt(front)"),
    ),
    _Template(
        "swap",
        _swaps,
        ("Let the {x} and the {y} change places.",),
        ("The {x} {is_x} where the {y} was.", "The {y} {is_y} where the {x} was."),
        ("Pick({X})", "PlaceAt(free spot)", "Pick({Y})", "PlaceAt(former {X})", "Pick({X})", "PlaceAt(former {Y})"),
    ),
    _Template(
        "line_up",
        _line_ups,
        ("Line up the {x}, the {x2} and the {x3} from left to right.",),
        ("The {x}, the {x2} and the {x3} stand in one row.",),
        ("Pick({X})", "PlaceAt(row)", "Pick({X2})", "PlaceAt(row)", "Pick({X3})", "PlaceAt(row)"),
    ),
)


def task_rng(scene_id: str, seed: int = 0) -> np.random.Generator:
    """The generator from which a scene's task is drawn: the same for the same scene and seed, whoever asks and whenever."""
    digest = hashlib.sha256(f"{seed}:{scene_id}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


def derive_task(scene: Scene, graph: SceneGraph, rng: np.random.Generator) -> TaskInfo:
    """A task that makes sense in a scene, by template.

    A kind of task is drawn among those that the scene has the objects for, then the objects, then the words. Objects that
    float in the scene graph's sense, or have no mesh, are left alone where there are others.

    Args:
        scene: The scene; at least one object.
        graph: Its scene graph.
        rng: Where the draws come from, as a rule :func:`task_rng` of the scene's id.

    Returns:
        The task info, ``origin`` ``template``; its task objects, and what it says of the start, are known.

    Raises:
        SceneError: The scene has no objects (``scene_empty``).
    """
    if not scene.objects:
        raise SceneError(f"{scene.scene_id}: no objects, expected one to make a task of; drop the scene", "scene_empty")
    steady = {o.instance for o in scene.objects if o.asset_id is not None and graph.nodes[o.instance]["support"] is not None}
    names = _names(scene, graph)
    plain = {instance: name for instance, name in names.items() if not name.adjective}
    choices = _choices(scene, graph, steady, plain) or _choices(scene, graph, steady, names)
    if not choices:
        return _told(_PICK, _fallback_roles(scene, steady, names), scene, graph, names, _PICK.texts[0])
    template, found = choices[rng.integers(len(choices))]
    roles = found[rng.integers(len(found))]
    return _told(template, roles, scene, graph, names, template.texts[rng.integers(len(template.texts))])


_PICK = _Template("pick", lambda _: iter(()), ("Pick up the {x}.",), ("The {x} {is_x} held above the table.",), ("Pick({X})",))


@dataclass(frozen=True, slots=True)
class _Name:
    """Words for an object; ``anchor`` is the other object that they name, which it is ``kind`` of."""

    words: str
    anchor: str | None = None
    kind: RelationKind | None = None
    adjective: str = ""


def _names(scene: Scene, graph: SceneGraph) -> dict[str, _Name]:
    """Words for each object that only it answers to; objects without such words are missing."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for o in scene.objects:
        alike.setdefault(type_words(o.category), []).append(o.instance)
    unique = {names[0] for names in alike.values() if len(names) == 1}
    found = {}
    for words, names in alike.items():
        for name in names if words else ():
            said = _anchored(graph, name, names, unique) or _outermost(scene, name, names)
            phrase = _Name(" ".join(words)) if name in unique else said and replace(said, words=" ".join(words))
            if phrase:
                found[name] = phrase
    return found


def _anchored(graph: SceneGraph, name: str, alike: list[str], unique: set[str]) -> _Name | None:
    """An object by the one thing that it is in or on, where no other of its kind is."""
    for _, parent, kind in sorted(graph.out_edges(name, keys=True)):
        is_place = kind in (RelationKind.IN, RelationKind.ON) and parent in unique
        if is_place and not any(graph.has_edge(other, parent, key=kind) for other in alike if other != name):
            return _Name("", parent, RelationKind(kind))
    return None


def _outermost(scene: Scene, name: str, alike: list[str]) -> _Name | None:
    x = scene[name].position[0]
    others = [scene[other].position[0] for other in alike if other != name]
    if all(x < other - _APART for other in others):
        return _Name("", adjective="leftmost")
    return _Name("", adjective="rightmost") if all(x > other + _APART for other in others) else None


def _instances(roles: _Roles) -> dict[str, str]:
    return {role: name for role, name in roles.items() if role[0] in "xyz"}


def _can_tell(roles: _Roles, names: dict[str, _Name]) -> bool:
    """Is every object of another type than the others?"""
    chosen = _instances(roles).values()
    return len({names[name].words for name in chosen}) == len(chosen)


def _choices(
    scene: Scene, graph: SceneGraph, steady: set[str], names: dict[str, _Name]
) -> list[tuple[_Template, list[_Roles]]]:
    """The templates that apply to steady objects with names, with what may fill them."""
    teller = _Teller(scene, graph, frozenset(steady & names.keys()))
    able = ((t, [r for r in t.find(teller) if _can_tell(r, names)]) for t in _TEMPLATES)
    return [(template, roles) for template, roles in able if roles]


def _fallback_roles(scene: Scene, steady: set[str], names: dict[str, _Name]) -> _Roles:
    """The object best picked up: steady, with a name, small."""
    best = min(scene.objects, key=lambda o: (o.instance not in steady, o.instance not in names, max(o.size), o.instance))
    return {"x": best.instance}


def _told(template: _Template, roles: _Roles, scene: Scene, graph: SceneGraph, names: dict[str, _Name], text: str) -> TaskInfo:
    """A template's words filled in."""
    chosen = _instances(roles)
    # What a name is told apart by belongs to the task, unless the template speaks of it anyway.
    anchored = {n: a for n in chosen.values() if (a := names.get(n, _Name("")).anchor) and a not in chosen.values()}
    links = [*((chosen[a], chosen[b]) for a, b in template.links), *anchored.items()]
    involved = [*chosen.values(), *anchored.values()]
    full, plain = dict(roles), dict(roles)
    for role, name in chosen.items():
        said = names.get(name, _Name(" ".join(type_words(scene[name].category)) or "object"))
        plain[role], plain[f"is_{role}"] = said.words, "are" if _is_plural(said.words) else "is"
        full[role] = f"{said.adjective} {said.words}".strip()
        if name in anchored:
            full[role] += f" {said.kind} the {names[anchored[name]].words}"
        plain[role.upper()] = type_name(scene[name].category) or "Object"
    return TaskInfo(
        environment=f"A {scene.table.table_type.replace('_', ' ')}, seen from its front edge.",
        task=text.format_map(full),
        goal=tuple(goal.format_map(plain) for goal in template.goal),
        action_sequence=tuple(action.format_map(plain) for action in template.actions),
        objects_cluster=tuple(dict.fromkeys(type_name(scene[name].category) or "Object" for name in involved)),
        task_objects=tuple(o.instance for o in scene.objects if o.instance in involved),
        relations=tuple(sorted({r for a, b in links for r in _links(graph, a, b)})),
        origin="template",
    )


def _is_plural(words: str) -> bool:
    return words.endswith("s") and not words.endswith(("ss", "us", "is"))


def _links(graph: SceneGraph, a: str, b: str) -> Iterator[Relation]:
    kinds = (RelationKind.IN, RelationKind.ON)
    return (Relation(a, kind, b) for kind in kinds if graph.has_edge(a, b, key=kind))
