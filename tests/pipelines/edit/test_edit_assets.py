"""Edits that need assets which the scenes' own library lacks: they come from further libraries, and every output has them."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models.semantic_reasoner.text.reply_json import LayoutObject, render_objects
from pipelines.__main__ import app
from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.edit.job import EditJob, edit
from pipelines.preprocess.job import preprocess
from pipelines.sources.assets import AssetLibraries
from stable_data.assets.run_assets import run_store
from stable_data.cli import app as stable_data
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.lint import lint_folder
from stable_data.scene import SceneObject
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from tests.pipelines.edit.edit_runs import ALONE, EMPTY, SMALL, file_of, rows_of
from tests.pipelines.runs import SMALL as SMALL_RUN
from tests.pipelines.runs import content

OTHER = "further"


@pytest.fixture(scope="module")
def own(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first scene of the dataset with the assets that it uses, and no others."""
    root = Path(shutil.copytree(dataset, tmp_path_factory.mktemp("own") / "own"))
    source = MesaTaskDataset(dataset)
    for scene_id in source.scene_ids[1:]:
        shutil.rmtree(next(root.glob(f"Layout_info/*/{scene_id}")))
    used = {o.asset_id for o in source.read(source.scene_ids[0])[0].objects}
    for mesh in root.glob("Assets_library/*.glb"):
        if mesh.stem not in used:
            mesh.unlink()
    annotations = json.loads((root / "Asset_annotation.json").read_text("utf-8"))
    (root / "Asset_annotation.json").write_text(json.dumps({k: v for k, v in annotations.items() if k in used}), "utf-8")
    return root


@pytest.fixture(scope="module")
def further(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All assets of the dataset, without its scenes."""
    root = tmp_path_factory.mktemp("library") / OTHER
    return Path(shutil.copytree(dataset, root, ignore=shutil.ignore_patterns("Layout_info")))


@pytest.fixture(scope="module")
def missing(dataset: Path, own: Path) -> SceneObject:
    """The smallest object of the other scenes whose category the own library lacks."""
    there = {a.category for library in AssetLibraries(scenes=str(own)).libraries for a in library.assets}
    source = MesaTaskDataset(dataset)
    objects = [o for scene_id in source.scene_ids[1:] for o in source.read(scene_id)[0].objects]
    return min((o for o in objects if o.category not in there and o.support in (None, "table")), key=lambda o: max(o.size))


@pytest.fixture(scope="module")
def lines(own: Path, missing: SceneObject) -> list[dict[str, Any]]:
    source = MesaTaskDataset(own)
    (scene_id,) = source.scene_ids
    width, depth = source.read(scene_id)[0].table.size_xy
    w, d, h = (round(100 * side, 1) for side in missing.size)
    new = LayoutObject(f"{missing.category}_0", missing.description, (w, d, h), (50 * width, 50 * depth, h / 2), 0)
    return [{"scene_id": scene_id, "instruction": "Add it.", "edit_id": "added", "reply": render_objects([new], ())}]


@pytest.fixture(scope="module")
def added(own: Path, further: Path, lines: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("added")
    edit(str(own), file_of(lines, folder / "e.jsonl"), str(folder / "out"), SMALL, ALONE, [str(further)])
    return folder / "out"


def new_one(out: Path, missing: SceneObject) -> SceneObject:
    (found,) = (o for o in scene_from_row(rows_of(out, "scenes")["added"]).objects if o.category == missing.category)
    return found


def test_what_the_own_library_lacks_comes_from_the_next_and_is_said(
    own: Path, added: Path, missing: SceneObject, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    row = rows_of(added, "scenes")["added"]
    assert row["clean"]
    assert new_one(added, missing).asset_id not in MesaTaskDataset(own).asset_ids
    (message,) = (
        w["message"] for w in RunFolder(str(added)).table("warnings").to_pylist() if w["code"] == "asset_of_other_library"
    )
    assert f"has an asset of library {OTHER}" in message
    edit(str(own), file_of(lines, tmp_path / "e.jsonl"), str(tmp_path / "out"), SMALL, ALONE, report=False)
    assert {r["code"] for r in RunFolder(str(tmp_path / "out")).table("failures").to_pylist()} == {"asset_unmatched"}


def test_an_own_asset_comes_before_the_same_one_of_another_library(
    own: Path, dataset: Path, further: Path, tmp_path: Path
) -> None:
    shelf = AssetLibraries([str(further)], scenes=str(own))
    first, second = shelf.libraries
    assert (first.name, second.name) == ("own", OTHER)
    assert {a.asset_id for a in first.assets} == set(MesaTaskDataset(own).asset_ids)
    assert not {a.asset_id for a in first.assets} & {a.asset_id for a in second.assets}
    assert all(shelf.is_of_first(a.asset_id) for a in first.assets)
    assert not any(shelf.is_of_first(a.asset_id) for a in second.assets)
    scene = MesaTaskDataset(dataset).read(MesaTaskDataset(dataset).scene_ids[-1])[0]  # has assets of both
    whole = AssetLibraries([str(dataset)])
    assert shelf.containers(scene) == whole.containers(scene)
    assert {True, False} <= set(shelf.containers(scene).values())


def test_the_folder_of_edited_scenes_has_all_meshes_and_the_source_is_as_it_was(
    own: Path, added: Path, missing: SceneObject
) -> None:
    out, new = added / "dataset", new_one(added, missing)
    result = lint_folder(out)
    assert [bool(row["clean"]) for row in result.rows] == [True]
    assert not result.failures
    assert not any(n.code in ("glb_missing", "unknown_uid", "glb_refused") for n in MesaTaskDataset(out).notices)
    was, now = MesaTaskDataset(own), MesaTaskDataset(out)
    assert set(now.asset_ids) == {*was.asset_ids, new.asset_id}
    for asset_id in was.asset_ids:
        path, old = now.asset_path(asset_id), was.asset_path(asset_id)
        assert path is not None
        assert old is not None
        assert path.samefile(old)
    assert new.asset_id is not None
    assert not list(own.glob(f"Assets_library/{new.asset_id}*"))
    assert now.annotation(new.asset_id).category == missing.category


def test_the_run_can_be_exported_corrected_and_edited_without_the_libraries(
    added: Path, missing: SceneObject, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    run = Path(shutil.copytree(added, tmp_path / "run", ignore=shutil.ignore_patterns("dataset")))
    scene = scene_from_row(rows_of(run, "scenes")["added"])
    assert {row["asset_id"] for row in RunFolder(str(run)).table("meshes").to_pylist()} == {o.asset_id for o in scene.objects}
    _, shapes, notices = run_store(str(run)).resolved(scene)
    assert all(shape.is_exact for shape in shapes)
    assert not notices
    done = CliRunner().invoke(stable_data, ["export", str(run), str(tmp_path / "export"), "--format", "glb"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "export" / "added.glb").is_file()
    settings = CorrectSettings(weights="none", num_pictures=0)
    manifest = correct(str(run), str(tmp_path / "corrected"), settings, ALONE, report=False)
    assert manifest["counts"]["scenes"] == 1
    assert rows_of(tmp_path / "corrected", "scenes")["added"]["clean"]
    again = [{**lines[0], "scene_id": "added", "edit_id": "twice", "instruction": "Add another one."}]
    name = json.loads(lines[0]["reply"])["objects"][0]["instance"]
    again[0]["reply"] = again[0]["reply"].replace(name, name.replace("_0", "_7"))
    edit(str(run), file_of(again, tmp_path / "e.jsonl"), str(tmp_path / "twice"), SMALL, ALONE, report=False)
    objects = scene_from_row(rows_of(tmp_path / "twice", "scenes")["twice"]).objects
    assert len({o.asset_id for o in objects if o.category == missing.category}) == 1  # from the run itself


def test_a_run_that_is_edited_keeps_its_tables_and_gets_the_new_meshes(
    own: Path, further: Path, missing: SceneObject, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    preprocess(str(own), str(tmp_path / "run"), SMALL_RUN, ALONE)
    path, out = file_of(lines, tmp_path / "e.jsonl"), tmp_path / "out"
    counts = edit(str(tmp_path / "run"), path, str(out), SMALL, ALONE, [str(further)], report=False)["counts"]
    new = new_one(out, missing).asset_id
    for table in ("assets", "meshes"):
        was = {row["asset_id"] for row in RunFolder(str(tmp_path / "run")).table(table).to_pylist()}
        now = [row["asset_id"] for row in RunFolder(str(out)).table(table).to_pylist()]
        assert sorted(now) == sorted([*was, new])
        assert counts[table] == len(now)
    before = content(out)
    assert edit(str(tmp_path / "run"), path, str(out), SMALL, ALONE, [str(further)], report=False)["counts"] == counts
    assert content(out) == before


@pytest.mark.slow
def test_edits_of_edits_of_a_run_are_complete_runs(clean_run: Path, tmp_path: Path) -> None:
    source = clean_run
    for k in range(3):  # all outputs have the same name and the same assets
        scene_id = min(rows_of(source, "scenes"))
        told = [{"scene_id": scene_id, "instruction": "Leave it.", "edit_id": f"same_{k}", "reply": EMPTY}]
        path, out = file_of(told, tmp_path / f"{k}.jsonl"), tmp_path / str(k) / "out"
        for _ in range(2):
            edit(str(source), path, str(out), SMALL, ALONE, report=False)
        assert RunFolder(str(out)).table("meshes") == RunFolder(str(clean_run)).table("meshes")
        source = out


def test_a_run_does_not_go_on_with_other_libraries(
    own: Path, further: Path, added: Path, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    path = file_of(lines, tmp_path / "e.jsonl")
    before = content(added)
    edit(str(own), path, str(added), SMALL, ALONE, [str(further)], report=False)
    with pytest.raises(ConfigError, match=rf"inputs\.assets\.{OTHER}: \w+ -> None"):
        edit(str(own), path, str(added), SMALL, ALONE, report=False)
    changed = Path(shutil.copytree(further, tmp_path / OTHER))
    there = MesaTaskDataset(own).asset_ids
    min(path for path in changed.glob("Assets_library/*.glb") if path.stem not in there).unlink()
    with pytest.raises(ConfigError, match=rf"inputs\.assets\.{OTHER}: \w+ -> \w+"):
        edit(str(own), path, str(added), SMALL, ALONE, [str(changed)], report=False)
    assert content(added) == before


@pytest.mark.slow
@pytest.mark.sim
def test_meshes_without_parts_are_decomposed_by_who_needs_them(real_data: Path, tmp_path: Path) -> None:
    told = [
        {"scene_id": MesaTaskDataset(real_data).scene_ids[0], "instruction": "Leave it.", "edit_id": "same", "reply": EMPTY}
    ]
    edit(str(real_data), file_of(told, tmp_path / "e.jsonl"), str(tmp_path / "out"), SMALL, ALONE, report=False)
    rows = RunFolder(str(tmp_path / "out")).table("meshes").to_pylist()
    assert rows
    assert not any(row["parts"] or row["parts_method"] for row in rows)
    done = CliRunner().invoke(stable_data, ["export", str(tmp_path / "out"), str(tmp_path / "mjcf"), "--format", "mjcf"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "mjcf" / "same" / "scene.xml").is_file()


def test_scenes_without_an_own_library_are_edited_with_another(
    bare: Path, further: Path, lines: list[dict[str, Any]], missing: SceneObject, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(bare, tmp_path / "bare"))
    (root / "Asset_annotation.json").unlink()
    assert AssetLibraries(scenes=str(root)).libraries == ()
    told = [{**lines[0], "scene_id": MesaTaskDataset(root).scene_ids[0]}]
    settings, path = SMALL, file_of(told, tmp_path / "e.jsonl")
    edit(str(root), path, str(tmp_path / "out"), settings, ALONE, [str(further)], report=False)
    assert new_one(tmp_path / "out", missing).asset_id is not None
    with pytest.raises(ConfigError) as caught:
        AssetLibraries([str(root)])
    assert caught.value.code == "library_empty"


@pytest.mark.parametrize(("given", "libraries"), [(["none"], {"own"}), (["FURTHER"], {"own", OTHER})])
def test_the_command_names_the_libraries(
    own: Path, further: Path, lines: list[dict[str, Any]], tmp_path: Path, given: list[str], libraries: set[str]
) -> None:
    told = ["edit", "--scenes", str(own), "--edits", str(file_of(lines, tmp_path / "e.jsonl")), "--out", str(tmp_path / "out")]
    options = [f"--assets={str(further) if place == 'FURTHER' else place}" for place in given]
    done = CliRunner().invoke(app, [*told, *options, "--set=weights=none", "--workers", "0", "--dry-run"])
    inputs = json.loads(done.stdout)["inputs"]
    assert {key.removeprefix("assets.") for key in inputs if key.startswith("assets.")} == libraries
    refused = CliRunner().invoke(app, [*told, *options, "--assets=none", "--assets=embedded"])
    assert refused.exit_code == 2
    assert "none means no further library" in refused.stderr


@pytest.mark.slow
def test_the_embedded_library_serves_by_default(own: Path, lines: list[dict[str, Any]], tmp_path: Path) -> None:
    out = tmp_path / "out"
    told = ["edit", "--scenes", str(own), "--edits", str(file_of(lines, tmp_path / "e.jsonl")), "--out", str(out)]
    done = CliRunner().invoke(app, [*told, "--workers", "0", "--set=weights=none", "--set=num_pictures=0"])
    assert done.exit_code == 0, done.output
    assert {w["code"] for w in RunFolder(str(out)).table("warnings").to_pylist()} >= {"asset_of_other_library"}


def test_a_job_without_further_libraries_has_those_of_its_scenes(
    own: Path, lines: list[dict[str, Any]], tmp_path: Path
) -> None:
    job = EditJob(str(own), file_of(lines, tmp_path / "e.jsonl"), SMALL, ALONE)
    assert [key for key in job.inputs() if key.startswith("assets.")] == ["assets.own"]
