"""From a piece of furniture as its authors ship it to scenes on its surfaces."""

import json
import pickle
import shutil
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from models.semantic_reasoner.editing import edit_prompt_of
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask, table_with_zone
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.__main__ import app
from pipelines.asset_import.job import import_assets
from pipelines.asset_import.settings import ImportSettings
from pipelines.edit.report import _before
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.scene_files.importing import import_scenes
from pipelines.scene_files.repair import RepairOptions
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import (
    SampledTask,
    TaskSource,
    fingerprints_of_tasks,
    sample_tasks,
    tasks_of_scenes,
    tasks_on_supports,
)
from pipelines.supports import preparing
from pipelines.supports.preparing import SupportOptions, _fixed_furniture, prepare_supports, table_type_of
from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.cli import app as stable_data
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice
from stable_data.export.exporter import export_run
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.surface_sampling import sample_surface
from stable_data.metrics.audit import audit_scene
from stable_data.rotations import rotate_xy
from stable_data.scene import Scene, SceneObject, Stage, Tabletop
from stable_data.scene_graph.stage_samples import samples_of
from stable_data.scene_graph.staging import stage_scene
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.run_reader import SceneSelection
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.subset import select
from stable_data.storage.table_rows import object_row, scene_from_row
from stable_data.supports import to_frame
from tests.pipelines.scripts import entry
from tests.whole import check_whole

TABLES = Path(__file__).parents[2] / "data" / "import" / "tables"
COFFEE = "aws_robomaker_residential_CoffeeTable_01"
ALONE = WorkerPool()
DESK = Tabletop("office_table", (1.2, 0.6))


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> str:
    out = str(tmp_path_factory.mktemp("library") / "furniture")
    import_assets("sdformat", str(TABLES), out, ImportSettings(licence="MIT-0", decomposes=False, num_pictures=0), ALONE)
    return out


@pytest.fixture(scope="module")
def supports(library: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = str(tmp_path_factory.mktemp("supports") / "run")
    prepare_supports(library, [COFFEE], out)
    return out


def scenes_of(run: str) -> list[Scene]:
    return [scene_from_row(row) for row in RunFolder(run).table("scenes").to_pylist()]


def test_a_coffee_table_has_its_top_and_three_compartments(supports: str) -> None:
    surfaces = {s.frame.surface: s for s in scenes_of(supports) if s.frame is not None}
    assert set(surfaces) == {"top", "shelf_1", "shelf_2", "shelf_3"}
    top = surfaces["top"]
    assert (top.table.table_type, top.table.restricted_zone, top.table.clearance) == ("coffee_table", None, None)
    assert top.table.size_xy == pytest.approx((1.312, 0.653), abs=0.002)
    assert not top.objects
    for name in ("shelf_1", "shelf_2", "shelf_3"):
        scene = surfaces[name]
        assert scene.table.clearance == pytest.approx(0.2806, abs=1e-3)
        assert scene.objects
        assert scene.fixed == {o.instance for o in scene.objects}
        assert {o.category for o in scene.objects} == {"coffee_table"}
    rows = {row["asset_id"]: row for row in RunFolder(supports).table("assets").to_pylist()}
    assert rows[COFFEE]["licence"] == "MIT-0"
    assert not any(row["on_table"] for row in rows.values())  # none is offered where things for a table are asked for


def test_a_support_run_is_resumed_and_refuses_another_one_at_once(
    library: str, supports: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare_supports(library, [COFFEE], supports)
    assert len(scenes_of(supports)) == 4
    monkeypatch.setattr("pipelines.supports.preparing.IsolatedProcess", None)
    with pytest.raises(ConfigError, match="table"):
        prepare_supports(library, [COFFEE], supports, SupportOptions(table="desk"))


def test_runs_of_supports_and_on_them_are_whole(supports: str, made: str) -> None:
    assert check_whole(supports).num_audited == 4
    assert check_whole(made).num_scenes == 8


def on_shelf(said: dict[str, Any]) -> dict[str, Any]:
    """The thing of a reply, 15 cm from the near edge."""
    x, _, z = said["position"]
    return said | {"position": [x, 15.0, z]}


@pytest.fixture(scope="module")
def made(dataset: Path, supports: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Eight tasks on the four surfaces; each stage puts its thing into the one of the stage before, at the left edge."""
    first, second, third = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    things = zip(Stage, (first, second, third), (10.0, 14.0, 18.0), strict=True)
    script = {WANTED[stage]: {"objects": [on_shelf(entry(asset, x))]} for stage, asset, x in things}
    path = tmp_path_factory.mktemp("script") / "script.json"
    path.write_text(json.dumps(script))
    settings = GenerateSettings(EngineSettings(f"scripted:{path}"), weights="none", num_pictures=0)
    tasks = TaskSource("tasks", [LayoutTask(f"task_{n}", "Lift it.", DESK) for n in range(8)])
    out = str(tmp_path_factory.mktemp("made") / "out")
    generate(tasks_on_supports(tasks, supports), out, settings, ALONE, [str(dataset)])
    return out


def test_scenes_on_surfaces_are_clean_at_rest_and_within_the_furniture(made: str) -> None:
    scenes, store = scenes_of(made), run_store(made)
    assert len(scenes) == 8, RunFolder(made).table("failures").to_pylist()
    pieces: dict[str, set[str]] = defaultdict(set)
    furniture = store.asset(COFFEE).mesh
    for scene in scenes:
        assert scene.frame is not None
        pieces[scene.frame.support].add(scene.frame.surface)
        assert len(scene.movable) == 3
        resolved, shapes, _ = store.resolved(scene)
        assert audit_scene(resolved, shapes).card().clean
        assert settle(bodies_of(resolved, shapes, store), resolved.table).stable
        assert scene.table.clearance is None or all(o.top <= scene.table.clearance for o in scene.movable)
        # No point of the furniture above its plane, which may be 2 mm high, is in an object: the bodies in the way contain it.
        there = to_frame(furniture, scene.frame)
        points = np.concatenate([sample_surface(there, 30_000), there.vertices])
        points = points[points[:, 2] > 0.002]
        for o, shape, pose in zip(resolved.objects, shapes, resolved.poses(), strict=True):
            if o.instance not in resolved.fixed:
                own = np.column_stack([rotate_xy(points[:, :2] - pose[:2], -pose[3]), points[:, 2] - pose[2]])
                near = own[(abs(own) < shape.size / 2 + 0.01).all(axis=1)]
                assert SignedDistance(Mesh(shape.vertices, shape.faces))(near).min(initial=1.0) > -5e-4, o.instance
        assert not {name for r in scene.relations for name in (r.subject, r.target)} & scene.fixed
        assert {o.support for o in scene.movable} <= {"table", *(o.instance for o in scene.movable)}
    assert pieces == {f"{COFFEE}_{n:05d}": {"top", "shelf_1", "shelf_2", "shelf_3"} for n in (0, 1)}
    for row in RunFolder(made).table("scenes").to_pylist():
        assert row["num_objects"] == 3
        assert row["surface"]["asset_id"] == COFFEE


def test_joined_scenes_open_in_mujoco_and_stay_at_rest(made: str, tmp_path: Path) -> None:
    result = export_run(RunFolder(made), tmp_path, "mjcf", SceneSelection(joined=True))
    assert (result.num_written, result.num_boxes, result.failures) == (2, 0, ())
    model = mujoco.MjModel.from_xml_path(str(tmp_path / f"{COFFEE}_00000" / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    before = data.xpos.copy()
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert abs(data.xpos - before).max() < 0.01
    heights = sorted({round(float(z), 1) for z in data.xpos[:, 2] if z > 0.06})
    assert min(heights) < 0.3 < max(heights)  # on the boards and on the top
    names = [model.geom(k).name for k in range(model.ngeom)]
    assert any(name.startswith("support/visual") for name in names)
    assert not any(name.startswith("table/") for name in names)  # no other table is seen
    text = (tmp_path / "ATTRIBUTION.md").read_text()
    assert COFFEE in text
    assert "part_" not in text
    with pytest.raises(ConfigError, match="join"):
        export_run(RunFolder(made), tmp_path / "m", "mesatask", SceneSelection(joined=True))


@pytest.mark.parametrize(("column", "value", "told"), [("asset_id", "sofa", "sofa"), ("yaw", None, "cannot be used")])
def test_a_piece_that_cannot_be_joined_is_one_failure(
    made: str, tmp_path: Path, column: str, value: str | None, told: str
) -> None:
    """The run lacks its asset, or its row is none of a scene."""
    run = tmp_path / "run"
    shutil.copytree(made, run)
    (scenes,) = (run / "scenes").glob("*.parquet")
    table = pq.read_table(scenes)
    rows = table.to_pylist()
    for row in rows[4:]:
        row["surface"][column] = value
    pq.write_table(pa.Table.from_pylist(rows, table.schema), scenes)
    result = export_run(RunFolder(str(run)), tmp_path / "out", "glb", SceneSelection(joined=True))
    assert result.num_written == 1
    (failure,) = result.failures
    assert failure.startswith(f"{COFFEE}_00001: ")
    assert told in failure
    refused = CliRunner().invoke(stable_data, ["export", str(run), str(tmp_path / "o"), "--format", "original", "--join"])
    assert refused.exit_code == 2
    assert "--join" in refused.output


def test_the_picture_before_an_edit_has_the_surroundings(made: str) -> None:
    scene = next(s for s in scenes_of(made) if s.fixed)
    before = _before({"scene_id": "old", "objects_in": [object_row(o) for o in scene.movable[:1]]}, scene)
    assert before.frame == scene.frame
    assert before.surroundings == scene.surroundings
    assert before.movable == scene.movable[:1]


def test_a_run_without_supports_has_nothing_to_join(tiny_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no selected scene stands on a support"):
        export_run(RunFolder(str(tiny_run)), tmp_path / "out", "glb", SceneSelection(joined=True))


def test_sampled_tasks_fit_their_surfaces(supports: str) -> None:
    source = tasks_on_supports(sample_tasks(8, 3), supports)
    for task in source.tasks:
        assert isinstance(task, SampledTask)
        drawn = task.sample(lambda _: True)
        assert drawn.table.table_type == "coffee_table"
        assert drawn.scene_id.startswith("coffee_table_")
        assert drawn.frame is not None
        assert drawn.frame.support.endswith("_seed3")  # runs with different seeds can be joined
        assert (drawn.table.clearance is None) is (not drawn.surroundings)
        assert drawn.reference is not None


def test_the_fingerprint_of_a_task_tells_its_surroundings(supports: str) -> None:
    drawn = tasks_on_supports(sample_tasks(8, 3), supports).tasks
    given = tasks_on_supports(TaskSource("tasks", [LayoutTask("t", "Lift it.", DESK)] * 8), supports).tasks
    for tasks in (drawn, given):
        assert len({content_id(row) for row in fingerprints_of_tasks(tasks)}) == 8
        second = tasks[1]
        if isinstance(second, SampledTask):
            assert second.place is not None
            changed: SampledTask | LayoutTask = replace(second, place=replace(second.place, surroundings=()))
        else:
            assert isinstance(second, LayoutTask)
            first, *others = second.surroundings
            changed = replace(second, surroundings=(first.moved((0.0, 0.0, 0.0), 0.0), *others))
        assert [*fingerprints_of_tasks([second])] != [*fingerprints_of_tasks([changed])]
        assert [*fingerprints_of_tasks([second])] == [*fingerprints_of_tasks([pickle.loads(pickle.dumps(second))])]


def test_fixed_furniture_is_used_where_no_asset_is_named(library: str, dataset: Path) -> None:
    assert COFFEE in _fixed_furniture(library)
    assert _fixed_furniture(str(dataset)) == []


def test_scenes_of_others_are_supports_too(dataset: Path, tmp_path: Path) -> None:
    """A counter with a microwave: the microwave is an obstacle for the reasoner and the corrector."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "kitchen.xml").write_text("""
        <mujoco><worldbody>
        <body name="counter" pos="0 0 0.45"><geom type="box" size="0.8 0.35 0.45"/></body>
        <body name="microwave" pos="-0.5 0.1 1.05"><geom type="box" size="0.22 0.18 0.15"/></body>
        <body name="mug" pos="0.1 0 0.95"><freejoint/><geom type="cylinder" size="0.04 0.05"/></body>
        </worldbody></mujoco>""")
    run = str(tmp_path / "run")
    import_scenes(tmp_path / "in", None, run, RepairOptions())
    (task,) = tasks_on_supports(TaskSource("one", [LayoutTask("t", "Lift it.", DESK)]), run).tasks
    assert isinstance(task, LayoutTask)
    assert [o.category for o in task.surroundings] == ["microwave"]
    assert task.shown_table.restricted_zone == pytest.approx((0.08, 0.52, 0.27, 0.63), abs=1e-3)
    # What is not fixed is no part of the support, and is not used in scenes on it.
    first, *_ = AssetLibraries([str(dataset)], scenes=run, offers_scenes=False).libraries
    assert {a.category: a.is_offered for a in first.assets} == {"microwave": False, "mug": False}
    first, *_ = AssetLibraries([run, str(dataset)], scenes=run, offers_scenes=False).libraries
    assert {a.category: a.is_offered for a in first.assets} == {"microwave": False, "mug": True}


def test_the_zone_of_things_far_apart_is_that_of_the_largest() -> None:
    def box(name: str, x: float, width: float, bottom: float = 0.0) -> SceneObject:
        return SceneObject(name, "box", (x, 0.3, bottom + 0.1), 0.0, (width, 0.2, 0.2))

    table = Tabletop("desk", (2.0, 0.6))
    assert table_with_zone(table, []) == table
    assert table_with_zone(table, [box("a", 0.2, 0.1, bottom=0.5)]) == table  # hangs over it
    assert table_with_zone(table, [box("a", -0.2, 0.1)]) == table  # is beside it
    both = table_with_zone(table, [box("a", 0.2, 0.2), box("b", 0.4, 0.2)])
    assert both.restricted_zone == pytest.approx((0.1, 0.5, 0.2, 0.4))
    apart = table_with_zone(table, [box("a", 0.2, 0.2), box("b", 1.7, 0.3)])
    assert apart.restricted_zone == pytest.approx((1.55, 1.85, 0.2, 0.4))


def test_the_command_says_what_it_found(library: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["supports", library, "--asset", COFFEE, "--asset", COFFEE, "--out", str(tmp_path / "a"), "--surface", "top"]
    )
    assert done.exit_code == 0, done.output
    assert f"{COFFEE} top: 131 x 65 cm" in done.output
    assert [s.frame.surface for s in scenes_of(str(tmp_path / "a")) if s.frame] == ["top"]


@pytest.mark.slow
def test_bodies_in_the_way_are_no_supports(supports: str, tmp_path: Path) -> None:
    again = CliRunner().invoke(app, ["supports", supports, "--out", str(tmp_path / "again")])
    frames = [s.frame for s in scenes_of(str(tmp_path / "again"))]
    assert {frame and frame.asset_id for frame in frames} == {COFFEE}
    left = len(AssetLibraries((), scenes=supports).asset_ids) - 1
    assert left > 0
    assert f"{left} other assets were not looked at" in again.output


def test_the_command_says_what_is_wrong(library: str, tmp_path: Path) -> None:
    runner, empty = CliRunner(), str(tmp_path / "empty")
    shutil.copytree(library, empty)
    for path in Path(empty).glob("*/*.parquet"):
        pq.write_table(pq.read_table(path).slice(0, 0), path)
    for arguments, words in (
        ([library, "--asset", "sofa"], "has no asset sofa"),
        ([library, "--surface", "lid"], "has no surface lid, expected one of top, shelf_1"),
        ([str(tmp_path / "missing")], "missing"),
        ([empty], "has no asset, expected furniture"),
    ):
        failed = runner.invoke(app, ["supports", *arguments, "--out", str(tmp_path / "b")])
        assert failed.exit_code == 2, failed.output
        assert words in failed.output.replace("\n", " ")
    failed = runner.invoke(app, ["generate", "--count", "1", "--supports", str(tmp_path), "--out", str(tmp_path / "c")])
    assert failed.exit_code == 2
    assert "has no table scenes" in failed.output.replace("\n", " ")
    assert "--join" in runner.invoke(stable_data, ["export", "--help"]).output


def test_an_asset_of_unknown_size_is_no_support(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not state its size"):
        prepare_supports(str(dataset), [], str(tmp_path / "out"))


def test_an_asset_that_takes_too_long_is_a_failure(library: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"took over 0\.001 s \(seconds_per_item\)"):
        prepare_supports(library, [COFFEE], str(tmp_path / "out"), seconds_per_item=0.001)


def test_an_unexpected_error_costs_one_asset(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("odd")

    monkeypatch.setattr(preparing, "find_surfaces", broken)
    found = preparing._guarded(COFFEE, library, library, SupportOptions())
    assert isinstance(found, Notice)
    assert (found.item_id, found.code) == (COFFEE, "unexpected")
    assert "unexpected KeyError: 'odd'" in found.message


@pytest.mark.parametrize(
    ("category", "kind"),
    [("coffee_table", "coffee_table"), ("writing_desk", "office_table"), ("bookshelf", "bookshelf"), ("", "table")],
)
def test_table_types_of_furniture(category: str, kind: str) -> None:
    assert table_type_of(category) == kind


def test_generated_scenes_need_no_library_of_supports(made: str, supports: str, tmp_path: Path) -> None:
    """The run has all that its scenes show: it is exported after the supports are gone."""
    copy = tmp_path / "copy"
    shutil.copytree(made, copy)
    assert isinstance(run_store(str(copy)), AssetStore)
    result = export_run(RunFolder(str(copy)), tmp_path / "out", "glb", SceneSelection(limit=1))
    assert result.num_written == 1
    content = next((tmp_path / "out").glob("*.glb")).read_bytes()
    assert b'"support"' in content
    assert np.frombuffer(content[:4], np.uint32)[0] == 0x46546C67


def test_tasks_of_scenes_on_surfaces_stay_there(made: str) -> None:
    source = tasks_of_scenes(made)
    assert source.supports == made
    scenes = {s.scene_id: s for s in scenes_of(made)}
    for task in source.tasks:
        assert isinstance(task, LayoutTask)
        scene = scenes[task.scene_id]
        assert (task.table, task.frame, task.surroundings) == (scene.table, scene.frame, scene.surroundings)


def test_an_edit_on_a_surface_names_what_can_be_moved_alone(made: str) -> None:
    scene = next(s for s in scenes_of(made) if s.fixed)
    prompt = edit_prompt_of(scene)
    assert set(prompt.names) == {o.instance for o in scene.movable}
    assert len(prompt.layout) == 3
    assert [o.stage for o in stage_scene(scene).surroundings] == [None] * len(scene.fixed)
    samples = samples_of(stage_scene(scene))
    assert {o.instance for sample in samples for o in sample.objects_out} == {o.instance for o in scene.movable}


def test_a_part_of_a_run_keeps_its_supports(made: str, tmp_path: Path) -> None:
    select(RunFolder(made), "scene_id == 'task_0'", RunFolder(str(tmp_path / "part")))
    assert COFFEE in {row["asset_id"] for row in RunFolder(str(tmp_path / "part")).table("meshes").to_pylist()}
