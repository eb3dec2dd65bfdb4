"""Tasks from nowhere: a table, what would stand on it, and an instruction that makes sense there; the scene itself is thrown away.

A composition is drawn as for a scene of the embedded world, and told about as it was placed. Nothing is settled or judged,
which is what takes the time: a generator of scenes asks for nothing but the words and the table.
"""

from dataclasses import replace

import numpy as np

from stable_data.embedded_world.edit_table import lower_object
from stable_data.embedded_world.groups.arrangement import GroupSampler
from stable_data.embedded_world.placing import compose
from stable_data.embedded_world.scenes import FEWEST, MOST, draw_scene_number, draw_table, plan_of, scene_id_of, table_type_of
from stable_data.embedded_world.settling import instance_names
from stable_data.errors import SceneError
from stable_data.instructions import derive_task
from stable_data.scene import Scene, Tabletop
from stable_data.scene_graph.relations import scene_graph, supports

_STREAM = 7  # apart from those that scenes of the same seed and number are drawn from
_ATTEMPTS = 30


def sample_task(number: int, seed: int = 0, tables: tuple[str, ...] = ()) -> tuple[Tabletop, str]:
    """A table and an instruction.

    Args:
        number: Which task; kinds of table take turns as they do among scenes.
        seed: Which set.
        tables: Kinds of table to take in turn; all of them where empty.

    Returns:
        The same for the same arguments; no composition of the embedded world's scenes is used again.

    Raises:
        ConfigError: A kind of table is not known (``unknown_table``).
        SceneError: No composition had enough room (``synth_failed``).
    """
    table_type = table_type_of(number, tables)
    plan = plan_of(table_type)
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, number, attempt, _STREAM])
        table = draw_table(table_type, plan, rng)
        placed = compose(plan, table, GroupSampler(rng), draw_scene_number(plan, table, rng), MOST)
        if len(placed) < FEWEST:
            continue
        names = instance_names([thing.asset.category for thing in placed])
        objects = tuple(replace(lower_object(thing), instance=name) for name, thing in zip(names, placed, strict=True))
        scene = Scene(scene_id_of(number, tables), table, objects)
        containers = {name: thing.asset.hollow is not None for name, thing in zip(names, placed, strict=True)}
        carriers = supports(scene, {}, containers=containers)
        graph = scene_graph(scene, {name: (carrier,) for name, carrier in carriers.items() if carrier}, containers=containers)
        return table, derive_task(scene, graph, rng).task
    raise SceneError(f"task {number} of seed {seed}: no composition has {FEWEST} objects; use another seed", "synth_failed")
