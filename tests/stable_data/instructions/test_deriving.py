"""Tasks made up for scenes."""

import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stable_data.errors import SceneError
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.instructions.naming import ObjectNamer, holds_relation, mentions
from stable_data.instructions.task_info import resolve_task_objects
from stable_data.instructions.wording.words import type_words
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Scene, TaskInfo
from stable_data.scene_graph.relations import SceneGraph, relations_of, scene_graph
from stable_data.task_info import validate_task_info
from tests.stable_data.instructions.tables import FORK, MUG, PEN, TABLES, Table, Thing, table


def derived(one: Table, seed: int) -> TaskInfo:
    return derive_task(one.scene, one.graph, np.random.default_rng(seed))


@pytest.mark.parametrize("one", TABLES, ids=lambda t: t.scene.scene_id)
def test_a_made_up_task_fits_its_scene(one: Table) -> None:
    for seed in range(40):
        task = derived(one, seed)
        assert task == derived(one, seed)
        assert task.origin == "template"
        assert not set("{}[]") & set(" ".join((task.task, *task.goal, *task.action_sequence)))
        assert task.task[0].isupper()
        assert task.task[-1] in ".?"
        assert set(task.task_objects) <= {o.instance for o in one.scene.objects}
        assert set(task.relations) <= set(relations_of(one.graph))
        cluster = Counter(type_words(t) for t in task.objects_cluster)
        assert cluster == Counter(type_words(one.namer.objects[n].category) for n in task.task_objects)
        assert {m.instance for m in mentions(task.task, one.namer)} <= set(task.task_objects)
        validate_task_info(
            {
                "Environment": task.environment,
                "Task": task.task,
                "Goal": list(task.goal),
                "Action Sequence": list(task.action_sequence),
                "Objects cluster": list(task.objects_cluster),
                "item_placement_zone": [0, 1, 0, 1],
            }
        )


def test_a_scene_gives_many_different_tasks() -> None:
    assert len({derived(TABLES[0], seed).task for seed in range(200)}) >= 190


def test_tasks_are_drawn_evenly_enough_for_rare_kinds() -> None:
    firsts = Counter(tuple(a.split("(")[0] for a in derived(TABLES[0], seed).action_sequence) for seed in range(400))
    assert len(firsts) >= 10
    assert max(firsts.values()) < 160


def test_one_object_that_floats_without_a_mesh_still_gets_a_task() -> None:
    one = table("lone", [Thing("lamp_0", 0.5, 0.3, (0.1, 0.1, 0.3), z=0.3)])
    lone = replace(one.scene, objects=tuple(replace(o, asset_id=None) for o in one.scene.objects))
    assert derive_task(lone, scene_graph(lone, {}), task_rng("lone")).task == "Pick up the lamp."


def test_objects_that_float_or_have_no_mesh_are_left_alone_where_there_are_others() -> None:
    one = table("three", [Thing("cup_0", 0.3, 0.3, MUG), Thing("fork_0", 0.5, 0.3, FORK, z=0.2), Thing("pen_0", 0.7, 0.3, PEN)])
    objects = tuple(replace(o, asset_id=None) if o.category == "pen" else o for o in one.scene.objects)
    scene = replace(one.scene, objects=objects)
    told = {derive_task(scene, one.graph, np.random.default_rng(k)).task_objects for k in range(30)}
    assert told == {("1_cup_0",)}


def test_objects_that_cannot_be_told_apart_still_get_a_task() -> None:
    one = table("pile", [Thing(f"cup_{k}", 0.5, 0.3, MUG, z=0.3) for k in range(3)])
    assert derived(one, 0).task == "Pick up one cup."


def test_an_empty_scene_has_no_task() -> None:
    empty = Scene("empty", TABLES[0].scene.table, ())
    with pytest.raises(SceneError, match="no objects"):
        derive_task(empty, scene_graph(empty, {}), task_rng("empty"))


def crowd(seed: int) -> Table:
    rng = np.random.default_rng(seed)
    kinds = ("mug", "plate", "apple", "pen", "bowl", "vase")
    spots = rng.uniform((0.05, 0.05), (1.35, 0.75), size=(30, 2)).tolist()
    return table(
        "coffee_table", [Thing(f"{rng.choice(kinds)}_{k}", x, y, (0.06, 0.07, 0.06)) for k, (x, y) in enumerate(spots)]
    )


def test_tasks_of_full_tables_are_true() -> None:
    for seed in range(40):
        one = crowd(seed)
        task = derived(one, seed)
        assert set(task.relations) <= set(relations_of(one.graph))
        assert {m.instance for m in mentions(task.task, one.namer)} <= set(task.task_objects), task.task


def test_a_full_table_takes_little_time() -> None:
    tables = [crowd(seed) for seed in range(6)]
    derived(tables[0], 0)  # fills the caches of the vocabulary
    start = time.process_time()
    for one in tables:
        for seed in range(5):
            derived(one, seed)
    assert (time.process_time() - start) / 30 < 0.02


# --- real scenes ---


def read(dataset: MesaTaskDataset, scene_id: str) -> tuple[Scene, SceneGraph]:
    scene, _ = dataset.read(scene_id)
    containers = {o.instance: dataset.annotation(o.asset_id).is_container for o in scene.objects if o.asset_id}
    return scene, scene_graph(scene, {}, containers=containers)


def test_made_up_tasks_are_true_and_are_understood(measured_data: Path) -> None:
    dataset = MesaTaskDataset(measured_data)
    same_objects = same_relations = num_tasks = 0
    for scene_id in dataset.scene_ids:
        scene, graph = read(dataset, scene_id)
        for seed in range(3):
            task = derive_task(scene, graph, task_rng(scene_id, seed))
            assert set(task.relations) <= set(relations_of(graph)), task.task
            assert {m.instance for m in mentions(task.task, ObjectNamer(scene, graph))} <= set(task.task_objects), task.task
            understood, _ = resolve_task_objects(replace(task, task_objects=(), relations=()), scene, graph)
            held = {holds_relation(graph, r.subject, r.kind, r.target) or r for r in understood.relations}
            same_objects += understood.task_objects == task.task_objects
            same_relations += held == set(task.relations)
            num_tasks += 1
    assert same_objects / num_tasks > 0.98
    assert same_relations / num_tasks > 0.97


def test_the_words_alone_mostly_tell_the_objects(measured_data: Path) -> None:
    dataset = MesaTaskDataset(measured_data)
    right = 0
    for scene_id in dataset.scene_ids:
        scene, graph = read(dataset, scene_id)
        task = derive_task(scene, graph, task_rng(scene_id, 9))
        bare = replace(task, task_objects=(), relations=(), objects_cluster=(), action_sequence=())
        right += resolve_task_objects(bare, scene, graph)[0].task_objects == task.task_objects
    assert right / len(dataset.scene_ids) > 0.9
