"""Variants of the scenes of a run: each keeps all but one axis, has the split of its source, and is made again the same."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from models.dual_system.variant_comparison import compare_variant, kept_beside_clutter
from models.dual_system.variant_task import Axis
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import variants_of_scenes
from pipelines.sources.scenes import TableSource
from stable_data.errors import ConfigError
from stable_data.scene import Scene, Stage
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import scene_from_row
from tests.pipelines.runs import content
from tests.pipelines.scripts import entry
from tests.whole import check_whole

ALONE = WorkerPool()
SCENE, UNTOLD = "bathroom_vanity_00000", "untold"


@pytest.fixture(scope="module")
def run(clean_run: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A run with one scene of the test split, and the same without a task."""
    out = tmp_path_factory.mktemp("run") / "run"
    shutil.copytree(clean_run, out)
    row = TableSource(str(out)).row(SCENE)
    shutil.rmtree(out / "scenes")
    rows = [row | {"split": "test"}, row | {"scene_id": UNTOLD, "task": None, "split": None}]
    RunFolder(str(out)).write_shard("scenes", "0" * 16, rows)
    return str(out)


@pytest.fixture(scope="module")
def settings(run: str, tmp_path_factory: pytest.TempPathFactory) -> GenerateSettings:
    """An engine that adds a thing in each stage of new clutter, and in the first another one of what the instruction names."""
    known = {a.category: a for library in AssetLibraries([run]).libraries for a in library.assets}
    script = {
        WANTED[Stage.IMPORTANT]: {"objects": [entry(known["book"], 60.0), entry(known["nail_polish"], 90.0, "nail_polish_7")]},
        WANTED[Stage.SECONDARY]: {"objects": [entry(known["mirror"], 100.0)]},
    }
    path = tmp_path_factory.mktemp("script") / "script.json"
    path.write_text(json.dumps(script))
    return GenerateSettings(EngineSettings(f"scripted:{path}"), weights="none", num_pictures=0)


@pytest.fixture(scope="module", params=list(Axis))
def made(
    request: pytest.FixtureRequest, run: str, settings: GenerateSettings, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The variants on one axis."""
    out: Path = tmp_path_factory.mktemp(request.param) / request.param
    generate(variants_of_scenes(run, request.param), str(out), settings, ALONE, [run])
    return out


def test_a_run_of_variants_is_whole(made: Path) -> None:
    check_whole(made, verdicts="audit")


def rows_of(out: Path, table: str) -> dict[str, Row]:
    return {row["scene_id" if table == "scenes" else "id"]: row for row in RunFolder(str(out)).table(table).to_pylist()}


def test_a_variant_keeps_all_but_its_axis_and_has_the_split_of_its_source(made: Path, run: str) -> None:
    axis, was = Axis(made.name), TableSource(run).row(SCENE)
    row = rows_of(made, "scenes")[f"{SCENE}~{axis}_1"]
    assert (row["variant_of"], row["varied"], row["split"]) == (SCENE, axis, "test")
    assert row["duplicate_group"] == was["duplicate_group"]
    assert row["clean"]
    assert row["stable"]
    source, scene = scene_from_row(was), scene_from_row(row)
    found = compare_variant(source, scene, axis, TableSource(run).containers)
    assert found.is_varied
    assert found.lost == ()
    assert row["num_varied"] == found.num_varied
    {Axis.LAYOUT: of_layout, Axis.ASSETS: of_assets, Axis.TASK: of_task, Axis.CLUTTER: of_clutter}[axis](source, scene)
    page = (made / "report" / "index.html").read_text("utf-8")
    assert "<h2>Variants</h2>" in page
    used = {o.asset_id for o in scene.objects}
    assert used <= set(RunFolder(str(made)).table("meshes", ["asset_id"])["asset_id"].to_pylist())


def of_layout(source: Scene, scene: Scene) -> None:
    assert [(o.instance, o.asset_id, o.scale) for o in scene.objects] == [
        (o.instance, o.asset_id, o.scale) for o in source.objects
    ]
    assert scene.task == source.task
    assert all(scene[o.instance].position[:2] != o.position[:2] for o in source.objects)


def of_assets(source: Scene, scene: Scene) -> None:
    assert [(o.instance, o.category) for o in scene.objects] == [(o.instance, o.category) for o in source.objects]
    assert scene.task == source.task
    assert any(scene[o.instance].asset_id != o.asset_id for o in source.objects)


def of_task(source: Scene, scene: Scene) -> None:
    assert [replace(o, stage=None) for o in scene.objects] == [replace(o, stage=None) for o in source.objects]
    assert scene.task is not None
    assert source.task is not None
    assert scene.task.task != source.task.task
    assert {o.instance for o in scene.objects if o.stage is Stage.TASK} >= set(scene.task.task_objects)


def of_clutter(source: Scene, scene: Scene) -> None:
    kept = kept_beside_clutter(source)
    assert all(scene[name].position == pytest.approx(source[name].position, abs=1e-3) for name in kept)
    assert scene.task == source.task
    new = {o.category for o in scene.objects if o.instance not in kept}
    assert new == {"book", "mirror"}  # another nail polish would be taken for the one of the instruction


def test_a_scene_without_a_task_is_varied_where_none_is_needed(made: Path) -> None:
    axis = Axis(made.name)
    name = f"{UNTOLD}~{axis}_1"
    failures, scenes = rows_of(made, "failures"), rows_of(made, "scenes")
    if axis in (Axis.LAYOUT, Axis.CLUTTER):
        assert failures[name]["code"] == "task_missing"
        assert name not in scenes
        return
    assert name not in failures
    assert (scenes[name]["task"] is None) is (axis is Axis.ASSETS)
    assert scenes[name]["split"] is None


def test_what_is_lost_is_made_again_the_same(made: Path, run: str, settings: GenerateSettings) -> None:
    before = content(made)
    for path in made.glob("scenes/part-*.parquet"):
        path.unlink()
    generate(variants_of_scenes(run, made.name), str(made), settings, ALONE, [run])
    assert content(made) == before


@pytest.mark.slow
def test_another_number_is_another_variant_and_does_not_change_the_first(
    run: str, settings: GenerateSettings, tmp_path: Path
) -> None:
    where = f"scene_id == '{SCENE}'"
    generate(variants_of_scenes(run, "task", 2, where), str(tmp_path / "two"), settings, ALONE, [run])
    generate(variants_of_scenes(run, "task", 1, where, seed=0), str(tmp_path / "one"), settings, ALONE, [run])
    two, one = (rows_of(tmp_path / name, "scenes") for name in ("two", "one"))
    assert set(two) == {f"{SCENE}~task_1", f"{SCENE}~task_2"}
    assert two[f"{SCENE}~task_1"]["task"] == one[f"{SCENE}~task_1"]["task"]
    assert two[f"{SCENE}~task_1"]["task"]["task"] != two[f"{SCENE}~task_2"]["task"]["task"]
    assert [task.scene_id for task in variants_of_scenes(run, "task", 1, where, seed=7).tasks] == [f"{SCENE}~task_1_seed7"]


def test_assets_without_another_one_of_their_category_give_no_variant(
    clean_run: Path, settings: GenerateSettings, tmp_path: Path
) -> None:
    where = "scene_id == 'dining_table_00002'"
    generate(variants_of_scenes(str(clean_run), "assets", 1, where), str(tmp_path / "out"), settings, ALONE, [str(clean_run)])
    assert rows_of(tmp_path / "out", "failures")["dining_table_00002~assets_1"]["code"] == "no_variant"


def test_a_run_with_other_scenes_does_not_continue(run: str, settings: GenerateSettings, tmp_path: Path) -> None:
    where = f"scene_id == '{SCENE}'"
    generate(variants_of_scenes(run, "task", 1, where), str(tmp_path / "out"), settings, ALONE, [run])
    other = tmp_path / "run"
    shutil.copytree(run, other)
    row = TableSource(run).row(SCENE)
    shutil.rmtree(other / "scenes")
    RunFolder(str(other)).write_shard("scenes", "1" * 16, [row])
    with pytest.raises(ConfigError, match=r"inputs\.scenes"):
        generate(variants_of_scenes(str(other), "task", 1, where), str(tmp_path / "out"), settings, ALONE, [str(other)])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--vary", "colour"], "--vary is 'colour', expected one of layout, assets, task, clutter"),
        (["--vary", "layout", "--variants", "0"], "--variants is 0, expected at least 1"),
        (["--vary", "layout", "--limit", "0"], "--limit is 0, expected at least 1"),
        (["--vary", "layout", "--where", "split == 'train'"], "no scene meets \"split == 'train'\""),
        (["--variants", "2"], "--variants and --limit belong to --vary"),
        (["--vary", "assets", "--assets", "/absent"], "/absent is not a folder"),
    ],
)
def test_bad_options_are_one_line(run: str, tmp_path: Path, options: list[str], said: str) -> None:
    result = CliRunner().invoke(app, ["generate", "--scenes", run, "--out", str(tmp_path / "out"), *options])
    assert result.exit_code == 2
    (line,) = result.stderr.strip().splitlines()
    assert said in line


def test_scenes_without_their_tables_are_refused(run: str, real_data: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no table scenes, expected a run"):
        variants_of_scenes(str(real_data), "layout")
    bare = tmp_path / "bare"
    shutil.copytree(run, bare)
    shutil.rmtree(bare / "meshes")
    with pytest.raises(ConfigError, match="has no table meshes"):
        variants_of_scenes(str(bare), "layout")
    result = CliRunner().invoke(app, ["generate", "--count", "3", "--vary", "layout", "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "--vary AXIS needs the scenes of a run" in result.stderr
