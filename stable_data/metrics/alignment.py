"""How well a generated scene does what was asked: AwT, AwS and the share of distractors (the paper's appendix, Metrics).

What was asked is a :class:`AlignmentReference`: the required objects, and the relations that the instruction entails of the
scene it starts from. Where a reference scene exists, the full scene graph between its task objects (the paper's S_gt) is a
second figure beside the entailed relations: an instruction rarely asks for all of it.

* ``AwT = |O*_pred ∩ O*_gt| / |O*_gt|``: required objects that are matched, by the rule of :mod:`stable_data.metrics.matching`.
* ``AwS = |S_pred ∩ S_gt| / |S_gt|``: relations that hold between the matched objects. A relation of an object that is missing
  does not hold. Of matchings with the most objects the one is taken under which the most entailed relations hold, then the most
  of the full graph.

When a relation holds:

* ``in`` and ``on``: in the scene graph's own sense, directly or through what lies in between; what shall be on a thing may be
  in it, not the other way round. The same rule judges what a correction keeps.
* ``left of``, ``right of``, ``in front of``, ``behind``: geometrically, within 45 degrees of that direction seen from the
  target, however far and whatever else is near; ``above`` and ``below`` by heights and outlines. An edge of the scene graph is
  not asked for: it links nearest neighbours alone, so that one more distractor would break it.
* ``is at``: the ninth of the table that the centre is in. ``face to``: to 45 degrees. ``are equally spaced along``: one of the
  scene graph's rows along that axis has all of them.

Unknown is never a pass: without relations AwS is None, not 1, and likewise where the search for the best matching was given up.

What an instruction speaks of by its place alone (``take everything out of the tray``) may be anything there, and one will do:
the instruction says neither what nor how many.

A request that gave no scene is aligned as one without objects: its AwT is 0.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

from stable_data.errors import SceneError
from stable_data.instructions.claims import is_named, mentions_all
from stable_data.metrics.matching import DesiredRelation, ObjectMatching, Option, RequiredObject, candidates, match
from stable_data.scene import TABLE, FloatArray, Relation, RelationKind, Scene, TaskInfo
from stable_data.scene_graph.relations import (
    Contacts,
    cell_of,
    direction_of,
    facing_of,
    is_held,
    relations_of,
    scene_graph,
    vertical_relation,
)

_ON_IN = frozenset({RelationKind.ON, RelationKind.IN})
_VERTICAL = frozenset({RelationKind.ABOVE, RelationKind.BELOW})
_OF_ONE = frozenset({RelationKind.IS_AT, RelationKind.FACE_TO})


@dataclass(frozen=True, slots=True)
class AlignmentReference:
    """What a generated scene is held against.

    Attributes:
        scene_id: Of the reference, or the request's.
        required: The task objects, O*_gt; at least one.
        entailed: Relations between them that the instruction entails of the scene it starts from, possibly none.
        graph: The full scene graph between them, S_gt; None where there is no reference scene or it has no scene graph.
        num_objects: Objects of the reference scene; None where there is none.
    """

    scene_id: str
    required: tuple[RequiredObject, ...]
    entailed: tuple[Relation, ...] = ()
    graph: tuple[Relation, ...] | None = None
    num_objects: int | None = None

    def __post_init__(self) -> None:
        """Refuses a task without objects, an object asked for twice, and a relation of what is not required."""
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
    if relation.kind in _OF_ONE:
        return (relation.subject,)
    if relation.kind is RelationKind.EQUALLY_SPACED:
        return tuple(relation.subject.split(", "))
    return (relation.subject, relation.target)


def reference_of(scene: Scene) -> AlignmentReference:
    """What a scene with a task asks of a scene that is generated from its instruction.

    Args:
        scene: With a task whose objects are known; with its scene graph, if the full graph shall be judged too.

    Returns:
        The reference.

    Raises:
        SceneError: There is no task, its objects are unknown, or one of them is not in the scene (``task_objects_unknown``);
            it entails a relation of another object (``task_relation_unknown``).
    """
    wanted = scene.task.task_objects if scene.task is not None else ()
    category = {o.instance: o.category for o in scene.objects}
    if scene.task is None or not wanted or not set(wanted) <= set(category):
        raise SceneError(
            f"{scene.scene_id}: the task objects are {list(wanted)}, expected objects of the scene; resolve the task again",
            "task_objects_unknown",
        )
    unsaid, spare = _unsaid(scene.task, category)
    wanted = tuple(name for name in wanted if name not in spare)
    entailed = tuple(r for r in scene.task.relations if not spare & set(members(r)))
    between = [r for r in scene.relations if r.kind not in _OF_ONE and r.kind is not RelationKind.EQUALLY_SPACED]
    graph = tuple(r for r in between if {r.subject, r.target} <= set(wanted)) if scene.relations else None
    required = tuple(RequiredObject(name, () if name in unsaid else (category[name],)) for name in wanted)
    return AlignmentReference(scene.scene_id, required, entailed, graph, len(scene.objects))


def _unsaid(task: TaskInfo, category: Mapping[str, str]) -> tuple[frozenset[str], frozenset[str]]:
    """Task objects that an instruction speaks of by their place alone: one for each place, and the others."""
    if not mentions_all(task.task):
        return frozenset(), frozenset()
    said = {name for name in task.task_objects if is_named(category[name], task.task)}
    places: dict[str, list[str]] = {}
    for r in task.relations:
        if r.kind in _ON_IN and r.subject not in said and r.target in said:
            places.setdefault(r.target, []).append(r.subject)
    first = frozenset(names[0] for names in places.values())
    return first, frozenset(name for names in places.values() for name in names) - first


@dataclass(frozen=True, slots=True)
class Alignment:
    """How one generated scene compares with what was asked.

    Attributes:
        reference: What was asked.
        matches: Required instance and the generated instance that it was matched to, in the order of ``required``.
        missing: Required objects that nothing was matched to.
        broken: Entailed relations that do not hold, in the reference's names; None where the search was given up.
        graph_broken: Those of the full graph; None where the search was given up or there is no graph.
        num_objects: Objects of the generated scene.
        num_stacked: Those that stand on another object.
        num_contained: Those that are in another object.
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
        """Share of the required objects that are there."""
        return len(self.matches) / len(self.reference.required)

    @property
    def aws(self) -> float | None:
        """Share of the entailed relations that hold; None where nothing is entailed, or it is unknown."""
        return _share_held(self.broken, self.reference.entailed)

    @property
    def aws_graph(self) -> float | None:
        """Share of the full graph between the task objects that holds; None where it is empty or unknown."""
        return _share_held(self.graph_broken, self.reference.graph)

    @property
    def distractor_rate(self) -> float | None:
        """Share of the objects that are not matched to a task object; None without objects."""
        return 1 - len(self.matches) / self.num_objects if self.num_objects else None

    def __str__(self) -> str:
        """One line that says what is there and what is not."""
        said = [f"{len(self.matches)} of {len(self.reference.required)} task objects"]
        said += [f"missing: {', '.join(map(str, self.missing))}"] if self.missing else []
        if self.broken is None:
            said.append("relations unknown: too many similar objects to compare")
        elif self.reference.entailed:
            held = len(self.reference.entailed) - len(self.broken)
            said.append(f"{held} of {len(self.reference.entailed)} entailed relations")
            said += [f"broken: {', '.join(map(str, self.broken))}"] if self.broken else []
        said.append(f"{self.num_objects - len(self.matches)} distractors of {self.num_objects} objects")
        return f"{self.reference.scene_id}: {'; '.join(said)}"


def align(
    scene: Scene,
    reference: AlignmentReference,
    *,
    contacts: Contacts | None = None,
    footprints: Mapping[str, FloatArray] | None = None,
    containers: Mapping[str, bool | None] | None = None,
) -> Alignment:
    """Compares a generated scene with what was asked.

    Args:
        scene: The generated scene; its own task and relations are not looked at, so a raw layout will do.
        reference: What was asked.
        contacts: What each object rests on; None: not known, judged by boxes as
            :func:`~stable_data.scene_graph.relations.scene_graph` does.
        footprints: As for ``scene_graph``.
        containers: As for ``scene_graph``.

    Returns:
        The comparison.
    """
    there = _Layout(scene, contacts or {}, footprints, containers)
    may_be = candidates(reference.required, scene.objects)
    graph = reference.graph or ()
    entailed = [DesiredRelation(len(graph) + 1, tuple(there.options(r, may_be))) for r in reference.entailed]
    full = [DesiredRelation(1, tuple(there.options(r, may_be))) for r in graph]
    found = match(may_be, [*entailed, *full])
    return Alignment(
        reference,
        matches=tuple((r.instance, found.matches[r.instance]) for r in reference.required if r.instance in found.matches),
        missing=tuple(r for r in reference.required if r.instance not in found.matches),
        broken=_broken(found, reference.entailed, entailed),
        graph_broken=None if reference.graph is None else _broken(found, reference.graph, full),
        num_objects=len(scene.objects),
        num_stacked=sum(r.kind is RelationKind.ON and r.target != TABLE for r in there.on_in),
        num_contained=sum(r.kind is RelationKind.IN for r in there.on_in),
    )


def _broken(
    found: ObjectMatching, relations: tuple[Relation, ...], wishes: list[DesiredRelation]
) -> tuple[Relation, ...] | None:
    pairs = zip(relations, wishes, strict=True)
    return tuple(r for r, wish in pairs if not wish.holds(found.matches)) if found.is_best or not relations else None


def _share_held(broken: tuple[Relation, ...] | None, relations: tuple[Relation, ...] | None) -> float | None:
    return None if broken is None or not relations else 1 - len(broken) / len(relations)


class _Layout:
    """A generated scene, ready to be asked between which of its objects a relation holds."""

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

    def options(self, relation: Relation, may_be: Mapping[str, Mapping[str, int]]) -> Iterator[Option]:
        """The ways in which a relation can hold between objects that its instances may be matched to."""
        if relation.kind is RelationKind.EQUALLY_SPACED:
            for row, axis in self.rows:
                if axis == relation.target:
                    yield dict.fromkeys(members(relation), frozenset(row))
        elif relation.kind in _OF_ONE or relation.target == TABLE:
            yield {relation.subject: {name for name in may_be[relation.subject] if self._is_so(name, relation)}}
        else:
            held = [
                (one, other)
                for one, other in product(may_be[relation.subject], may_be[relation.target])
                if one != other and self._is_held(one, relation.kind, other)
            ]
            for one in dict.fromkeys(pair[0] for pair in held):
                yield {relation.subject: {one}, relation.target: {pair[1] for pair in held if pair[0] == one}}

    def _is_so(self, name: str, relation: Relation) -> bool:
        """Does a relation of one object, or to the table, hold of an object?"""
        if relation.kind is RelationKind.IS_AT:
            return cell_of(self.objects[name].position, self.scene.table.size_xy) == relation.target
        if relation.kind is RelationKind.FACE_TO:
            return facing_of(self.objects[name].yaw) == relation.target
        return self._is_held(name, relation.kind, TABLE)

    def _is_held(self, one: str, kind: RelationKind, other: str) -> bool:
        """Does a relation hold between two objects?"""
        if kind in _ON_IN:
            return is_held(self.on_in, Relation(one, kind, other))
        if other == TABLE:
            return False  # nothing else is said of the table
        if kind in _VERTICAL:
            return vertical_relation(self.scene, one, other, self.footprints) is kind
        a, b = self.objects[one].position, self.objects[other].position
        return direction_of(a[0] - b[0], a[1] - b[1]) is kind
