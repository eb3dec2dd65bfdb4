"""Samples tasks without a scene: a table and an instruction for objects that would fit on it.

A composition is drawn as for a scene of the embedded world and described as it was placed. Settling and checking take most of the
time of a scene and are left out, because a generator of scenes needs only the instruction and the table.
"""

from dataclasses import replace

import numpy as np

from stable_data.embedded_world.edit_table import lower_object
from stable_data.embedded_world.groups.arrangement import GroupSampler
from stable_data.embedded_world.placing import compose
from stable_data.embedded_world.scenes import FEWEST, MOST, draw_scene_number, draw_table, plan_of, scene_id_of, table_type_of
from stable_data.embedded_world.settling import instance_names
from stable_data.errors import SceneError
from stable_data.instructions.deriving import derive_task
from stable_data.scene import Scene, Tabletop
from stable_data.scene_graph.relations import relations_of, scene_graph, supports

_STREAM = 7  # makes the random stream differ from that of the scene with the same seed and number
_ATTEMPTS = 30


def sample_task(
    number: int, seed: int = 0, tables: tuple[str, ...] = (), draw: int = 0, table: Tabletop | None = None
) -> Scene:
    """Samples a task and its table.

    Args:
        number: Number of the task; kinds of table take turns as for scenes.
        seed: Seed of the set.
        tables: Kinds of table to use in turn; all kinds if empty.
        draw: Which of the tasks that may be drawn for this number.
        table: The table; None draws one of its kind. Compositions that are higher than its clearance are left out.

    Returns:
        The composition for which the task was made, with its relations and the task, the same for the same arguments; no composition
        of a scene is used again. Its objects rest on each other's boxes alone: it is no scene to be used.

    Raises:
        ConfigError: A kind of table is unknown (``unknown_table``).
        SceneError: No composition has enough objects (``synth_failed``).
    """
    table_type = table_type_of(number, tables)
    plan = plan_of(table_type)
    stream = (_STREAM, draw) if draw else (_STREAM,)
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, number, attempt, *stream])
        own = draw_table(table_type, plan, rng) if table is None else table
        placed = compose(plan, own, GroupSampler(rng), draw_scene_number(plan, own, rng), MOST)
        if own.clearance is not None:
            high = {obj.group for obj in placed if lower_object(obj).top > own.clearance}
            placed = [obj for obj in placed if obj.group not in high]
        if len(placed) < FEWEST:
            continue
        names = instance_names([obj.asset.category for obj in placed])
        objects = tuple(replace(lower_object(obj), instance=name) for name, obj in zip(names, placed, strict=True))
        scene = Scene(scene_id_of(number, tables), own, objects)
        containers = {name: obj.asset.hollow is not None for name, obj in zip(names, placed, strict=True)}
        carriers = supports(scene, {}, containers=containers)
        graph = scene_graph(scene, {name: (carrier,) for name, carrier in carriers.items() if carrier}, containers=containers)
        return replace(scene, task=derive_task(scene, graph, rng), relations=relations_of(graph))
    raise SceneError(f"task {number} of seed {seed}: no composition has {FEWEST} objects; use another seed", "synth_failed")
