"""Alignment of a generated scene with its instruction: AwT, AwS and the share of distractors (the paper's appendix, Metrics).

An :class:`AlignmentReference` states what is required: the required objects, and the relations that the instruction entails for
its start scene. If there is a reference scene, the full scene graph between its task objects (the paper's S_gt) gives a second
figure, because an instruction rarely asks for the whole graph.

* ``AwT = |O*_pred ∩ O*_gt| / |O*_gt|``: the required objects that are matched, by the rule of
  :mod:`stable_data.metrics.matching`.
* ``AwS = |S_pred ∩ S_gt| / |S_gt|``: the relations that hold between the matched objects. A relation of a missing object does
  not hold. Of the matchings with the most objects, the one with the most entailed relations is used; ties are decided by the
  full graph.

A relation holds under these conditions:

* ``in`` and ``on``: as in the scene graph, directly or through the objects between. ``on`` also holds if the object is in the
  target; ``in`` does not hold if it is only on it. :mod:`stable_data.metrics.relations_kept` uses the same rule.
* ``left of``, ``right of``, ``in front of``, ``behind``: geometrically, within 45 degrees of that direction seen from the
  target, at any distance and with any other objects near. ``above`` and ``below``: by heights and outlines. An edge of the
  scene graph is not required: edges link only nearest neighbours, so one more distractor would break the relation.
* ``is at``: the centre is in that ninth of the table. ``face to``: the facing, rounded to 45 degrees, is that direction.
  ``are equally spaced along``: one row of the scene graph along that axis contains all of the objects. ``between``: seen from
  the two others, the object is in opposite directions.

Unknown is never a pass: without relations AwS is None, not 1. It is also None if the search for the best matching was stopped.

An instruction can name objects by their place alone (``take everything out of the tray``). Any object may then be matched, and
one is enough: the instruction states neither the categories nor the number.

A request without a scene is aligned as a scene without objects: its AwT is 0.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

from stable_data.errors import SceneError
from stable_data.instructions.claims import mentions_all, nouns_in
from stable_data.instructions.wording.vocabulary import closeness
from stable_data.metrics.matching import DesiredRelation, ObjectMatching, Option, RequiredObject, candidates, match
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, Scene, TaskInfo
from stable_data.scene_graph.relations import (
    Contacts,
    cell_of,
    direction_of,
    facing_of,
    is_between,
    is_held,
    relations_of,
    scene_graph,
    vertical_relation,
)

_ON_IN = frozenset({RelationKind.ON, RelationKind.IN})
_UNARY = frozenset({RelationKind.IS_AT, RelationKind.FACE_TO})


@dataclass(frozen=True, slots=True)
class AlignmentReference:
    """The requirements that a generated scene is compared with.

    Attributes:
        scene_id: The id of the reference scene, or of the request.
        required: The task objects, O*_gt; at least one.
        entailed: Relations between them that the instruction entails for its start scene, possibly none.
        graph: The full scene graph between them, S_gt; None without a reference scene or without its scene graph.
        num_objects: Number of objects of the reference scene; None without one.
    """

    scene_id: str
    required: tuple[RequiredObject, ...]
    entailed: tuple[Relation, ...] = ()
    graph: tuple[Relation, ...] | None = None
    num_objects: int | None = None

    def __post_init__(self) -> None:
        """Refuses a task without objects, a repeated object, and a relation of an object that is not required."""
        names = [r.instance for r in self.required]
        if not names or len(set(names)) < len(names):
            raise SceneError(
                f"{self.scene_id}: required objects are {names}, expected one or more different names; write them again",
                "task_objects_unknown",
            )
        for relation in (*self.entailed, *(self.graph or ())):
            absent = sorted(set(members(relation)) - {*names, TABLE})
            if absent:
                raise SceneError(
                    f"{self.scene_id}: {relation} is required, but {', '.join(absent)} is not a required object; add it",
                    "task_relation_unknown",
                )


def members(relation: Relation) -> tuple[str, ...]:
    """The instances, or ``table``, that a relation is about."""
    if relation.kind in _UNARY:
        return (relation.subject,)
    if relation.kind is RelationKind.EQUALLY_SPACED:
        return tuple(relation.subject.split(", "))
    if relation.kind is RelationKind.BETWEEN:
        return (relation.subject, *relation.target.split(", "))
    return (relation.subject, relation.target)


def reference_of(scene: Scene) -> AlignmentReference:
    """Returns the requirements of a scene's task, for scenes that are generated from its instruction.

    Args:
        scene: A scene with a task whose objects are known; with its scene graph if the full graph is judged too.

    Raises:
        SceneError: There is no task, its objects are unknown, or one of them is not in the scene (``task_objects_unknown``); or
            the task entails a relation of another object (``task_relation_unknown``).
    """
    task_objects = scene.task.task_objects if scene.task is not None else ()
    category = {o.instance: o.category for o in scene.objects}
    if scene.task is None or not task_objects or not set(task_objects) <= set(category):
        raise SceneError(
            f"{scene.scene_id}: the task objects are {list(task_objects)}, expected objects of the scene; resolve the task again",
            "task_objects_unknown",
        )
    unnamed, extra = _unnamed_objects(scene.task, category)
    wanted = tuple(name for name in task_objects if name not in extra)
    entailed = tuple(r for r in scene.task.relations if not extra & set(members(r)))
    # A scene without relations has no scene graph yet: its figure is unknown, not 0.
    between = [r for r in scene.relations if r.kind not in _UNARY and r.kind is not RelationKind.EQUALLY_SPACED]
    graph = tuple(r for r in between if {r.subject, r.target} <= set(wanted)) if scene.relations else None
    required = tuple(
        RequiredObject(name, () if name in unnamed else _categories_of(category[name], scene.task.task)) for name in wanted
    )
    return AlignmentReference(scene.scene_id, required, entailed, graph, len(scene.objects))


def _categories_of(category: str, text: str) -> tuple[str, ...]:
    """The category; or what an instruction calls it if it only uses wider nouns: ``the cup`` of a teacup can be a mug."""
    nouns = tuple(noun.replace(" ", "_") for noun in nouns_in(text, category))
    return (category,) if category in nouns else nouns or (category,)


def _unnamed_objects(task: TaskInfo, category: Mapping[str, str]) -> tuple[frozenset[str], frozenset[str]]:
    """Task objects that an instruction names by their place alone: the first of each place, and the others."""
    if not mentions_all(task.task):  # only words such as "everything" name objects by their place
        return frozenset(), frozenset()
    named = {name for name in task.task_objects if nouns_in(task.task, category[name])}
    places: dict[str, list[str]] = {}
    for r in task.relations:
        if r.kind in _ON_IN and r.subject not in named and r.target in named:
            places.setdefault(r.target, []).append(r.subject)
    first = frozenset(names[0] for names in places.values())
    return first, frozenset(name for names in places.values() for name in names) - first


@dataclass(frozen=True, slots=True)
class Alignment:
    """The comparison of one generated scene with its reference.

    Attributes:
        reference: The requirements.
        matches: Pairs of a required instance and the matched generated instance, in the order of ``required``.
        missing: Required objects without a match.
        broken: Entailed relations that do not hold, in the reference's names; None if the search was stopped.
        graph_broken: Relations of the full graph that do not hold; None if the search was stopped or there is no graph.
        num_objects: Number of objects of the generated scene.
        num_stacked: Number of objects that stand on another object.
        num_contained: Number of objects that are in another object.
    """

    reference: AlignmentReference
    matches: tuple[tuple[str, str], ...]
    missing: tuple[RequiredObject, ...]
    broken: tuple[Relation, ...] | None
    graph_broken: tuple[Relation, ...] | None
    num_objects: int
    num_stacked: int
    num_contained: int

    @property
    def awt(self) -> float:
        """Share of the required objects that are matched."""
        return len(self.matches) / len(self.reference.required)

    @property
    def aws(self) -> float | None:
        """Share of the entailed relations that hold; None if none is entailed, or if it is unknown."""
        return _share_held(self.broken, self.reference.entailed)

    @property
    def aws_graph(self) -> float | None:
        """Share of the full graph between the task objects that holds; None if the graph is empty or the share is unknown."""
        return _share_held(self.graph_broken, self.reference.graph)

    @property
    def distractor_rate(self) -> float | None:
        """Share of the objects that are not matched to a task object; None without objects."""
        return 1 - len(self.matches) / self.num_objects if self.num_objects else None

    def __str__(self) -> str:
        """One line of counts, with the missing objects and the broken relations."""
        parts = [f"{len(self.matches)} of {len(self.reference.required)} task objects"]
        parts += [f"missing: {', '.join(map(str, self.missing))}"] if self.missing else []
        if self.broken is None:
            parts.append("relations unknown: too many similar objects to compare")
        elif self.reference.entailed:
            held = len(self.reference.entailed) - len(self.broken)
            parts.append(f"{held} of {len(self.reference.entailed)} entailed relations")
            parts += [f"broken: {', '.join(map(str, self.broken))}"] if self.broken else []
        parts.append(f"{self.num_objects - len(self.matches)} distractors of {self.num_objects} objects")
        return f"{self.reference.scene_id}: {'; '.join(parts)}"


def align(
    scene: Scene,
    reference: AlignmentReference,
    *,
    contacts: Contacts | None = None,
    footprints: Mapping[str, FloatArray] | None = None,
    containers: Mapping[str, bool | None] | None = None,
) -> Alignment:
    """Compares a generated scene with its reference.

    Args:
        scene: The generated scene. Its own task and relations are not read, so a raw layout is accepted.
        reference: The requirements.
        contacts: The supports of each object; None if they are not known: supports are then derived from boxes, as
            :func:`~stable_data.scene_graph.relations.scene_graph` does.
        footprints: As for ``scene_graph``.
        containers: As for ``scene_graph``.
    """
    layout = _Layout(scene, contacts or {}, footprints, containers)
    allowed = candidates(reference.required, scene.movable)
    graph = reference.graph or ()
    # One entailed relation outweighs the whole full graph, which only decides ties.
    entailed = [DesiredRelation(len(graph) + 1, tuple(layout.options(r, allowed))) for r in reference.entailed]
    full = [DesiredRelation(1, tuple(layout.options(r, allowed))) for r in graph]
    found = match(allowed, [*entailed, *full])
    return Alignment(
        reference,
        matches=tuple((r.instance, found.matches[r.instance]) for r in reference.required if r.instance in found.matches),
        missing=tuple(r for r in reference.required if r.instance not in found.matches),
        broken=_broken(found, reference.entailed, entailed),
        graph_broken=None if reference.graph is None else _broken(found, reference.graph, full),
        num_objects=len(scene.movable),
        num_stacked=sum(r.kind is RelationKind.ON and r.target != TABLE for r in layout.on_in),
        num_contained=sum(r.kind is RelationKind.IN for r in layout.on_in),
    )


def broken_relations(
    scene: Scene,
    relations: Iterable[Relation],
    *,
    contacts: Contacts | None = None,
    footprints: Mapping[str, FloatArray] | None = None,
    containers: Mapping[str, bool | None] | None = None,
) -> tuple[Relation, ...]:
    """Returns the relations that do not hold between the very instances that they name; those of a missing instance do not.

    Args:
        scene: The scene; its own relations are not read.
        relations: The relations, such as those of a task info.
        contacts: As for :func:`align`.
        footprints: As for :func:`align`.
        containers: As for :func:`align`.
    """
    layout = _Layout(scene, contacts or {}, footprints, containers)
    own = {name: {name: 1} for name in (*layout.objects, TABLE)}

    def holds(relation: Relation) -> bool:
        if not own.keys() >= set(members(relation)):
            return False
        return any(all(name in found for name, found in option.items()) for option in layout.options(relation, own))

    return tuple(r for r in relations if not holds(r))


def requires_the_same(one: AlignmentReference, other: AlignmentReference) -> bool:
    """Whether two references require the same objects and entail the same relations; their instances may have other names.

    Two required objects are the same if their categories agree, or if one of them may have any. The graphs are not compared.
    """
    if len(one.required) != len(other.required):
        return False
    allowed = {
        r.instance: {q.instance: 1 for q in other.required if not (r.categories and q.categories) or _agree(r, q)}
        for r in one.required
    }
    there = [_statement(r) for r in other.entailed]
    desired = [
        DesiredRelation(
            1, tuple({a: {b} for a, b in zip(names, others, strict=True)} for same, others in there if same == kind)
        )
        for kind, names in map(_statement, one.entailed)
    ]
    matches = match(allowed, desired).matches
    if len(matches) < len(one.required):
        return False
    here = {(kind, tuple(matches.get(name, name) for name in names)) for kind, names in map(_statement, one.entailed)}
    return _with_ends_in_order(here) == _with_ends_in_order(there)


def _agree(one: RequiredObject, other: RequiredObject) -> bool:
    return any(closeness(a, b) or closeness(b, a) for a in one.categories for b in other.categories)


_TURNED = {RelationKind.RIGHT_OF: RelationKind.LEFT_OF, RelationKind.BEHIND: RelationKind.IN_FRONT_OF}

Statement: TypeAlias = tuple[str, tuple[str, ...]]
"""What a relation states, with the cell of the table if it names one, and of which instances."""


def _statement(r: Relation) -> Statement:
    """What a relation states; of two relations that mean the same, such as ``left of`` and ``right of``, only one occurs."""
    if r.kind in _TURNED:
        return _TURNED[r.kind], (r.target, r.subject)
    has_value = r.kind in _UNARY or r.kind is RelationKind.EQUALLY_SPACED
    return (f"{r.kind} {r.target}" if has_value else r.kind), members(r)


def _with_ends_in_order(statements: Iterable[Statement]) -> set[Statement]:
    """The statements, with the two things that another one is between in alphabetical order."""
    return {(k, (n[0], *sorted(n[1:])) if k == RelationKind.BETWEEN else n) for k, n in statements}


def _broken(
    found: ObjectMatching, relations: tuple[Relation, ...], desired: list[DesiredRelation]
) -> tuple[Relation, ...] | None:
    if not found.is_best and relations:
        return None
    return tuple(r for r, wanted in zip(relations, desired, strict=True) if not wanted.holds(found.matches))


def _share_held(broken: tuple[Relation, ...] | None, relations: tuple[Relation, ...] | None) -> float | None:
    return None if broken is None or not relations else 1 - len(broken) / len(relations)


class _Layout:
    """Finds the objects of a generated scene between which a relation holds."""

    def __init__(
        self,
        scene: Scene,
        contacts: Contacts,
        footprints: Mapping[str, FloatArray] | None,
        containers: Mapping[str, bool | None] | None,
    ) -> None:
        self.scene, self.footprints = scene, footprints
        self.objects = {o.instance: o for o in scene.objects}
        graph = scene_graph(scene, contacts, footprints, containers)
        self.on_in = frozenset(r for r in relations_of(graph) if r.kind in _ON_IN)
        self.rows: tuple[tuple[tuple[str, ...], str], ...] = graph.graph["rows"]

    def options(self, relation: Relation, allowed: Mapping[str, Mapping[str, int]]) -> Iterator[Option]:
        """The ways in which a relation can hold between the objects that its instances may be matched to."""
        if relation.kind is RelationKind.EQUALLY_SPACED:
            for row, axis in self.rows:
                if axis == relation.target:
                    yield dict.fromkeys(members(relation), frozenset(row))
        elif relation.kind is RelationKind.BETWEEN:
            middle, one, other = members(relation)
            for a, b in product(allowed[middle], allowed[one]):
                ends = frozenset(c for c in allowed[other] if len({a, b, c}) == 3 and self._is_between(a, b, c))
                if ends:
                    yield {middle: {a}, one: {b}, other: ends}
        elif relation.kind in _UNARY or relation.target == TABLE:
            yield {relation.subject: {name for name in allowed[relation.subject] if self._holds_for_one(name, relation)}}
        else:
            held = [
                (one, other)
                for one, other in product(allowed[relation.subject], allowed[relation.target])
                if one != other and self._holds_between(one, relation.kind, other)
            ]
            # One option for each subject with all of its targets: far fewer variables than one for each pair.
            for one in dict.fromkeys(pair[0] for pair in held):
                yield {relation.subject: {one}, relation.target: {pair[1] for pair in held if pair[0] == one}}

    def _is_between(self, middle: str, one: str, other: str) -> bool:
        return is_between(*(self.objects[name].position for name in (middle, one, other)))

    def _holds_for_one(self, name: str, relation: Relation) -> bool:
        """Whether a relation of one object, or of an object to the table, holds."""
        if relation.kind is RelationKind.IS_AT:
            return cell_of(self.objects[name].position, self.scene.table.size_xy) == relation.target
        if relation.kind is RelationKind.FACE_TO:
            return facing_of(self.objects[name].yaw) == relation.target
        return self._holds_between(name, relation.kind, TABLE)

    def _holds_between(self, one: str, kind: RelationKind, other: str) -> bool:
        """Whether a relation between two objects holds."""
        if kind in _ON_IN:
            return is_held(self.on_in, Relation(one, kind, other))
        if other == TABLE:
            return False  # no other kind relates an object to the table
        if kind in (RelationKind.ABOVE, RelationKind.BELOW):
            return vertical_relation(self.scene, one, other, self.footprints) is kind
        a, b = self.objects[one].position, self.objects[other].position
        return direction_of(a[0] - b[0], a[1] - b[1]) is kind
