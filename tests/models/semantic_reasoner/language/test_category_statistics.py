import json
from pathlib import Path

import numpy as np
import pytest

from models.semantic_reasoner.language.category_statistics import FILE, LEVELS, CategoryStatistics
from stable_data.errors import ConfigError
from stable_data.scene import Stage
from stable_data.storage.run_folder import RunFolder
from tests.models.semantic_reasoner.language.known_categories import SIZES_CM, STATISTICS, entry, row


def scene(name: str, *entries: dict[str, object]) -> list[dict[str, object]]:
    return [row(Stage.SECONDARY, name, "Move the mug.", entries)]


def test_sizes_are_quantiles_of_the_objects() -> None:
    mug = STATISTICS.categories["mug"]
    share = np.quantile(0.9 + 0.2 * np.arange(40) / 39, LEVELS)
    assert mug.count == 40
    np.testing.assert_allclose(mug.sizes, share[:, None] * np.array(SIZES_CM["mug"]) / 100, atol=1e-5)
    np.testing.assert_allclose(mug.extents, np.sort(mug.sizes, axis=1), atol=1e-5)
    assert mug.least == mug.extents[1]
    assert mug.most == mug.extents[-2]


def test_a_scene_with_many_tasks_is_measured_once() -> None:
    rows = scene("a", entry("mug", (0.1, 0.1, 0.1)))
    once, often = CategoryStatistics.of_rows(rows), CategoryStatistics.of_rows(rows * 5)
    assert once.categories == often.categories
    assert once.categories["mug"].count == 1


def test_what_carries_is_counted() -> None:
    tray, mug = entry("tray", (0.3, 0.2, 0.03), "tray_0"), entry("mug", (0.1, 0.1, 0.1), "mug_0", support="tray_0")
    rows = [*scene("a", tray, mug), *scene("b", entry("tray", (0.3, 0.2, 0.03), "tray_0"))]
    found = CategoryStatistics.of_rows(rows).categories
    assert found["tray"].carrying == 0.5
    assert found["mug"].carrying == 0


def test_words_are_counted_where_they_are_said() -> None:
    rows = [
        row(Stage.TASK, "a", "Move the mug to the plate.", []),
        *scene("a", entry("mug", (0.1, 0.1, 0.1), description="a red mug")),
    ]
    found = CategoryStatistics.of_rows(rows)
    assert found.words == {"move": 1, "the": 2, "mug": 1, "to": 1, "plate": 1}
    assert found.categories["mug"].words == {"a": 1, "red": 1, "mug": 1}


def test_categories_are_spelt_as_instances_are() -> None:
    found = CategoryStatistics.of_rows(scene("a", entry("Nesting Cups", (0.1, 0.1, 0.1))))
    assert set(found.categories) == {"nesting_cups"}


def test_saved_and_loaded_they_are_the_same(tmp_path: Path) -> None:
    STATISTICS.save(tmp_path / "model")
    assert CategoryStatistics.load(tmp_path / "model") == STATISTICS


def test_a_run_gives_the_statistics_of_its_split_train(tmp_path: Path) -> None:
    def whole(part: dict[str, object]) -> dict[str, object]:
        task = {
            "environment": "",
            "goal": [],
            "action_sequence": [],
            "objects_cluster": [],
            "task_objects": [],
            "relations": [],
        }
        told = {**task, "origin": "template", "source_json": None, "task": "Move the mug."}
        return {**part, "task": told}

    train = scene("a", entry("mug", (0.1, 0.1, 0.1)))
    other = [row(Stage.SECONDARY, "b", "", [entry("plate", (0.2, 0.2, 0.02))], split="test")]
    RunFolder(str(tmp_path)).write_shard("samples", "0", [whole(r) for r in (*train, *other)])
    assert CategoryStatistics.of_run(str(tmp_path)) == CategoryStatistics.of_rows(train)


def test_a_run_without_the_split_is_refused(tmp_path: Path) -> None:
    RunFolder(str(tmp_path)).write_shard("samples", "0", [])
    with pytest.raises(ConfigError, match="split train"):
        CategoryStatistics.of_run(str(tmp_path))


@pytest.mark.parametrize(
    ("content", "code"),
    [
        ("{", "statistics_invalid"),
        ("[]", "statistics_invalid"),
        ('{"version": 0}', "statistics_invalid"),
        (json.dumps({"version": 1, "levels": LEVELS}), "statistics_invalid"),
        (
            json.dumps({"version": 1, "levels": LEVELS, "categories": {"mug": {"count": 1}}, "words": {}, "doubts": {}}),
            "statistics_invalid",
        ),
        (None, "statistics_missing"),
    ],
)
def test_what_is_no_statistics_is_refused(tmp_path: Path, content: str | None, code: str) -> None:
    if content is not None:
        (tmp_path / FILE).write_text(content)
    with pytest.raises(ConfigError) as caught:
        CategoryStatistics.load(tmp_path)
    assert caught.value.code == code
    assert "\n" not in str(caught.value)
