"""The benchmark of taste: statistics of scenes and distances whose values are known by calculation, and the command."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from benchmarks.taste import LEAST, POOLED, STATISTICS, SceneTaste, Statistic, Training, compare, compare_scenes, main
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop, Vec3
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_row

STORED = Path(__file__).parents[1] / "data" / "run_v3"
SIZES = Statistic("size", lambda _: [])
LABELS = Statistic("label", lambda _: [], is_label=True)
CUBE = (0.1, 0.1, 0.1)


def thing(name: str, x: float, y: float, size: Vec3 = CUBE, yaw: float = 0.0) -> SceneObject:
    return SceneObject(name, name.rpartition("_")[0], (x, y, size[2] / 2), math.radians(yaw), size)


def scene_of(*objects: SceneObject, relations: Sequence[tuple[str, RelationKind, str]] = (), kind: str = "desk") -> Scene:
    carried = [subject for subject, _, _ in relations]
    on_table = [(o.instance, RelationKind.ON, TABLE) for o in objects if o.instance not in carried]
    table = Tabletop(kind, (1.2, 0.6))
    return Scene("one", table, objects, relations=tuple(Relation(*r) for r in [*on_table, *relations]))


def values(name: str, scene: Scene, *training: Scene) -> list[float]:
    return list(STATISTICS[name].measure(SceneTaste(scene, Training(training))))


ON = RelationKind.ON
FLAT, KNIFE, THICK = (0.1, 0.1, 0.005), (0.2, 0.02, 0.005), (0.1, 0.1, 0.01)


@pytest.mark.parametrize(
    ("lower", "upper", "kind", "expected"),
    [(FLAT, FLAT, ON, 100), (FLAT, FLAT, None, 0), (FLAT, KNIFE, ON, 0), (FLAT, THICK, ON, 0), (THICK, FLAT, ON, 0)],
)
def test_a_mat_on_a_mat_is_found(lower: Vec3, upper: Vec3, kind: RelationKind | None, expected: float) -> None:
    relations = [("coaster_1", kind, "coaster_0")] if kind else []
    scene = scene_of(thing("coaster_0", 0.3, 0.3, lower), thing("coaster_1", 0.3, 0.3, upper), relations=relations)
    assert values("stacked_mats", scene) == [expected]


ROW = scene_of(thing("mug_0", 0.2, 0.3), thing("mug_1", 0.4, 0.3), thing("book_0", 0.9, 0.38, yaw=87.0))
PILE = scene_of(
    thing("tray_0", 0.3, 0.3, (0.3, 0.3, 0.05)), thing("cup_0", 0.3, 0.3), thing("cup_1", 0.25, 0.3), thing("box_0", 1.0, 0.1),
    relations=[("cup_0", RelationKind.IN, "tray_0"), ("cup_1", ON, "tray_0")],
)  # fmt: skip
SIZE_OF_TURNED = 0.1 * (math.cos(math.radians(3)) + math.sin(math.radians(3)))  # the side of the box around the turned cube
GAP_OF_TURNED = 0.9 - SIZE_OF_TURNED / 2 - 0.45  # its nearest corner is at the height of the other cube


@pytest.mark.parametrize(
    ("name", "scene", "expected"),
    [
        ("objects", ROW, [3]),
        ("repeats", ROW, [100 / 3]),
        ("most_of_one", ROW, [2]),
        ("covered", PILE, [100 * (0.09 + 0.01) / 0.72]),  # things on the tray cover nothing
        ("gap", ROW, [100 * (0.1 + 0.1 + GAP_OF_TURNED) / 3]),
        ("uneven_gaps", ROW, [np.std([0.1, 0.1, GAP_OF_TURNED]) / np.mean([0.1, 0.1, GAP_OF_TURNED])]),
        ("uneven_gaps", PILE, []),
        ("touching", ROW, [0]),
        ("touching", scene_of(thing("a_0", 0.3, 0.3), thing("a_1", 0.401, 0.3), thing("a_2", 0.6, 0.3)), [200 / 3]),
        ("on", PILE, [25]),
        ("in", PILE, [25]),
        ("on", ROW, [0]),
        ("yaw", ROW, [0, 0, 3]),
        ("yaw", scene_of(thing("a_0", 0.2, 0.3, yaw=-91.0), thing("a_1", 0.5, 0.3, yaw=135.0)), [1, 45]),
        ("straight", scene_of(thing("a_0", 0.2, 0.3, yaw=-91.0), thing("a_1", 0.5, 0.3, yaw=135.0)), [50]),
        ("in_line", ROW, [50]),  # the mugs; the book is near mug_1, 8 cm farther back
        ("edge", scene_of(thing("a_0", 0.3, 0.1), thing("a_1", 1.18, 0.3)), [5, -3]),
        ("cells", scene_of(thing("a_0", 0.1, 0.1), thing("a_1", 0.6, 0.5), thing("a_2", 9.0, 0.3)), [0, 7, 5]),
    ],
)  # fmt: skip
def test_statistics_have_their_calculated_values(name: str, scene: Scene, expected: list[float]) -> None:
    assert values(name, scene) == pytest.approx(expected, abs=1e-9)


def test_pairs_and_sizes_are_compared_with_training() -> None:
    training = scene_of(thing("mug_0", 0.2, 0.3), thing("book_0", 0.4, 0.3), thing("mug_1", 0.6, 0.3, (0.2, 0.2, 0.2)))
    scene = scene_of(thing("mug_0", 0.2, 0.3), thing("book_0", 0.6, 0.3), thing("toy_0", 0.9, 0.3))
    assert values("pairs_unseen", scene, training) == pytest.approx([200 / 3])  # only mug and book are together in training
    assert values("pairs_unseen", scene) == []  # without training it is unknown
    assert values("size", scene, training) == pytest.approx([-1.5 * math.log(2), 0])  # the mean mug has 8 ** 0.5 of its volume


def test_an_empty_table_has_no_values_but_counts() -> None:
    known = {name: values(name, scene_of(), ROW) for name in STATISTICS}
    assert {name: found for name, found in known.items() if found} == {
        "objects": [0], "most_of_one": [0], "covered": [0], "stacked_mats": [0],
    }  # fmt: skip


def each(*numbers: float) -> list[list[float]]:
    return [[n] for n in numbers]


def test_a_shift_is_its_length_in_standard_deviations() -> None:
    held_out = np.arange(40.0)
    found = compare(SIZES, each(*(held_out + 10)), each(*held_out))
    assert (found.generated, found.held_out) == (29.5, 19.5)
    assert found.distance == pytest.approx(10 / held_out.std())
    assert found.floor is not None
    assert 0 < found.floor < 0.5
    assert found.ratio == pytest.approx(10 / held_out.std() / found.floor)
    assert compare(SIZES, each(*held_out), each(*held_out)).distance == 0


def test_names_are_compared_by_total_variation() -> None:
    found = compare(LABELS, [[0.0, 0.0, 0.0, 8.0]] * LEAST, [[0.0, 8.0]] * LEAST)
    assert found.distance == pytest.approx(0.25)
    never = compare(LABELS, each(*[0.0] * 10, *[100.0] * 10), each(*[0.0] * 40))
    assert (never.distance, never.floor, never.ratio) == (0.5, 0, None)


def test_what_too_few_scenes_say_is_unknown() -> None:
    many, few = each(*range(2 * LEAST)), each(*range(LEAST - 1))
    for one, other in ((many, few), (few, many), ([*few, []], many)):  # a scene without a value does not count
        found = compare(SIZES, one, other)
        assert (found.distance, found.floor, found.ratio) == (None, None, None)
    halves = compare(SIZES, many, each(*range(2 * LEAST - 1)))
    assert halves.distance is not None
    assert (halves.floor, halves.ratio) == (None, None)
    assert compare(SIZES, [], many).generated is None


def test_equal_held_out_values_have_no_unit() -> None:
    equal = each(*[3.0] * 2 * LEAST)
    other = compare(SIZES, each(*[4.0] * 2 * LEAST), equal)
    assert (other.generated, other.held_out, other.distance, other.ratio) == (4, 3, None, None)
    assert compare(SIZES, equal, equal).distance == 0


def scenes(count: int, kind: str = "desk", scale: float = 1.0) -> list[Scene]:
    """Scenes of one to four mugs and a book of varied sizes at varied places."""
    rng = np.random.default_rng(7)
    found = []
    for k in range(count):
        names = [*(f"mug_{n}" for n in range(1 + k % 4)), "book_0"]
        sides = [scale * float(rng.uniform(0.02, 0.06)) for _ in names]
        places = [(0.15 + 0.2 * n + float(rng.uniform(0, 0.1)), float(rng.uniform(0.1, 0.5))) for n in range(len(names))]
        things = [thing(o, *p, (s, s, s), float(rng.uniform(0, 90))) for o, p, s in zip(names, places, sides, strict=True)]
        found.append(replace(scene_of(*things, kind=kind), scene_id=f"{kind}_{k}"))
    return found


def test_equal_scenes_have_no_distance_and_larger_things_only_that_of_size() -> None:
    data = scenes(40)
    equal = compare_scenes(data, data, Training(data))
    assert list(equal) == [POOLED, "desk"]
    assert all(c.distance == 0 for c in equal[POOLED].values())
    larger = compare_scenes(scenes(40, scale=1.3), data, Training(data))["desk"]
    spread = np.std([v for s in data for v in values("size", s, *data)])
    assert larger["size"].distance == pytest.approx(3 * math.log(1.3) / spread)
    assert larger["objects"].distance == larger["yaw"].distance == larger["cells"].distance == 0


def test_kinds_of_table_are_compared_alone() -> None:
    data = [*scenes(20, "desk"), *scenes(4, "shelf")]
    found = compare_scenes(data, data, Training(data))
    assert list(found) == [POOLED, "desk", "shelf"]
    assert found["desk"]["objects"].num_held_out == 20
    assert found["shelf"]["objects"].distance is None


def command(*arguments: object) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(main)
    done = CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "300"})
    return done.exit_code, done.output


def run_with(folder: Path, splits: dict[str, list[Scene]]) -> Path:
    """A run whose rows are those of a stored one, with other scenes."""
    row = RunFolder(STORED / "preprocess").table("scenes").to_pylist()[0]
    rows = [row | scene_row(s) | {"split": split} for split, found in splits.items() for s in found]
    RunFolder(folder).write_shard("scenes", "0", rows)
    return folder


def test_the_command_compares_two_runs(tmp_path: Path) -> None:
    data = scenes(30)
    held_out = run_with(tmp_path / "held_out", {"train": data[:10], "test": data[10:25], "validation": data[25:]})
    generated = run_with(tmp_path / "generated", {"test": data[10:25], "unseen": data[25:]})
    status, output = command(generated, held_out, "--json", tmp_path / "out.json")
    assert status == 0, output
    assert "20 generated scenes, 20 held-out ones (test,validation), 10 of training" in output
    document = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert document["scenes"] == {"generated": 20, "held_out": 20, "training": 10}
    assert {c["distance"] for c in document["tables"][POOLED].values()} == {0}
    status, output = command(held_out, held_out, "--split", "test", "--generated-split", "train")
    assert status == 0
    assert "10 generated scenes, 15 held-out ones (test)" in output
    assert command(held_out, held_out, "--split", "tset")[0] == 2
    assert "no scenes of the splits unseen" in command(held_out, held_out, "--split", "unseen")[1]


def test_two_scenes_are_unknown_and_are_drawn(tmp_path: Path) -> None:
    sheet = tmp_path / "sheet.png"
    status, output = command(STORED / "generate", STORED / "preprocess", "--split", "train", "--sheet", sheet)
    line = next(line for line in output.splitlines() if line.startswith("objects"))
    assert line.split()[3:] == ["unknown"] * 3
    if not sheet.exists():
        pytest.skip(output.splitlines()[-1])  # this machine cannot render
    assert status == 0
    with Image.open(sheet) as picture:
        assert picture.width > 6 * 384
        assert picture.height > 2 * 320
