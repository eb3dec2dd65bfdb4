"""Repair of scene files: they come back upright, clean and at rest; the real consumer says so."""

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.ray_executor import WorkerPool
from pipelines.scene_files.commands import resolve_source
from pipelines.scene_files.folder import FileVerdict, RepairStatus, repair_folder, write_verdicts
from pipelines.scene_files.importing import import_scenes
from pipelines.scene_files.repair import RepairOptions, repair_file, repair_states
from stable_data.cli import app as stable_data_app
from stable_data.errors import ConfigError, SceneError
from stable_data.export.exporter import export_run
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.copies import CopyWriter
from stable_data.importers.scenes.lint import lint_scene_files, scene_candidates
from stable_data.importers.scenes.opening import read_scene_file
from stable_data.importers.scenes.originals import export_originals
from stable_data.simulation.run_reader import SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import object_row, scene_from_row, scene_row
from tests.scene_files import COMMON, cuboid, gltf_parts, kitchen, write_corner, write_gltf, write_model, write_stage
from tests.whole import check_whole

DEFAULT = RepairOptions()


def only(folder: Path, path: str, out: Path | None, options: RepairOptions = DEFAULT) -> FileVerdict:
    (verdict,) = repair_folder(folder, [path], out, options)
    return verdict


def test_a_broken_scene_comes_back_upright_clean_and_at_rest(tmp_path: Path) -> None:
    write_corner(tmp_path / "in")
    verdict = only(tmp_path / "in", "scene.xml", tmp_path / "out")
    assert verdict.status is RepairStatus.REPAIRED
    assert (verdict.clean_before, verdict.clean_after, verdict.rest_before, verdict.rest_after) == (False, True, False, True)
    bodies = {body.name: body for body in verdict.bodies}
    assert "fallen over" in bodies["mug"].uprighted
    assert bodies["mug"].turn == pytest.approx(90, abs=0.5)
    assert bodies["box_a"].faults_before == ("40.0 mm in box_b",)
    assert [name for name, body in bodies.items() if not body.move] == ["fine", "wedge_1"]
    kept = ["meshes/wedge.obj", "parts/common.xml", "parts/robot.xml"]
    assert all((tmp_path / "out" / name).read_bytes() == (tmp_path / "in" / name).read_bytes() for name in kept)
    # MuJoCo itself steps the written file: nothing moves but the arm that nobody holds.
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
    data = mujoco.MjData(model)
    for _ in range(round(1 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    for name in bodies:
        at = model.jnt_qposadr[model.body(name).jntadr[0]]
        assert np.linalg.norm(data.qpos[at : at + 3] - model.qpos0[at : at + 3]) < 2e-3
    # A second repair has nothing to do.
    again = only(tmp_path / "out", "scene.xml", tmp_path / "again")
    assert again.status is RepairStatus.FINE
    assert (tmp_path / "again" / "scene.xml").read_bytes() == (tmp_path / "out" / "scene.xml").read_bytes()


def test_a_usd_scene_comes_back_likewise(tmp_path: Path) -> None:
    write_stage(tmp_path / "in.usda", is_y_up=True, unit=0.01)
    verdict = only(tmp_path, "in.usda", tmp_path / "out")
    assert verdict.status is RepairStatus.REPAIRED
    assert (verdict.clean_before, verdict.clean_after, verdict.rest_before, verdict.rest_after) == (False, True, False, True)
    assert "fallen over" in next(b for b in verdict.bodies if b.name == "/World/bottle").uprighted
    assert (tmp_path / "out" / "in.usda").read_bytes() == (tmp_path / "in.usda").read_bytes()
    assert only(tmp_path / "out", "in_repaired.usda", tmp_path / "again").status is RepairStatus.FINE


def test_a_fallen_thing_that_is_at_rest_is_put_upright_unless_asked_not_to(tmp_path: Path) -> None:
    can = '<body name="can" pos="0 0 .03" euler="90 0 0"><freejoint/><geom type="cylinder" size=".03 .06"/></body>'
    write_model(tmp_path, can)
    lying, kept = (repair_file(Boundary(tmp_path), "scene.xml", RepairOptions(upright=mode)) for mode in ("auto", "keep"))
    assert lying.bodies[0].turn == pytest.approx(90, abs=0.1)
    assert lying.is_clean
    assert lying.is_at_rest
    assert kept.changed == {}
    assert kept.was_clean


def test_what_cannot_be_solved_is_said(tmp_path: Path) -> None:
    """A body that is wider than every free place between fixed walls."""
    walls = "".join(f'<geom type="box" size=".02 .4 .2" pos="{x} 0 .2"/>' for x in (-0.4, -0.2, 0.0, 0.2, 0.4))
    wide = '<body name="wide" pos=".1 0 .1"><freejoint/><geom type="box" size=".12 .12 .1"/></body>'
    write_model(tmp_path, walls + wide)
    verdict = only(tmp_path, "scene.xml", tmp_path / "out", RepairOptions(table="table"))
    assert verdict.status is RepairStatus.UNSOLVED
    assert verdict.message
    assert verdict.clean_after is False
    assert "wide" in verdict.lines()[1]


def test_a_folder_has_a_verdict_for_each_scene(tmp_path: Path) -> None:
    source = tmp_path / "in"
    write_corner(source)
    cube = '<body name="cube" pos="0 0 {z}"><freejoint/><geom type="box" size=".03 .03 .03"/></body>'
    write_model(source, cube.format(z=".03"), name="fine.xml")
    write_model(source, cube.format(z=".1"), '<include file="/etc/hostname"/>', name="hostile.xml")
    write_model(source, '<geom size=".1"/>', name="empty.xml")
    (source / "note.xml").write_text("<note/>")
    verdicts = {v.path: v for v in repair_folder(source, None, tmp_path / "out", RepairOptions())}
    assert {path: str(v.status) for path, v in verdicts.items()} == {
        "fine.xml": "fine",
        "scene.xml": "repaired",
        "hostile.xml": "failed",
    }
    assert verdicts["hostile.xml"].code == "path_outside"
    write_verdicts(list(verdicts.values()), tmp_path / "verdicts.parquet")
    rows = pq.read_table(tmp_path / "verdicts.parquet").to_pylist()
    assert [row["path"] for row in rows] == list(verdicts)
    assert rows[1]["bodies"][0]["name"] == "mug"


def test_in_place_changes_only_the_poses(tmp_path: Path) -> None:
    write_corner(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    only(tmp_path, "scene.xml", None)
    changed = sorted(path.relative_to(tmp_path).as_posix() for path, content in before.items() if path.read_bytes() != content)
    assert changed == ["parts/things.xml", "scene.xml"]


def test_scenes_that_share_a_body_file_are_not_mixed(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text("a")
    writer = CopyWriter(tmp_path, tmp_path / "out")
    writer.write("one.xml", ["a.xml"], {"a.xml": b"moved"})
    writer.write("two.xml", ["a.xml"], {"a.xml": b"moved"})
    with pytest.raises(SceneError) as caught:
        writer.write("three.xml", ["a.xml"], {})
    assert caught.value.code == "file_shared"


def test_scenes_are_imported_audited_and_exported(tmp_path: Path) -> None:
    source = tmp_path / "in"
    write_corner(source)
    write_stage(source / "stage.usda")
    counts = import_scenes(source, ["scene.xml", "stage.usda"], str(tmp_path / "run"), RepairOptions(upright="keep"))
    assert (counts.num_files, counts.num_scenes, counts.failures) == (2, 2, ())
    assert check_whole(tmp_path / "run").num_audited == 2
    run = RunFolder(str(tmp_path / "run"))
    rows = {row["scene_id"]: row for row in run.table("scenes").to_pylist()}
    assert rows["scene"]["layout_path"] == "scene.xml"
    assert rows["scene"]["clean"] is False
    assert rows["scene"]["num_objects"] == 6
    assets = {row["description"]: row for row in run.table("assets").to_pylist()}
    assert assets["box_b"]["mass"] == pytest.approx(0.2)
    assert assets["box_b"]["mass_source"] == "given"
    assert assets["arm"]["is_static"] is True
    assert run.num_rows("meshes") == len(assets)
    lint = lint_scene_files(source, scene_candidates(source))
    assert [row["clean"] for row in lint.rows] == [False, False]

    moved = tmp_path / "moved"
    shutil.copytree(tmp_path / "run", moved)
    shutil.rmtree(moved / "scenes")
    scene = scene_from_row(rows["scene"])
    objects = [o.moved((o.position[0] + 0.01, *o.position[1:]), o.yaw) if o.description == "fine" else o for o in scene.objects]
    row = rows["scene"] | {"objects": [object_row(o) for o in objects]}
    assert scene_row(scene)["fixed"] == row["fixed"]
    RunFolder(str(moved)).write_shard("scenes", "changed", [row])
    result = export_originals(RunFolder(str(moved)), source, tmp_path / "out", SceneSelection())
    assert (result.num_written, result.num_moved, result.failures) == (1, 1, ())
    before, after = ((folder / "scene.xml").read_text().splitlines() for folder in (source, tmp_path / "out"))
    assert [a for a, b in zip(before, after, strict=True) if a != b] == [line for line in before if 'name="fine"' in line]
    (source / "parts" / "common.xml").write_text(COMMON + "<!-- changed -->")
    assert "another file" in export_originals(RunFolder(str(moved)), source, tmp_path / "out2", SceneSelection()).failures[0]


def test_sources_are_checked(tmp_path: Path) -> None:
    path = write_corner(tmp_path / "a" / "b")
    assert resolve_source(path, tmp_path / "a") == (tmp_path / "a", ["b/scene.xml"])
    with pytest.raises(ConfigError, match="is not in"):
        resolve_source(path, tmp_path / "a" / "b" / "parts")
    with pytest.raises(ConfigError, match="does not exist"):
        resolve_source(tmp_path / "none.xml", None)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no scene file"):
        list(repair_folder(tmp_path / "empty", None, tmp_path / "out", RepairOptions()))


@pytest.mark.slow
def test_the_correct_job_takes_an_import_and_its_result_goes_back(tmp_path: Path) -> None:
    write_corner(tmp_path / "in")
    import_scenes(tmp_path / "in", ["scene.xml"], str(tmp_path / "run"), RepairOptions(upright="auto"))
    settings = CorrectSettings(weights="none", when_full="infeasible", settle=True, num_pictures=0)
    correct(str(tmp_path / "run"), str(tmp_path / "corrected"), settings, WorkerPool(), report=False)
    result = export_originals(RunFolder(str(tmp_path / "corrected")), tmp_path / "in", tmp_path / "out", SceneSelection())
    assert (result.num_written, result.failures) == (1, ())
    assert only(tmp_path / "out", "scene.xml", tmp_path / "again").status is RepairStatus.FINE


def test_each_start_state_of_a_file_is_repaired_by_itself(tmp_path: Path) -> None:
    can, cube = "0 0 .06 1 0 0 0", ".2 0 .03 1 0 0 0"
    keys = [f"{can} .04 0 .03 1 0 0 0", f"0 0 .03 .7071068 .7071068 0 0 {cube}", f"{can} .2 0 .13 1 0 0 0"]
    names = ('name="a"', "", 'name="c"')
    frames = "".join(f'<key {name} qpos="{key}"/>' for name, key in zip(names, keys, strict=True))
    bodies = '<body name="can" pos="0 0 .06"><freejoint/><geom type="cylinder" size=".03 .06"/></body>'
    bodies += '<body name="cube" pos=".2 0 .03"><freejoint/><geom type="box" size=".03 .03 .03"/></body>'
    path = write_model(tmp_path, bodies)
    path.write_text(path.read_text().replace("</mujoco>", f"<keyframe>{frames}</keyframe></mujoco>"))
    repairs = repair_states(Boundary(tmp_path), "scene.xml", RepairOptions(key="all"))
    assert [repair.path for repair in repairs] == [f"scene.xml#{key}" for key in ("initial", "a", "1", "c")]
    assert [str(FileVerdict.of(repair).status) for repair in repairs] == ["fine", "repaired", "repaired", "repaired"]
    text = repairs[-1].changed["scene.xml"].decode()
    assert text.split("<keyframe>")[0] == path.read_text().split("<keyframe>")[0]
    assert f'<key name="c" qpos="{can} .2 0 0.0' in text
    assert f"0 0 0.06 1.0 0.0 0 0 {cube}" in text


def test_one_file_is_written_beside_the_original(tmp_path: Path) -> None:
    write_model(tmp_path, '<body name="cube" pos=".2 0 .13"><freejoint/><geom type="box" size=".03 .03 .03"/></body>')
    runner = CliRunner()
    done = runner.invoke(app, ["repair", str(tmp_path / "scene.xml"), "--out", str(tmp_path / "fixed.xml")])
    assert done.exit_code == 0, done.output
    before, after = ((tmp_path / name).read_text() for name in ("scene.xml", "fixed.xml"))
    assert after == before.replace(".2 0 .13", after.split('name="cube" pos="')[1].split('"')[0])
    refused = runner.invoke(app, ["repair", str(tmp_path / "scene.xml"), "--out", str(tmp_path / "other" / "fixed.xml")])
    assert refused.exit_code == 2
    write_corner(tmp_path / "corner")
    refused = runner.invoke(
        app, ["repair", str(tmp_path / "corner" / "scene.xml"), "--out", str(tmp_path / "corner" / "b.xml")]
    )
    assert "poses stand in parts/things.xml, scene.xml" in refused.output
    for wrong in (["--out", "x", "--in-place"], ["--upright", "maybe", "--out", str(tmp_path / "o")]):
        assert runner.invoke(app, ["repair", str(tmp_path / "scene.xml"), *wrong]).exit_code == 2


def test_an_import_is_exported_with_its_surroundings_fixed(tmp_path: Path) -> None:
    write_corner(tmp_path / "in")
    import_scenes(tmp_path / "in", ["scene.xml"], str(tmp_path / "run"), RepairOptions(upright="keep"))
    export_run(RunFolder(str(tmp_path / "run")), tmp_path / "out", "mjcf", SceneSelection())
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene" / "scene.xml"))
    assert (model.nbody, model.njnt) == (1 + 6 + 2, 6)


def test_what_a_repair_wrote_is_no_scene_of_its_own(tmp_path: Path) -> None:
    for name in ("a.usda", "a_repaired.usda", "b_repaired.usda"):
        (tmp_path / name).write_text("#usda 1.0\n")
    assert scene_candidates(tmp_path) == ["a.usda", "b_repaired.usda"]


@pytest.mark.parametrize("num_files", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_folder_without_a_scene_is_an_error(tmp_path: Path, num_files: int) -> None:
    source = tmp_path / "in"
    source.mkdir()
    for k in range(num_files):
        (source / f"{k}.xml").write_text("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
    runner, out = CliRunner(), str(tmp_path / "out")
    for done in (
        runner.invoke(stable_data_app, ["lint", str(source)]),
        runner.invoke(app, ["repair", str(source), "--out", out]),
        runner.invoke(app, ["import-scenes", str(source), "--out", out]),
    ):
        assert (done.exit_code, done.stdout) == (2, "")
        found = "none of its files (1) has a free body" if num_files else "no scene file"
        assert found in done.stderr
        assert "expected a scene file (.glb, .gltf, .mjcf" in done.stderr
    assert not (tmp_path / "out").exists()
    (source / "broken.usda").write_text("#usda 1.0\n(((")
    done = runner.invoke(stable_data_app, ["lint", str(source)])
    assert done.exit_code == 1, "a file that cannot be read is listed"
    assert "broken.usda" in done.stdout


@pytest.mark.parametrize("name", ["in.gltf", "in.glb"])
def test_a_gltf_scene_comes_back_likewise(tmp_path: Path, name: str) -> None:
    source = tmp_path / "in"
    source.mkdir()
    write_gltf(source / name, *kitchen())
    verdict = only(source, name, tmp_path / "out")
    assert verdict.status is RepairStatus.REPAIRED
    assert (verdict.clean_before, verdict.clean_after, verdict.rest_before, verdict.rest_after) == (False, True, False, True)
    bodies = {body.name: body for body in verdict.bodies}
    assert [n for n, body in bodies.items() if not body.move] == ["fine-rigid"]
    assert "fallen over" in bodies["bottle"].uprighted
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(path.name for path in source.iterdir())
    before, after = (trimesh.load(folder / name) for folder in (source, tmp_path / "out"))
    assert before.geometry.keys() == after.geometry.keys()
    for node in before.graph.nodes_geometry:
        is_same = np.allclose(before.graph[node][0], after.graph[node][0], atol=1e-9)
        assert is_same == (bodies.get(node) is None or not bodies[node].move)
    again = only(tmp_path / "out", name, tmp_path / "again")
    assert again.status is RepairStatus.FINE
    assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
    # MuJoCo itself, with the boxes and the table of the file: nothing moves.
    opened = read_scene_file(Boundary(tmp_path / "out"), name)
    assert all(motion.move < 2e-3 for motion in opened.watch().values())


def test_a_gltf_scene_is_imported_and_exported_and_single_assets_are_left_out(tmp_path: Path) -> None:
    source = tmp_path / "in"
    source.mkdir()
    write_gltf(source / "kitchen.gltf", *kitchen())
    write_gltf(source / "asset.glb", *gltf_parts([cuboid(0.1, 0.1, 0.1)], [{"mesh": 0}]))
    counts = import_scenes(source, None, str(tmp_path / "run"), RepairOptions(upright="keep"))
    assert (counts.num_files, counts.num_scenes, counts.failures) == (1, 1, ())
    run = RunFolder(str(tmp_path / "run"))
    (row,) = run.table("scenes").to_pylist()
    assert (row["clean"], row["num_objects"], row["layout_path"]) == (False, 5, "kitchen.gltf")
    assets = {asset["description"]: asset for asset in run.table("assets").to_pylist()}
    assert (assets["bottle"]["mass"], assets["bottle"]["mass_source"]) == (pytest.approx(0.3), "given")
    assert assets["box_a-rigid"]["category"] == "box"
    assert assets["shelf"]["is_static"] is True
    assert [(r["scene_id"], r["clean"]) for r in lint_scene_files(source, scene_candidates(source)).rows] == [
        ("kitchen", False)
    ]
    scene = scene_from_row(row)
    objects = [
        o.moved((o.position[0] - 0.01, *o.position[1:]), o.yaw) if o.description == "fine-rigid" else o for o in scene.objects
    ]
    moved = tmp_path / "moved"
    shutil.copytree(tmp_path / "run", moved)
    shutil.rmtree(moved / "scenes")
    RunFolder(str(moved)).write_shard("scenes", "changed", [row | {"objects": [object_row(o) for o in objects]}])
    result = export_originals(RunFolder(str(moved)), source, tmp_path / "out", SceneSelection())
    assert (result.num_written, result.num_moved, result.failures) == (1, 1, ())
    before, after = ((folder / "kitchen.gltf").read_text().splitlines() for folder in (source, tmp_path / "out"))
    changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert [float(text.strip(" ,")) for pair in changed for text in pair] == pytest.approx([35, 34], abs=1e-6)
    assert (tmp_path / "out" / "kitchen.bin").read_bytes() == (source / "kitchen.bin").read_bytes()
    (source / "kitchen.gltf").unlink()
    with pytest.raises(ConfigError, match="no scene file, expected a scene file"):
        list(repair_folder(source, None, tmp_path / "none", RepairOptions()))


def test_files_of_one_name_in_two_formats_are_two_scenes(tmp_path: Path) -> None:
    source = tmp_path / "in"
    source.mkdir()
    for name in ("a.glb", "a.gltf"):
        write_gltf(source / name, *kitchen())
    import_scenes(source, None, str(tmp_path / "run"), RepairOptions(upright="keep"))
    rows = RunFolder(str(tmp_path / "run")).table("scenes").to_pylist()
    assert {row["scene_id"]: row["layout_path"] for row in rows} == {"a": "a.glb", "a__gltf": "a.gltf"}


def test_a_gltf_file_is_written_beside_the_original(tmp_path: Path) -> None:
    write_gltf(tmp_path / "a.gltf", *kitchen())
    done = CliRunner().invoke(app, ["repair", str(tmp_path / "a.gltf"), "--out", str(tmp_path / "b.gltf"), "--key", "all"])
    assert done.exit_code == 0, done.output
    assert only(tmp_path, "b.gltf", tmp_path / "out").status is RepairStatus.FINE
    assert (tmp_path / "out" / "a.bin").exists()
    refused = CliRunner().invoke(app, ["repair", str(tmp_path / "a.gltf"), "--out", str(tmp_path / "b.glb")])
    assert refused.exit_code == 2
    assert "expected a file .gltf" in refused.output
