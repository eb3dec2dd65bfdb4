"""Lint on real folders: what was made wrong on purpose is found, what was not is let pass, the page adds up."""

import json
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import stable_data.mesatask.lint
from stable_data.assets.store import AssetStore
from stable_data.diversity.comparison import Coverage
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.lint import LintResult, lint_folder
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from tests.bounds import limit

FEW = ("bathroom_vanity_0435", "office_table_0703", "dining_table_1796")
TOLERANCE = 3e-3  # what settling hulls instead of meshes, and rounding to 0.1 cm, leaves behind


@pytest.fixture(scope="module")
def few(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> LintResult:
    """Three scenes, one of them without most of its meshes, and a layout that is no JSON."""
    root = tmp_path_factory.mktemp("few")
    (root / "Assets_library").mkdir()
    shutil.copy(real_data / "Asset_annotation.json", root)
    dataset = MesaTaskDataset(real_data)
    for scene_id in FEW:
        layout = dataset.layout_path(scene_id)
        folder = root / layout.parent.relative_to(real_data)
        folder.mkdir(parents=True)
        shutil.copy(layout, folder)
        for o in dataset.read(scene_id)[0].objects if scene_id != FEW[2] else ():
            glb = dataset.asset_path(o.asset_id or "")
            assert glb is not None
            shutil.copy(glb, root / "Assets_library")
    bad = root / "Layout_info" / "office_table" / "office_table_9999"
    bad.mkdir()
    (bad / "layout.json").write_text("{")
    return lint_folder(root)


def test_every_scene_is_a_row_or_a_failure(few: LintResult) -> None:
    assert {row["scene_id"] for row in few.rows} == set(FEW)
    assert [failure.item_id for failure in few.failures] == ["office_table_9999"]


def test_a_scene_with_missing_meshes_is_never_a_pass(few: LintResult) -> None:
    row = few.frame().filter(pl.col("scene_id") == FEW[2]).row(0, named=True)
    assert row["num_without_mesh"] > 0
    assert row["clean"] is not True
    assert {"glb_missing"} <= {n.code for n in few.warnings}


def test_the_page_counts_scenes_failures_and_warnings(few: LintResult) -> None:
    page = str(few)
    assert f"3 scenes, 1 not usable, {len(few.warnings)} warnings" in page
    assert "warning glb_missing" in page
    assert "not usable: office_table_9999" in page
    assert re.search(r"scenes with a near-duplicate +0\n", page)


def test_the_page_tells_how_much_of_the_library_is_used(few: LintResult) -> None:
    """The folder has the meshes of two scenes alone, and those of the third are not of the library."""
    assert few.library is not None
    offered = {uid for uid, a in MesaTaskDataset(few.root).annotations.items() if a.is_offered}
    on_disk = {path.stem for path in (few.root / "Assets_library").iterdir()}
    used = {a for s in few.scenes if s.scene_id != FEW[2] for a in s.assets}
    assert few.library.keys() == offered & on_disk
    assert re.search(
        rf"assets of the library that are used +{len(used & offered & on_disk)} of {len(few.library)} \(", str(few)
    )


def test_a_rotated_variant_is_the_asset_of_the_library(tmp_path: Path) -> None:
    write_world(tmp_path, 1, EmbeddedWorld(pictures=False))
    [path] = tmp_path.glob("Layout_info/*/*/layout.json")
    before = lint_folder(tmp_path)
    uid = before.scenes[0].assets[0]
    assert uid is not None
    path.write_text(path.read_text("utf-8").replace(f'"{uid}"', f'"{uid}_x_90_y_0"'), "utf-8")
    after = lint_folder(tmp_path)
    assert f"{uid}_x_90_y_0" in after.scenes[0].assets
    covered = [Coverage.of({a for a in one.scenes[0].assets if a}, one.library) for one in (before, after)]
    assert covered[0] == covered[1]


def test_scenes_that_hardly_differ_are_named(tmp_path: Path) -> None:
    write_world(tmp_path, 1, EmbeddedWorld(pictures=False))
    [first] = tmp_path.glob("Layout_info/*/*")
    shutil.copytree(first, first.parent / "copy")
    found = re.search(r"near-duplicates: (.*), (.*)\n", str(lint_folder(tmp_path)) + "\n")
    assert found is not None
    assert set(found.groups()) == {first.name, "copy"}


def test_the_rows_are_written_as_a_table(few: LintResult, tmp_path: Path) -> None:
    few.write(tmp_path / "out" / "lint.parquet")
    assert pl.read_parquet(tmp_path / "out" / "lint.parquet").equals(few.frame())


def test_an_error_that_nobody_foresaw_is_one_scene_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_world(tmp_path, 2, EmbeddedWorld(pictures=False))
    first, second = MesaTaskDataset(tmp_path).scene_ids

    def audit(scene: Scene, shapes: Sequence[Shape]) -> Audit:
        if scene.scene_id == first:
            raise IndexError("index 3 is out of bounds")
        return audit_scene(scene, shapes)

    monkeypatch.setattr(stable_data.mesatask.lint, "audit_scene", audit)
    result = lint_folder(tmp_path)
    assert [row["scene_id"] for row in result.rows] == [second]
    [lost] = result.failures
    assert (lost.item_id, lost.step, lost.code) == (first, "audit", "unexpected")
    assert f"not usable: {first}: IndexError: index 3 is out of bounds" in str(result)


def test_an_audit_that_was_cut_short_is_a_warning_and_no_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_world(tmp_path, 1, EmbeddedWorld(pictures=False))
    limit(monkeypatch, "work", max_audit_triangles=0)
    result = lint_folder(tmp_path)
    assert [n.code for n in result.warnings] == ["audit_cut_short"]
    assert result.rows[0]["clean"] is not True


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Layout_info"):
        lint_folder(tmp_path)


def missed(audit: Audit, scene_id: str, defects: list[dict[str, Any]]) -> Iterator[tuple[str, str, str]]:
    """Defects that can be measured exactly and are not among the verdicts."""
    verdicts = {o.instance: o for o in audit.objects}
    depths = {frozenset((p.first, p.second)): p.penetration or 0.0 for p in audit.pairs}
    for defect in defects:
        name, kind = defect["instance"], defect["kind"]
        if kind == "interpenetrate" and not defect["mesh_overlap_cm3"]:
            continue  # the hulls overlap, the meshes do not or are open
        verdict = verdicts[name]
        found = {
            "interpenetrate": depths.get(frozenset((name, defect.get("with", ""))), 0.0) > 5e-4,
            "float": verdict.floats is True,
            "sink": verdict.table_penetration > 5e-4,
            "outside_zone": verdict.leaves_table,
            "in_restricted_zone": verdict.enters_restricted_zone,
        }
        if not found[kind]:
            yield scene_id, name, kind


def wrong_objects(audit: Audit) -> set[str]:
    """Objects of a scene that some verdict is against."""
    wrong = {name for p in audit.pairs for name in (p.first, p.second) if (p.penetration or 0.0) > audit.tolerance}
    for o in audit.objects:
        if o.floats or o.table_penetration > audit.tolerance or o.leaves_table or o.enters_restricted_zone:
            wrong.add(o.instance)
    return wrong


def test_defects_are_found_and_clean_scenes_let_pass(measured_data: Path) -> None:
    truth = json.loads((measured_data / "truth.json").read_text())
    dataset = MesaTaskDataset(measured_data)
    store, misses, num_wrong, num_objects = AssetStore(dataset), set(), 0, 0
    for scene_id in dataset.scene_ids:
        scene, _ = dataset.read(scene_id)
        shapes, _ = store.shapes(scene)
        if truth[scene_id]["clean"]:
            num_wrong += len(wrong_objects(audit_scene(scene, shapes, TOLERANCE)))
            num_objects += len(shapes)
        else:
            misses |= set(missed(audit_scene(scene, shapes), scene_id, truth[scene_id]["defects"]))
    assert not misses
    assert num_wrong <= 0.03 * num_objects  # of the small set: none
