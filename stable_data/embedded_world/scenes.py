"""Scenes of the embedded world: composed, settled and accepted when they are at rest and clean."""

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
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.metrics.verdicts import Audit
from stable_data.scene import TABLE, RelationKind, Scene, Tabletop
from stable_data.scene_graph.relations import SceneGraph, scene_graph

FEWEST, MOST = 4, 30
"""Fewest and most objects of a scene."""

RECORD = "synth"
"""Key of layout.json under which a scene records how it was made."""

_ATTEMPTS = 30
_MAX_REMOVALS = 5  # rounds in which failed groups may be removed from a composition
_SPREAD = 0.4  # standard deviation of the logarithm of the number of objects
_SINK = (0.34, 0.66, 0.2, 0.84)  # x_min, x_max, y_min, y_max of a sink, shares of the width and depth of the table
_UNSEEN_EVERY = 25  # every 25th scene stands on a kind of table that training never sees


@dataclass(frozen=True, slots=True, eq=False)
class EmbeddedScene:
    """A scene at rest with its placed objects.

    Attributes:
        scene: The scene, with a task info.
        placed: The placed objects, in the order of the scene's objects.
    """

    scene: Scene
    placed: tuple[PlacedObject, ...]


def plan_of(table_type: str) -> TablePlan:
    """Returns the plan of a kind of table.

    Raises:
        ConfigError: The kind is unknown (``unknown_table``).
    """
    plans = {**TABLES, **UNSEEN_TABLES}
    if table_type not in plans:
        raise ConfigError(f"table is {table_type!r}, expected one of {sorted(plans)}", "unknown_table")
    return plans[table_type]


def table_type_of(number: int, tables: Sequence[str] = ()) -> str:
    """The kind of table of a scene: the given kinds in turn, or all kinds, with every 25th scene on a kind that training never sees."""
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

    Groups are composed and settled. A group with an object that falls over, moves or is not clean is removed, and the rest is
    settled again. If too few objects remain, another composition is drawn. The scene records the numbers of both.

    Args:
        number: Number of the scene.
        seed: Seed of the set.
        tables: Kinds of table to use in turn; all kinds if empty.

    Returns:
        The scene, the same for the same arguments.

    Raises:
        ConfigError: A kind of table is unknown (``unknown_table``).
        SceneError: No attempt succeeded (``synth_failed``); the message counts the reasons.
    """
    table_type = table_type_of(number, tables)
    plan, scene_id = plan_of(table_type), scene_id_of(number, tables)
    rejected: Counter[str] = Counter()
    for attempt in range(_ATTEMPTS):
        # A stream per attempt: a scene does not depend on the draws of earlier attempts.
        rng = np.random.default_rng([seed, number, attempt])
        table = draw_table(table_type, plan, rng)
        placed = compose(plan, table, GroupSampler(rng), draw_scene_number(plan, table, rng), MOST)
        made = _remove_failed_groups(scene_id, table, placed, rejected)
        if made is None:
            rejected["too little left"] += 1
            continue
        record = {"seed": seed, "number": number, "attempt": attempt, "rejected": dict(sorted(rejected.items()))}
        return _with_task(*made, record)
    raise SceneError(
        f"{scene_id}: none of {_ATTEMPTS} compositions came to rest clean ({dict(rejected)}), expected one; use another seed",
        "synth_failed",
    )


def _remove_failed_groups(
    scene_id: str, table: Tabletop, placed: Sequence[PlacedObject], rejected: Counter[str]
) -> tuple[Scene, Audit, Sequence[PlacedObject]] | None:
    """Removes the groups of a composition that move or are not clean; None if too few objects remain."""
    for _ in range(_MAX_REMOVALS):
        if len(placed) < FEWEST:
            return None
        settled = settle_objects(placed, table)
        if settled is None:
            rejected["blew up"] += 1
            return None
        objects, bad = settled
        # Each check runs only if the previous ones find nothing.
        reason = "fell over or strayed"
        if not bad:
            scene = Scene(scene_id, table, objects)
            scene_audit = audit(scene, placed)
            bad, reason = unclean_objects(scene_audit), "not clean"
        if not bad:
            bad, reason = unsteady_objects(scene, placed), "not at rest"
        if not bad:
            return scene, scene_audit, placed
        # A group without one of its objects is incomplete, so all of it is removed.
        groups = {placed[k].group for k in bad}
        rejected[reason] += len(groups)
        placed = [obj for obj in placed if obj.group not in groups]
    return None


def draw_scene_number(plan: TablePlan, table: Tabletop, rng: np.random.Generator) -> int:
    """Draws the number of objects for a table."""
    mean = plan.density * _free_area(table)
    return int(np.clip(round(mean * rng.lognormal(0.0, _SPREAD)), FEWEST + 1, MOST - 2))


def draw_table(table_type: str, plan: TablePlan, rng: np.random.Generator) -> Tabletop:
    """Draws a table of a kind."""
    width, depth = (round(float(rng.uniform(*bounds)), 3) for bounds in (plan.width, plan.depth))
    if not plan.has_sink:
        return Tabletop(table_type, (width, depth))
    x_min, x_max, y_min, y_max = (
        round(share * side, 3) for share, side in zip(_SINK, (width, width, depth, depth), strict=True)
    )
    return Tabletop(table_type, (width, depth), (x_min, x_max, y_min, y_max))


def _free_area(table: Tabletop) -> float:
    """The area outside the restricted zone, square metres."""
    zone = table.restricted_zone
    taken = 0.0 if zone is None else (zone[1] - zone[0]) * (zone[3] - zone[2])
    return table.size_xy[0] * table.size_xy[1] - taken


def graph_of(scene: Scene, scene_audit: Audit, placed: Sequence[PlacedObject]) -> SceneGraph:
    """The scene graph of an audited scene."""
    contacts = {o.instance: o.supports for o in scene_audit.objects}
    containers = {o.instance: obj.asset.hollow is not None for o, obj in zip(scene.objects, placed, strict=True)}
    return scene_graph(scene, contacts, containers=containers)


def _with_task(scene: Scene, scene_audit: Audit, placed: Sequence[PlacedObject], record: dict[str, Any]) -> EmbeddedScene:
    """Adds a derived task and the record of how the scene was made."""
    graph = graph_of(scene, scene_audit, placed)
    kinds = Counter(kind for _, target, kind in graph.edges(keys=True) if target != TABLE)
    record["keys"] = [obj.item.key for obj in placed]
    nested = {"stacked": kinds[RelationKind.ON], "contained": kinds[RelationKind.IN], "depth": _depth(graph)}
    task = derive_task(scene, graph, task_rng(scene.scene_id))
    return EmbeddedScene(replace(scene, task=task, source={RECORD: record | nested}), tuple(placed))


def _depth(graph: SceneGraph) -> int:
    """Length of the longest support chain: 1 for an object that stands on the table."""
    links = [(a, b) for a, b, kind in graph.edges(keys=True) if kind in (RelationKind.ON, RelationKind.IN)]
    return int(nx.dag_longest_path_length(nx.DiGraph(links)))
