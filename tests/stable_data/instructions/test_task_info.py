"""What instructions mean, and tasks made up where there are none."""

import json
from pathlib import Path
from typing import Any

import pytest

from stable_data.errors import ConfigError
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.instructions.task_info import model_task, resolve_task_objects
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo, Vec3
from stable_data.scene_graph.relations import SceneGraph, scene_graph
from stable_data.storage.table_rows import task_row

IN, ON = RelationKind.IN, RelationKind.ON


def thing(name: str, x: float, y: float, z: float = 0.0, size: Vec3 = (0.05, 0.05, 0.05)) -> SceneObject:
    """An object whose bottom is at z."""
    return SceneObject(name, name.split("_", 1)[1].rsplit("_", 1)[0], (x, y, z + size[2] / 2), 0.0, size, asset_id="a" * 32)


SCENE = Scene(
    "scene",
    Tabletop("kitchen_counter", (1.2, 0.6)),
    (
        thing("1_nesting_cup_0", 0.3, 0.3, size=(0.1, 0.1, 0.1)),
        thing("2_spice_jar_0", 0.3, 0.3, 0.01, (0.03, 0.03, 0.05)),
        thing("3_spice_jar_1", 0.1, 0.1),
        thing("4_sponge_0", 0.6, 0.3, size=(0.12, 0.12, 0.04)),
        thing("5_bun_0", 0.6, 0.3, 0.04, (0.06, 0.06, 0.04)),
        thing("6_mug_0", 0.9, 0.2, size=(0.08, 0.08, 0.08)),
        thing("7_plate_0", 0.9, 0.45, size=(0.2, 0.2, 0.02)),
        thing("8_dice_0", 0.8, 0.15, size=(0.02, 0.02, 0.02)),
    ),
)
GRAPH = scene_graph(SCENE, {}, containers={"1_nesting_cup_0": True, "6_mug_0": True})


def resolved(text: str, *cluster: str) -> tuple[TaskInfo, list[str]]:
    task, notices = resolve_task_objects(TaskInfo("", text, objects_cluster=cluster), SCENE, GRAPH)
    return task, [n.code for n in notices]


JAR_IN_CUP = Relation("2_spice_jar_0", IN, "1_nesting_cup_0")
BUN_ON_SPONGE = Relation("5_bun_0", ON, "4_sponge_0")


@pytest.mark.parametrize(
    ("text", "cluster", "said"),
    [
        ("Remove the spice jar from the nesting cup.", ("SpiceJar", "NestingCup"), {JAR_IN_CUP}),
        (
            "Take the spice jar out of the nesting cup and put it on the plate.",
            ("SpiceJar", "NestingCup", "Plate"),
            {JAR_IN_CUP},
        ),
        ("Pick up the spice jar in the nesting cup.", ("SpiceJar", "NestingCup"), {JAR_IN_CUP}),
        ("The spice jar is in the nesting cup; hand it over.", ("SpiceJar", "NestingCup"), {JAR_IN_CUP}),
        ("Lift the bun off the sponge.", ("Bun", "Sponge"), {BUN_ON_SPONGE}),
        ("Take the bun, which sits on the sponge, and place it in the mug.", ("Bun", "Sponge", "Mug"), {BUN_ON_SPONGE}),
        ("Clear the sponge by removing the bun from it.", ("Bun", "Sponge"), {BUN_ON_SPONGE}),
        ("Move the bun that is on the sponge to the left of the mug.", ("Bun", "Sponge", "Mug"), {BUN_ON_SPONGE}),
        ("Put the dice into the mug.", ("Dice", "Mug"), set()),
        ("Put the dice in the mug.", ("Dice", "Mug"), set()),
        ("Pick up the dice and place it in the mug.", ("Dice", "Mug"), set()),
        ("Pick up the mug and put the dice on the plate.", ("Mug", "Dice", "Plate"), set()),
        ("Collect the dice and the mug in the plate.", ("Dice", "Mug", "Plate"), set()),
        ("Stack the mug on top of the plate.", ("Mug", "Plate"), set()),
        ("Arrange things so that the mug is on the plate.", ("Mug", "Plate"), set()),
        ("Place the dice to the right of the mug.", ("Dice", "Mug"), set()),
        ("Hand me the dice left of the mug.", ("Dice", "Mug"), {Relation("8_dice_0", RelationKind.LEFT_OF, "6_mug_0")}),
    ],
)
def test_an_instruction_says_what_holds_at_the_start_and_not_what_shall_hold(
    text: str, cluster: tuple[str, ...], said: set[Relation]
) -> None:
    task, codes = resolved(text, *cluster)
    assert set(task.relations) == said
    assert codes == []


def test_words_choose_among_objects_of_a_type() -> None:
    assert resolved("Pick up the spice jar in the nesting cup.", "SpiceJar", "NestingCup")[0].task_objects == (
        "1_nesting_cup_0",
        "2_spice_jar_0",
    )
    assert resolved("Pick up the leftmost spice jar.", "SpiceJar") == (
        resolved("Pick up the leftmost spice jar.", "SpiceJar")[0],
        [],
    )
    assert resolved("Pick up the leftmost spice jar.", "SpiceJar")[0].task_objects == ("3_spice_jar_1",)
    assert resolved("Collect all spice jars.", "SpiceJar")[0].task_objects == ("2_spice_jar_0", "3_spice_jar_1")


def test_without_such_words_the_nearest_is_taken_and_noticed() -> None:
    task, codes = resolved("Put the spice jar into the mug.", "SpiceJar", "Mug")
    assert task.task_objects == ("2_spice_jar_0", "6_mug_0")
    assert codes == ["task_object_ambiguous"]


def test_a_type_that_no_object_has_is_noticed() -> None:
    task, codes = resolved("Put the banana into the mug.", "Banana", "Mug")
    assert (task.task_objects, codes) == (("6_mug_0",), ["task_object_missing"])


def test_a_statement_that_does_not_hold_is_kept_and_noticed() -> None:
    task, codes = resolved("Lift the dice off the plate.", "Dice", "Plate")
    assert task.relations == (Relation("8_dice_0", ON, "7_plate_0"),)
    assert codes == ["task_relation_not_held"]


def test_nothing_is_said_of_a_thing_and_itself() -> None:
    task, _ = resolved("The mug is in front of the mug. Turn it.", "Mug")
    assert task.relations == ()


def test_what_is_in_a_box_of_which_nobody_knows_that_it_holds_things_is_on_it() -> None:
    """Such as a mouse by its box in that of a pad with a wrist rest."""
    task, _ = resolve_task_objects(TaskInfo("", "Remove the spice jar from the nesting cup."), SCENE, scene_graph(SCENE, {}))
    assert task.relations == (Relation("2_spice_jar_0", ON, "1_nesting_cup_0"),)


def test_from_means_on_where_the_scene_does_not_decide() -> None:
    task, _ = resolved("Remove the dice from the mug.", "Dice", "Mug")
    assert task.relations == (Relation("8_dice_0", ON, "6_mug_0"),)


def test_types_come_from_actions_and_words_where_the_cluster_is_missing() -> None:
    task = TaskInfo("", "Do it.", action_sequence=("Pick(Dice)", "PlaceOn(Mug)", "PlaceAt(Table)"))
    assert resolve_task_objects(task, SCENE, GRAPH)[0].task_objects == ("6_mug_0", "8_dice_0")
    assert resolve_task_objects(TaskInfo("", "Put the dice into the mug."), SCENE, GRAPH)[0].task_objects == (
        "6_mug_0",
        "8_dice_0",
    )


def test_named_instances_stay_as_they_are() -> None:
    task = TaskInfo("", "Put the dice into the mug.", task_objects=("7_plate_0", "99_gone_0"))
    kept, notices = resolve_task_objects(task, SCENE, GRAPH)
    assert (kept, [n.code for n in notices]) == (task, ["task_object_missing"])


def test_recorded_task_objects_are_found(measured_data: Path) -> None:
    root = measured_data
    truths = json.loads((root / "truth.json").read_text())
    dataset = MesaTaskDataset(root)
    right = named = wanted = 0
    for scene_id, truth in truths.items():
        scene, _ = dataset.read(scene_id)
        if scene.task is None:
            continue
        containers = {o.instance: dataset.annotation(o.asset_id).is_container for o in scene.objects if o.asset_id}
        task, _ = resolve_task_objects(scene.task, scene, scene_graph(scene, {}, containers=containers))
        truth_objects = set(truth["task"]["instances"].values())
        right += len(truth_objects & set(task.task_objects))
        named, wanted = named + len(task.task_objects), wanted + len(truth_objects)
        assert bool(task.relations) == (truth["task"]["kind"] in ("take_out", "unstack", "transfer")), task
    assert (right / named, right / wanted) == (1.0, 1.0)


# --- a model's task infos ---


def content(task: TaskInfo) -> dict[str, Any]:
    return {
        "Environment": task.environment,
        "item_placement_zone": [0, 120, 0, 60],
        "Task": task.task,
        "Goal": list(task.goal),
        "Action Sequence": list(task.action_sequence),
        "Objects cluster": list(task.objects_cluster),
    }


PUT_IN = TaskInfo("A kitchen.", "Put the dice into the mug.", ("Done.",), ("Pick(Dice)", "PlaceOn(Mug)"), ("Dice", "Mug"))
ANSWER = content(PUT_IN)
BANANA = content(TaskInfo("A kitchen.", "Peel the banana.", objects_cluster=("Banana",)))


class Model:
    """Gives one answer and counts how often it was asked."""

    def __init__(self, answer: Any) -> None:
        self.answer, self.calls = answer, 0

    def __call__(self, scene: Scene, relations: tuple[Relation, ...]) -> Any:
        self.calls += 1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


NESTED: list[Any] = []
for _ in range(3000):
    NESTED = [NESTED]


def told(model: Model, folder: Path, graph: SceneGraph = GRAPH, writer_id: str = "") -> tuple[TaskInfo, list[str]]:
    task, notices = model_task(SCENE, graph, model, folder, writer_id)
    return task, [n.code for n in notices]


def test_a_good_answer_is_asked_for_once_and_kept(tmp_path: Path) -> None:
    model = Model(ANSWER)
    first, second = told(model, tmp_path / "cache"), told(model, tmp_path / "cache")
    assert first == second
    assert first[0].origin == "model"
    assert first[0].task_objects == ("6_mug_0", "8_dice_0")
    assert model.calls == 1
    assert [p.suffix for p in (tmp_path / "cache").iterdir()] == [".json"]


def test_a_rerun_gives_the_same_row_down_to_the_order_of_keys(tmp_path: Path) -> None:
    model = Model({**ANSWER, "steps": (1, 2), "Extra": True})
    first, again = (task_row(told(model, tmp_path)[0]) for _ in range(2))
    assert first == again


def test_another_scene_graph_or_another_model_is_asked_again(tmp_path: Path) -> None:
    model = Model(ANSWER)
    told(model, tmp_path)
    told(model, tmp_path, scene_graph(SCENE, {}, containers={"1_nesting_cup_0": False}))
    told(model, tmp_path, writer_id="other")
    assert model.calls == 3


@pytest.mark.parametrize(
    "answer",
    [
        {},
        {**ANSWER, "Goal": "Done."},
        BANANA,
        TimeoutError("no answer"),
        ValueError("not JSON"),
        None,
        "Done.",
        {**ANSWER, "Goal": {"Done."}},
        {**ANSWER, "item_placement_zone": [10**400, 0, 0, 1]},
        {**ANSWER, "item_placement_zone": [10**5000, 0, 0, 1]},
        {**ANSWER, "Task": "Lift the mug \ud800."},
        {**ANSWER, "Extra": {"more": ["\udfff"]}},
        {**ANSWER, "Extra": NESTED},
    ],
)
def test_an_answer_that_cannot_be_used_gives_a_templates_task_and_is_not_kept(tmp_path: Path, answer: Any) -> None:
    task, codes = told(Model(answer), tmp_path)
    assert (task, codes) == (derive_task(SCENE, GRAPH, task_rng(SCENE.scene_id)), ["task_model_failed"])
    assert list(tmp_path.iterdir()) == []


def test_an_answer_that_cannot_be_kept_ends_the_run(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for cache in (tmp_path / "file", tmp_path / "file" / "cache"):
        with pytest.raises(ConfigError, match="cannot be written") as caught:
            told(Model(ANSWER), cache)
        assert caught.value.code == "output_unwritable"


def test_a_kept_answer_that_was_damaged_is_asked_for_again(tmp_path: Path) -> None:
    told(Model(ANSWER), tmp_path)
    (kept,) = tmp_path.iterdir()
    kept.write_text(kept.read_text()[:20])
    model = Model(ANSWER)
    assert told(model, tmp_path)[1] == []
    assert model.calls == 1
