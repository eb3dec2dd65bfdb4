"""The comparison of sets: known numbers, near-duplicates across splits and runs, and groups that share a split."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.diversity.comparison import Coverage, compare_sets, effective_number
from stable_data.diversity.scene_set import ComparedScene, SceneSet
from stable_data.errors import ConfigError
from stable_data.metrics.card import MetricCard
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import card_row, scene_row

CARD = MetricCard(2, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True)
KINDS = ("cup", "plate", "pen", "book", "lamp")


def scene(name: str, number: int, shift: float = 0.0) -> Scene:
    """Scenes of different numbers are no near-duplicates."""
    made = tuple(
        SceneObject(f"{k}_cup_0", KINDS[(k * number) % 5], (0.1 + 0.2 * k + shift, 0.05 + 0.05 * number, 0.05), 0.0, (0.1, 0.1, 0.1),
                    asset_id=f"asset{number}")
        for k in range(4)
    )  # fmt: skip
    return Scene(name, Tabletop("office_table", (1.2, 0.6)), made)


def compared(name: str, scenes: Sequence[Scene], splits: Sequence[str] = ()) -> SceneSet:
    given = splits or ["train"] * len(scenes)
    return SceneSet(name, tuple(ComparedScene.of(s, split) for s, split in zip(scenes, given, strict=True)), len(scenes))


def written(folder: Path, scenes: Sequence[Scene]) -> str:
    run = RunFolder(str(folder))
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"source": "test", "pairs": [], "verdicts": []} | card_row(CARD)
    for number in range(0, len(scenes), 3):
        run.write_shard(
            "scenes", f"{number:016x}", [blank | scene_row(s) | {"split": "train"} for s in scenes[number : number + 3]]
        )
    return run.uri


@given(st.integers(1, 12), st.integers(1, 9))
def test_equally_frequent_kinds_count_as_many(kinds: int, each: int) -> None:
    assert effective_number([each] * kinds + [0]) == pytest.approx(kinds)


def test_an_effective_number_is_one_where_all_are_equal_and_zero_without_any() -> None:
    assert effective_number([5]) == 1.0
    assert effective_number([]) == effective_number([0]) == 0.0


def test_coverage_counts_what_the_library_has() -> None:
    scenes = compared("run", [scene("a", 1), scene("b", 2), scene("c", 7)])
    library = {f"asset{k}": f"kind{k // 2}" for k in range(6)} | {"nameless": ""}  # asset7 is of another library
    [known], [unknown], [none] = (compare_sets([replace(scenes, library=one)]).sets for one in (library, None, {}))
    assert known.coverage == Coverage(2, 7, 2, 3)
    said = [
        [line.split("used")[1].strip() for line in one.lines() if "of the library" in line] for one in (known, unknown, none)
    ]
    assert said == [["2 of 7 (28.6 %)", "2 of 3 (66.7 %)"], ["unknown", "unknown"], ["unknown", "unknown"]]
    assert unknown.coverage is None


def test_the_command_knows_the_library_of_a_run_with_all_assets(tmp_path: Path) -> None:
    run = RunFolder(written(tmp_path, [scene("a", 1), scene("b", 2)]))
    blank = dict.fromkeys(SCHEMAS["assets"].names) | {"extents": [0.1, 0.1, 0.1], "resting_tilts": [], "description": "a thing"}
    rows = [blank | {"asset_id": f"asset{k}", "category": f"kind{k}", "on_table": k < 4} for k in range(6)]
    run.write_shard("assets", "0" * 16, rows)

    def coverage(settings: dict[str, object]) -> object:
        (tmp_path / "manifest.json").write_text(json.dumps({"settings": settings}))
        figures = tmp_path.with_suffix(".json")
        done = CliRunner().invoke(app, ["diversity", str(tmp_path), "--json", str(figures)])
        assert done.exit_code == 0, done.output
        return json.loads(figures.read_text())["sets"][0]["coverage"]

    assert coverage({"all_assets": True}) == {"assets": 2, "of_assets": 4, "categories": 2, "of_categories": 4}
    assert coverage({"all_assets": False}) == coverage({}) is None


def test_a_set_of_equal_layouts_has_one_and_one_of_unlike_layouts_has_all() -> None:
    one = scene("a", 1)
    alike, unlike = compared("alike", [one] * 4), compared("unlike", [
        replace(one, objects=tuple(replace(o, category=f"{o.category}{k}") for o in one.objects)) for k in range(4)
    ])  # fmt: skip
    first, second = compare_sets([alike, unlike]).sets
    assert (first.layouts, first.contents) == pytest.approx((1.0, 1.0))
    assert (second.layouts, second.contents) == pytest.approx((4.0, 4.0))
    assert (first.duplicates, first.largest_group, second.duplicates, second.largest_group) == (4, 4, 0, 1)


def test_near_duplicates_in_other_splits_and_other_runs_are_counted_apart() -> None:
    first = compared(
        "first", [scene("a", 1), scene("b", 1, 0.01), scene("c", 2), scene("d", 3)], ["train", "test", "train", "test"]
    )
    second = compared("second", [scene("e", 2, 0.005), scene("f", 4)])
    found = compare_sets([first, second])
    assert [(s.duplicates, s.across_splits, s.largest_group) for s in found.sets] == [(2, 2, 2), (0, 0, 1)]
    [overlap] = found.overlaps
    assert (overlap.first_scenes, overlap.second_scenes, overlap.assets) == (1, 1, 1)
    groups = {row["scene_id"]: row for row in found.groups}
    assert groups["a"]["group"] == groups["b"]["group"] != groups["c"]["group"] == groups["e"]["group"]
    assert [groups[name]["group_size"] for name in "abcdef"] == [2, 2, 2, 1, 2, 1]


def test_a_split_that_is_not_known_is_no_other_split() -> None:
    twins = [scene("a", 1), scene("b", 1, 0.01), scene("c", 1, 0.005)]
    without = SceneSet("without", tuple(ComparedScene.of(s) for s in twins), 3)
    [found] = compare_sets([without]).sets
    assert (found.duplicates, found.across_splits) == (3, None)
    assert "another split" not in "\n".join(found.lines())
    partly = SceneSet("partly", (ComparedScene.of(twins[0], "train"), *without.scenes[1:]), 3)
    assert compare_sets([partly]).sets[0].across_splits == 0


def test_groups_have_the_same_names_wherever_their_runs_are() -> None:
    scenes = [scene("a", 1), scene("b", 1, 0.01), scene("c", 2)]
    names = [[row["group"] for row in compare_sets([compared(run, scenes)]).groups] for run in ("here", "there")]
    assert names[0] == names[1]
    other = [replace(scenes[0], scene_id="c"), scenes[2]]  # two different scenes with one id
    assert len({row["group"] for row in compare_sets([compared("x", other[:1]), compared("y", other[1:])]).groups}) == 2


def test_scores_of_sets_are_compared_at_one_size() -> None:
    many = compared("many", [scene(f"s{k}", k) for k in range(1, 9)])
    few = compared("few", [scene(f"t{k}", k) for k in range(1, 4)])
    found = compare_sets([many, few]).sets
    assert [s.sample for s in found] == [3, 3]
    assert found[0].layouts is not None
    assert 1.0 <= found[0].layouts <= 3.0 + 1e-9
    again = compare_sets([many, few]).sets[0]
    assert again.layouts == found[0].layouts


def test_an_empty_set_has_unknown_scores() -> None:
    found = compare_sets([compared("empty", []), compared("one", [scene("a", 1)])])
    assert found.sets[0].layouts is None
    assert "unknown" in str(found)
    assert math.isclose(found.sets[1].layouts or 0.0, 1.0)


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(ConfigError, match="sample is 0"):
        compare_sets([compared("one", [scene("a", 1)])], sample=0)


def test_the_command_reads_runs_and_writes_groups_and_figures(tmp_path: Path) -> None:
    scenes = [scene(f"s{k}", k) for k in range(1, 9)]
    one = written(tmp_path / "one", scenes)
    other = written(tmp_path / "other", [scene("twin", 2, 0.01), scene("alone", 9)])
    files = [tmp_path / "out" / "groups.parquet", tmp_path / "out" / "figures.json"]
    done = CliRunner().invoke(app, ["diversity", one, other, "--table", str(files[0]), "--json", str(files[1])])
    assert done.exit_code == 0, done.output
    assert f"{one}: 8 scenes" in done.output
    groups = pl.read_parquet(files[0])
    assert groups.height == 10
    twins = groups.filter(pl.col("group_size") == 2)
    assert sorted(twins["scene_id"].to_list()) == ["s2", "twin"]
    assert twins["group_split"].n_unique() == 1
    assert json.loads(files[1].read_text())["overlaps"][0]["first_scenes"] == 1


def test_the_same_scenes_are_drawn_for_a_seed(tmp_path: Path) -> None:
    run = written(tmp_path / "run", [scene(f"s{k}", k) for k in range(1, 9)])
    drawn = [[s.scene_id for s in SceneSet.read(run, limit=5, seed=seed).scenes] for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1]
    assert len(set(drawn[0])) == 5
    assert (SceneSet.read(run, limit=5).num_all, len(SceneSet.read(run))) == (8, 8)


def test_surroundings_are_not_compared(tmp_path: Path) -> None:
    made = replace(scene("a", 1), fixed=frozenset({"0_cup_0"}))
    [read] = SceneSet.read(written(tmp_path / "run", [made])).scenes
    assert len(read.categories) == len(read.positions) == 3
    assert read.categories == ComparedScene.of(made).categories


def test_a_run_without_scenes_and_one_that_is_named_twice_are_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["diversity", str(tmp_path)])
    assert done.exit_code == 2
    assert "scenes" in done.output
    assert CliRunner().invoke(app, ["diversity", "x", "x"]).exit_code == 2
