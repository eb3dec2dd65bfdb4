"""Scenes of the embedded world: composed, settled, and kept once they are at rest and clean."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import networkx as nx
import numpy as np

from stable_data.embedded_world.groups.arrangement import GroupSampler
from stable_data.embedded_world.placing import PlacedObject, compose
from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES, TablePlan
from stable_data.embedded_world.settling import audit, settle_objects, unclean_objects, unsteady_objects
from stable_data.errors import ConfigError, SceneError
from stable_data.instructions import derive_task, task_rng
from stable_data.metrics.audit import Audit
from stable_data.scene import TABLE, RelationKind, Scene, Tabletop
from stable_data.scene_graph.relations import SceneGraph, scene_graph

FEWEST, MOST = 4, 30
"""Objects in a scene."""

RECORD = "synth"
"""Key of layout.json under which a scene says how it was made."""

_ATTEMPTS = 30
_MENDINGS = 5  # times that a composition may lose what does not stay or is not clean
_SPREAD = 0.4  # of the number of objects around a table's own mean, as a share of it
_SINK = (0.34, 0.66, 0.2, 0.84)  # of the table's width and depth
_UNSEEN_EVERY = 25  # one scene in so many stands on a kind of table that training never sees


@dataclass(frozen=True, slots=True, eq=False)
class EmbeddedScene:
    """A scene at rest and what it was made from.

    Attributes:
        scene: The scene, with a task info.
        placed: The things, in the order of its objects.
    """

    scene: Scene
    placed: tuple[PlacedObject, ...]


def plan_of(table_type: str) -> TablePlan:
    """The plan of a kind of table.

    Raises:
        ConfigError: There is no such kind (``unknown_table``).
    """
    plans = {**TABLES, **UNSEEN_TABLES}
    if table_type not in plans:
        raise ConfigError(f"table is {table_type!r}, expected one of {sorted(plans)}", "unknown_table")
    return plans[table_type]


def table_type_of(number: int, tables: Sequence[str] = ()) -> str:
    """Scenes take the kinds of table in turn, and one in 25 a kind that training never sees; or those asked for."""
    if tables:
        return tables[number % len(tables)]
    unseen = tuple(UNSEEN_TABLES)
    if number % _UNSEEN_EVERY == _UNSEEN_EVERY - 1:
        return unseen[number // _UNSEEN_EVERY % len(unseen)]
    return tuple(TABLES)[(number - number // _UNSEEN_EVERY) % len(TABLES)]


def scene_id_of(number: int, tables: Sequence[str] = ()) -> str:
    """The name of a scene's folder."""
    return f"{table_type_of(number, tables)}_{number:05d}"


def make_scene(number: int, seed: int = 0, tables: Sequence[str] = ()) -> EmbeddedScene:
    """Makes one scene.

    Groups are composed and settled. What falls over, does not stay or is not clean is taken away with its group, and the rest
    is settled again; where too little is left, another composition is drawn. The scene records both.

    Args:
        number: Which scene.
        seed: Which set.
        tables: Kinds of table to take in turn; all of them where empty.

    Returns:
        The scene, the same for the same arguments.

    Raises:
        ConfigError: A kind of table is not known (``unknown_table``).
        SceneError: No attempt came out (``synth_failed``); the message says what went wrong how often.
    """
    table_type = table_type_of(number, tables)
    plan, scene_id = plan_of(table_type), scene_id_of(number, tables)
    rejected: Counter[str] = Counter()
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, number, attempt])
        table = draw_table(table_type, plan, rng)
        placed = compose(plan, table, GroupSampler(rng), draw_scene_number(plan, table, rng), MOST)
        made = _mended(scene_id, table, placed, rejected)
        if made is None:
            rejected["too little left"] += 1
            continue
        record = {"seed": seed, "number": number, "attempt": attempt, "rejected": dict(sorted(rejected.items()))}
        return _finished(*made, record)
    raise SceneError(
        f"{scene_id}: none of {_ATTEMPTS} compositions came to rest clean ({dict(rejected)}), expected one; use another seed",
        "synth_failed",
    )


def _mended(
    scene_id: str, table: Tabletop, placed: Sequence[PlacedObject], rejected: Counter[str]
) -> tuple[Scene, Audit, Sequence[PlacedObject]] | None:
    """A composition without the groups that do not stay or are not clean; None where too little is left of it."""
    for _ in range(_MENDINGS):
        if len(placed) < FEWEST:
            return None
        settled = settle_objects(placed, table)
        if settled is None:
            rejected["blew up"] += 1
            return None
        objects, bad = settled
        reason = "fell over or strayed"
        if not bad:
            scene = Scene(scene_id, table, objects)
            judged = audit(scene, placed)
            bad, reason = unclean_objects(judged), "not clean"
        if not bad:
            bad, reason = unsteady_objects(scene, placed), "not at rest"
        if not bad:
            return scene, judged, placed
        groups = {placed[k].group for k in bad}
        rejected[reason] += len(groups)
        placed = [thing for thing in placed if thing.group not in groups]
    return None


def draw_scene_number(plan: TablePlan, table: Tabletop, rng: np.random.Generator) -> int:
    """How many things are to be put on a table."""
    mean = plan.density * _free_area(table)
    return int(np.clip(round(mean * rng.lognormal(0.0, _SPREAD)), FEWEST + 1, MOST - 2))


def draw_table(table_type: str, plan: TablePlan, rng: np.random.Generator) -> Tabletop:
    """A table of a kind."""
    width, depth = (round(float(rng.uniform(*bounds)), 3) for bounds in (plan.width, plan.depth))
    if not plan.has_sink:
        return Tabletop(table_type, (width, depth))
    x_min, x_max, y_min, y_max = (
        round(share * side, 3) for share, side in zip(_SINK, (width, width, depth, depth), strict=True)
    )
    return Tabletop(table_type, (width, depth), (x_min, x_max, y_min, y_max))


def _free_area(table: Tabletop) -> float:
    """Square metres."""
    zone = table.restricted_zone
    taken = 0.0 if zone is None else (zone[1] - zone[0]) * (zone[3] - zone[2])
    return table.size_xy[0] * table.size_xy[1] - taken


def graph_of(scene: Scene, judged: Audit, placed: Sequence[PlacedObject]) -> SceneGraph:
    """The scene graph of a judged scene."""
    contacts = {o.instance: o.supports for o in judged.objects}
    containers = {o.instance: thing.asset.hollow is not None for o, thing in zip(scene.objects, placed, strict=True)}
    return scene_graph(scene, contacts, containers=containers)


def _finished(scene: Scene, judged: Audit, placed: Sequence[PlacedObject], record: dict[str, Any]) -> EmbeddedScene:
    """The scene with a task that makes sense in it, by pattern, and with the record of how it was made."""
    graph = graph_of(scene, judged, placed)
    kinds = Counter(kind for _, target, kind in graph.edges(keys=True) if target != TABLE)
    record["keys"] = [thing.item.key for thing in placed]
    nested = {"stacked": kinds[RelationKind.ON], "contained": kinds[RelationKind.IN], "depth": _depth(graph)}
    task = derive_task(scene, graph, task_rng(scene.scene_id))
    return EmbeddedScene(replace(scene, task=task, source={RECORD: record | nested}), tuple(placed))


def _depth(graph: SceneGraph) -> int:
    """Longest chain of things in or on things: 1 for what stands on the table alone."""
    kept = [(a, b) for a, b, kind in graph.edges(keys=True) if kind in (RelationKind.ON, RelationKind.IN)]
    return int(nx.dag_longest_path_length(nx.DiGraph(kept)))
