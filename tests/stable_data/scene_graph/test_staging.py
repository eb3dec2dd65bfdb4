"""The partition into three stages and the sub-layouts."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import SceneError
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import TABLE, Scene, SceneObject, Stage, Tabletop, TaskInfo, Vec3
from stable_data.scene_graph.relations import scene_graph, supports
from stable_data.scene_graph.stage_samples import samples_of
from stable_data.scene_graph.staging import box_distance, stage_scene

TABLETOP = Tabletop("office_table", (1.2, 0.6))


def box(
    name: str, position: Vec3, size: Vec3 = (0.1, 0.1, 0.1), *, support: str | None = TABLE, yaw: float = 0.0
) -> SceneObject:
    return SceneObject(name, "box", position, yaw, size, support=support)


def scene_of(task_objects: tuple[str, ...], *objects: SceneObject) -> Scene:
    return Scene("scene", TABLETOP, objects, TaskInfo("", "Do it.", task_objects=task_objects))


def stages(scene: Scene, threshold: float = 0.02) -> dict[str, Stage | None]:
    return {o.instance: o.stage for o in stage_scene(scene, threshold).objects}


@pytest.mark.parametrize(
    ("position", "yaw", "distance"),
    [
        ((0.3, 0.0, 0.0), 0.0, 0.2),
        ((0.3, 0.4, 0.0), 0.0, math.hypot(0.2, 0.3)),
        ((0.3, 0.0, 0.3), 0.0, math.hypot(0.2, 0.2)),
        ((0.0, 0.0, 0.4), 1.0, 0.3),
        ((0.3, 0.0, 0.0), math.pi / 4, 0.25 - 0.05 * math.sqrt(2)),
        ((0.05, 0.05, 0.05), 0.3, 0.0),
    ],
)
def test_box_distance_is_that_of_turned_boxes(position: Vec3, yaw: float, distance: float) -> None:
    one, other = box("a", (0.0, 0.0, 0.0)), box("b", position, yaw=yaw)
    assert box_distance(one, other) == pytest.approx(distance, abs=1e-9)
    assert box_distance(other, one) == pytest.approx(distance, abs=1e-9)


def test_near_objects_are_important_and_far_ones_secondary() -> None:
    cup, near, far = box("cup", (0.3, 0.3, 0.05)), box("near", (0.415, 0.3, 0.05)), box("far", (0.43, 0.3, 0.05))
    scene = scene_of(("cup",), far, near, cup)
    assert stages(scene) == {"far": Stage.SECONDARY, "near": Stage.IMPORTANT, "cup": Stage.TASK}
    assert stages(scene, threshold=0.05)["far"] is Stage.IMPORTANT


def test_what_carries_a_task_object_comes_with_it_and_its_neighbours_do_not() -> None:
    scene = scene_of(
        ("apple",),
        box("apple", (0.3, 0.3, 0.14), (0.06, 0.06, 0.06), support="bowl"),
        box("bowl", (0.3, 0.3, 0.06), (0.3, 0.1, 0.1), support="tray"),
        box("tray", (0.3, 0.3, 0.005), (0.5, 0.3, 0.01)),
        box("fork", (0.5, 0.3, 0.015), (0.02, 0.1, 0.01), support="tray"),
    )
    assert stages(scene) == {"apple": Stage.TASK, "bowl": Stage.TASK, "tray": Stage.TASK, "fork": Stage.SECONDARY}


def test_samples_grow_by_a_stage_each_large_before_small() -> None:
    scene = scene_of(
        ("cup",),
        box("small", (0.9, 0.3, 0.05), (0.05, 0.05, 0.1)),
        box("cup", (0.3, 0.3, 0.05)),
        box("large", (0.7, 0.3, 0.05), (0.2, 0.2, 0.1)),
    )
    task, important, secondary = samples_of(stage_scene(scene))
    assert [o.instance for o in task.objects_out] == ["cup"]
    assert important.objects_out == ()
    assert [o.instance for o in secondary.objects_out] == ["large", "small"]
    assert secondary.objects_in == task.layout == important.layout


def test_a_large_board_on_a_small_stand_comes_after_it() -> None:
    stand = box("stand", (0.3, 0.3, 0.05), (0.05, 0.05, 0.1))
    board = box("board", (0.3, 0.3, 0.11), (0.4, 0.4, 0.02), support="stand")
    out = samples_of(stage_scene(scene_of(("board",), board, stand)))[0].objects_out
    assert [o.instance for o in out] == ["stand", "board"]


def test_what_cannot_be_staged_says_why() -> None:
    with pytest.raises(SceneError, match="no task"):
        stage_scene(Scene("scene", TABLETOP, ()))
    with pytest.raises(SceneError, match="have no stage"):
        samples_of(scene_of((), box("a", (0.1, 0.1, 0.05))))
    cycle = scene_of((), box("a", (0.1, 0.1, 0.05), support="b"), box("b", (0.1, 0.1, 0.1), support="a"))
    with pytest.raises(SceneError, match="cycle"):
        stage_scene(cycle)
    staged = replace(cycle, objects=tuple(replace(o, stage=Stage.TASK) for o in cycle.objects))
    with pytest.raises(SceneError, match="cycle"):
        samples_of(staged)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Objects anywhere, each carried by an earlier one, the table, something absent or nothing."""
    objects: list[SceneObject] = []
    for k in range(draw(st.integers(0, 9))):
        carriers = [TABLE, None, "absent", *(o.instance for o in objects)]
        place = tuple(draw(st.floats(0, 0.6)) for _ in range(3))
        size = tuple(draw(st.floats(0.01, 0.3)) for _ in range(3))
        objects.append(
            box(str(k), place, size, support=draw(st.sampled_from(carriers)), yaw=draw(st.floats(-4, 4)))  # type: ignore[arg-type]
        )
    names = [o.instance for o in objects]
    chosen = draw(st.lists(st.sampled_from([*names, "gone"]), unique=True, max_size=4))
    return scene_of(tuple(chosen), *draw(st.permutations(objects)))


@settings(max_examples=80, deadline=None)
@given(scenes())
def test_stages_are_a_partition_whose_prefixes_stand_by_themselves(scene: Scene) -> None:
    staged = stage_scene(scene)
    samples = samples_of(staged)
    assert [s.stage for s in samples] == list(Stage)
    out = [o for s in samples for o in s.objects_out]
    assert sorted(o.instance for o in out) == sorted(o.instance for o in scene.objects)
    assert all(o.stage is s.stage for s in samples for o in s.objects_out)
    names = {o.instance for o in scene.objects}
    seen: set[str] = set()
    for o in out:  # in the order of generation nothing comes before what carries it
        assert o.support not in names or o.support in seen
        seen.add(o.instance)
    for earlier, later in itertools.pairwise(samples):
        assert later.objects_in == earlier.layout
    assert [replace(o, stage=None) for o in staged.objects] == list(scene.objects)


@settings(max_examples=40, deadline=None)
@given(scenes())
def test_named_objects_are_task_objects_and_near_ones_are_not_secondary(scene: Scene) -> None:
    staged = stage_scene(scene)
    assert scene.task is not None
    named = [o for o in staged.objects if o.instance in scene.task.task_objects]
    assert all(o.stage is Stage.TASK for o in named)
    near = [o for o in staged.objects if any(box_distance(o, n) <= 0.02 for n in named)]
    assert all(o.stage is not Stage.SECONDARY for o in near)


def test_every_real_scene_is_staged(real_data: Path) -> None:
    dataset = MesaTaskDataset(real_data)
    for scene_id in dataset.scene_ids:
        scene, _ = dataset.read(scene_id)
        carriers, graph = supports(scene, {}), scene_graph(scene, {})
        objects = tuple(replace(o, support=carriers[o.instance]) for o in scene.objects)
        task = derive_task(scene, graph, task_rng(scene_id))
        staged = stage_scene(replace(scene, objects=objects, task=task))
        assert samples_of(staged)[0].objects_out
        assert all(o.stage is not None for o in staged.objects)
