"""Judges an edited scene against what a person expects of the edit."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stable_data.errors import ConfigError
from stable_data.metrics.matching import RequiredObject, candidates, match
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject
from stable_data.scene_graph.relations import cell_of, direction_of, is_held

LISTS = ("removed", "moved", "may_change", "kept", "added", "replaced", "restyled", "relations", "broken")
"""The lists of ``expected``; a list that is left out is empty."""

_MOVED, _TURNED = 0.01, math.radians(5)  # metres and radians beyond which an object has moved
_AT_ITS_PLACE = 0.05  # metres; an object that replaces another one is so near, or nearer than half the other's longest side

_ON_IN = (RelationKind.ON, RelationKind.IN)


@dataclass(frozen=True, slots=True)
class ExpectedEdit:
    """An edit with what a person expects of it.

    Attributes:
        edit_id: Id of the edit.
        scene_id: The scene.
        kind: Kind of the edit, such as ``move``.
        instruction: The words.
        expected: The lists of :data:`LISTS`; an instance is in one list alone, and objects in none are kept.
        ambiguous: Instances between which the edit must ask back; empty if it is clear.
    """

    edit_id: str
    scene_id: str
    kind: str
    instruction: str
    expected: Mapping[str, Sequence[Any]]
    ambiguous: tuple[str, ...] = ()


def read_expected_edits(path: Path) -> list[ExpectedEdit]:
    """Reads a file with one edit in each line.

    Raises:
        ConfigError: A line has no such edit (``edits_invalid``).
    """
    found = []
    for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
            expected = dict(row["expected"])
            ambiguous = tuple(expected.pop("ambiguous", ()))
            if strange := sorted(set(expected) - set(LISTS)):
                raise ValueError(f"expected has {strange[0]}")
            edit = ExpectedEdit(row["edit_id"], row["scene_id"], row["kind"], row["instruction"], expected, ambiguous)
            _check_lists(edit)
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}: line {number}: {error!r}, expected an edit with its lists", "edits_invalid") from error
        found.append(edit)
    return found


def _check_lists(edit: ExpectedEdit) -> None:
    """Refuses an instance in two lists, and a relation of an unknown kind."""
    named = [name for key in ("removed", "moved", "may_change", "kept") for name in edit.expected.get(key, ())]
    named += [entry["instance"] for key in ("replaced", "restyled") for entry in edit.expected.get(key, ())]
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise ValueError(f"{twice[0]} is in two lists")
    for key in ("relations", "broken"):
        for _, kind, _ in edit.expected.get(key, ()):
            RelationKind(kind)


def faults_of_edit(before: Scene, after: Scene, expected: Mapping[str, Sequence[Any]]) -> list[str]:
    """Returns what is wrong with an edited scene; nothing if it is as expected.

    Args:
        before: The scene before the edit.
        after: The scene after it, with its scene graph.
        expected: The lists of :data:`LISTS`.
    """
    was, now = ({o.instance: o for o in scene.objects} for scene in (before, after))
    faults = [f"{name} is still there" for name in expected.get("removed", ()) if name in now]
    for name in expected.get("moved", ()):
        if name not in now:
            faults.append(f"{name} is gone, expected to move")
        elif not _has_moved(was[name], now[name]):
            faults.append(f"{name} has not moved")
    restyled = {entry["instance"]: entry["words"] for entry in expected.get("restyled", ())}
    for name, words in restyled.items():
        faults += _style_faults(was[name], now.get(name), words)
    replaced = [entry["instance"] for entry in expected.get("replaced", ())]
    faults += [f"{name} is still there, expected to be replaced" for name in replaced if name in now]
    free = {*expected.get("removed", ()), *expected.get("moved", ()), *expected.get("may_change", ()), *restyled, *replaced}
    for name, o in was.items():
        if name not in free:
            faults += _change_faults(o, now.get(name))
    named, more = _new_objects(before, after, expected)
    return faults + more + _relation_faults(after, named, expected)


def _has_moved(was: SceneObject, now: SceneObject) -> bool:
    turn = abs(math.remainder(now.yaw - was.yaw, math.tau))
    return math.dist(was.position, now.position) > _MOVED or turn > _TURNED


def _change_faults(was: SceneObject, now: SceneObject | None) -> list[str]:
    """The faults of an object that must be kept."""
    if now is None:
        return [f"{was.instance} is gone, expected to stay"]
    if _has_moved(was, now):
        return [f"{was.instance} has moved by {100 * math.dist(was.position, now.position):.1f} cm, expected to stay"]
    if was.description != now.description:
        return [f"{was.instance} is now {now.description!r}, expected as it was"]
    return []


def _style_faults(was: SceneObject, now: SceneObject | None, words: str) -> list[str]:
    if now is None:
        return [f"{was.instance} is gone, expected {words}"]
    lacking = sorted(set(words.lower().split()) - set(now.description.lower().replace(",", " ").split()))
    return [f"{was.instance} is {now.description!r}, which lacks {lacking[0]}"] if lacking else []


def _new_objects(before: Scene, after: Scene, expected: Mapping[str, Sequence[Any]]) -> tuple[dict[str, str], list[str]]:
    """The instances of the expected new objects by their names, and what is wrong with the new objects."""
    was = {o.instance: o for o in before.objects}
    new = [o for o in after.objects if o.instance not in was]
    replaced = {entry["name"]: entry for entry in expected.get("replaced", ())}
    wanted = {entry["name"]: tuple(entry["categories"]) for key in ("added", "replaced") for entry in expected.get(key, ())}
    allowed = candidates([RequiredObject(name, categories) for name, categories in wanted.items()], new)
    for name, entry in replaced.items():
        old = was[entry["instance"]]
        reach = max(_AT_ITS_PLACE, max(old.size) / 2)
        near = {o.instance for o in new if math.dist(o.position[:2], old.position[:2]) <= reach}
        allowed[name] = {one: how for one, how in allowed[name].items() if one in near}
    found = dict(match(allowed).matches) if wanted else {}
    faults = [f"no new object is {name} ({' or '.join(wanted[name])})" for name in wanted if name not in found]
    faults += [f"{o.instance} is new, expected nothing" for o in new if o.instance not in found.values()]
    return found, faults


def _relation_faults(after: Scene, named: Mapping[str, str], expected: Mapping[str, Sequence[Any]]) -> list[str]:
    faults = []
    there = {o.instance for o in after.objects}
    for key, wanted in (("relations", True), ("broken", False)):
        for subject, kind, target in expected.get(key, ()):
            relation = Relation(named.get(subject, subject), RelationKind(kind), named.get(target, target))
            ends = {relation.subject} | ({relation.target} if relation.kind is not RelationKind.IS_AT else set())
            is_there = ends - {TABLE} <= there
            if (is_there and holds(after, relation)) != wanted:
                faults.append(f"{relation} {'does not hold' if wanted else 'still holds'}")
    return faults


def holds(scene: Scene, relation: Relation) -> bool:
    """Whether a relation between objects of a scene holds: on and in by its scene graph, directions and cells by positions.

    On the table is what stands on it directly; on or in an object is also what others there carry.
    """
    objects = {o.instance: o for o in scene.objects}
    if relation.kind in _ON_IN and relation.target == TABLE:
        return relation in scene.relations
    if relation.kind in _ON_IN:
        return is_held({r for r in scene.relations if r.kind in _ON_IN}, relation)
    if relation.kind is RelationKind.IS_AT:
        return cell_of(objects[relation.subject].position, scene.table.size_xy) == relation.target
    dx, dy, _ = np.subtract(objects[relation.subject].position, objects[relation.target].position)
    return direction_of(dx, dy) is relation.kind
