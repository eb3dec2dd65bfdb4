"""The import job: each asset of a folder is one row or one failure, whatever stops it and whoever runs it."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.asset_import.job import ImportJob, import_assets
from pipelines.asset_import.settings import ImportSettings
from pipelines.execution.ray_executor import WorkerPool
from pipelines.sources.assets import AssetLibraries
from stable_data.errors import ConfigError, Notice
from stable_data.importers.source import SourceRef
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from tests.bounds import soon
from tests.pipelines.runs import ROOT, content
from tests.whole import check_whole

SETTINGS = ImportSettings(num_points=64, num_pictures=0, assets_per_shard=2, decomposes=False)
SIZES_CM = {
    "apple": (7.5, 7.5, 7.5),
    "cereal_box": (19, 6, 28),
    "plate": (26, 26, 2.5),
    "book": (21, 15, 3),
    "Größe 5 mug": (11, 8, 9),
}


def write_box(path: Path, size: tuple[float, float, float]) -> None:
    """A box as OBJ, z up."""
    corners = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    lines = ["v " + " ".join(str(c * s) for c, s in zip(corner, size, strict=True)) for corner in corners]
    sides = [(1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (3, 7, 8, 4), (1, 5, 7, 3), (2, 4, 8, 6)]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c} {d}" for a, b, c, d in sides)]) + "\n", "utf-8")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boxes in centimetres as large as what they are named after, two files that are no meshes, and a licence."""
    root = tmp_path_factory.mktemp("source")
    for name, size in SIZES_CM.items():
        write_box(root / f"{name}.obj", size)
    (root / "broken.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "utf-8")
    (root / "empty.stl").write_bytes(b"")
    (root / "LICENSE.txt").write_text("Creative Commons Zero v1.0 Universal\nCC0 1.0\n", "utf-8")
    return root


@pytest.fixture(scope="module")
def library(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("library") / "out"
    import_assets("mesh", str(source), str(out), SETTINGS, WorkerPool())
    return out


def assets_of(library: Path) -> dict[str, Row]:
    return {row["asset_id"]: row for row in RunFolder(str(library)).table("assets").to_pylist()}


def command_of(source: Path, out: Path, *more: str) -> list[str]:
    settings = ["num_points=64", "num_pictures=0", "assets_per_shard=2", "decomposes=false"]
    return ["import", "mesh", str(source), "--out", str(out), *(f"--set={each}" for each in settings), *more]


def test_each_asset_is_one_row_or_one_failure(library: Path) -> None:
    run = RunFolder(str(library))
    rows, failures = assets_of(library), run.table("failures").to_pylist()
    assert {name.replace(" ", "_") for name in rows if "mug" not in name} == {"apple", "cereal_box", "plate", "book"}
    assert sum("mug" in name for name in rows) == 1
    assert sorted(row["id"] for row in failures) == ["broken", "empty"]
    assert all(row["message"] and row["code"] for row in failures)
    assert set(run.table("meshes", ["asset_id"])["asset_id"].to_pylist()) == set(rows)
    assert "name_changed" in run.table("warnings")["code"].to_pylist()


def test_a_library_is_whole(library: Path) -> None:
    assert check_whole(library).rows["assets"] > 0


def test_the_unit_of_the_set_is_found_and_marked(library: Path) -> None:
    for row in assets_of(library).values():
        assert row["scale_inferred"] is True
        assert row["licence"] == "CC0-1.0"
    size = 100 * np.multiply(assets_of(library)["cereal_box"]["extents"], assets_of(library)["cereal_box"]["typical_scale"])
    assert np.abs(np.log(sorted(size) / np.array([6.0, 19.0, 28.0]))).max() < np.log(1.5)


def test_a_stated_unit_is_exact(source: Path, tmp_path: Path) -> None:
    import_assets("mesh", str(source), str(tmp_path / "out"), ImportSettings(unit_m=0.01, num_pictures=0), WorkerPool())
    rows = assets_of(tmp_path / "out")
    for name in ("apple", "cereal_box", "plate", "book"):
        size = np.multiply(rows[name]["extents"], rows[name]["typical_scale"])
        assert sorted(size) == pytest.approx([side / 100 for side in sorted(SIZES_CM[name])], rel=1e-6)
        assert rows[name]["scale_inferred"] is False
        assert rows[name]["size_low"] == rows[name]["size_high"] == pytest.approx(max(SIZES_CM[name]) / 100)


def test_the_library_is_one_that_retrieval_opens(library: Path) -> None:
    found = AssetLibraries((str(library),))
    assert len(found.libraries[0].assets) == len(SIZES_CM)
    assert found.asset_path("apple") is not None
    assert found.physics("apple") is not None


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
@pytest.mark.slow
def test_ray_gives_the_same_bytes_as_this_process(source: Path, library: Path, tmp_path: Path) -> None:
    import_assets("mesh", str(source), str(tmp_path / "out"), SETTINGS, WorkerPool(2))
    assert content(tmp_path / "out") == content(library)


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bytes(source: Path, library: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "pipelines", *command_of(source, out, "--workers", "0")]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None and not list(out.glob("assets/part-*.parquet")):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = CliRunner().invoke(app, command_of(source, out, "--workers", "0"))
    assert done.exit_code == 1, done.output
    assert content(out) == content(library)


def test_changed_files_are_not_mixed_into_a_library(source: Path, library: Path, tmp_path: Path) -> None:
    changed, out = tmp_path / "source", tmp_path / "out"
    shutil.copytree(source, changed)
    shutil.copytree(library, out)
    write_box(changed / "apple.obj", (8, 8, 8))
    done = CliRunner().invoke(app, command_of(changed, out, "--workers", "0"))
    assert done.exit_code == 2
    assert "inputs.files" in done.output


def test_two_assets_of_one_name_are_both_there(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "a").mkdir(parents=True)
    (source / "b").mkdir()
    for folder, side in (("a", 7), ("b", 8)):
        write_box(source / folder / "apple.obj", (side, side, side))
    (source / "manifest.jsonl").write_text(
        "\n".join(json.dumps({"file": f"{f}/apple.obj", "id": "apple", "licence": "CC0-1.0"}) for f in "ab"), "utf-8"
    )
    settings = ImportSettings(manifest="manifest.jsonl", unit_m=0.01, num_pictures=0, decomposes=False)
    job = ImportJob("mesh", str(source), settings)
    manifest = import_assets("mesh", str(source), str(tmp_path / "out"), settings, WorkerPool())
    assert manifest["num_assets"] == job.about()["num_assets"] == 2
    run = RunFolder(str(tmp_path / "out"))
    assert run.num_rows("assets") + run.num_rows("failures") == 2
    told = run.table("warnings").to_pylist() + run.table("failures").to_pylist()
    assert any("apple" in row["message"] and row["code"] in ("asset_renamed", "asset_duplicate") for row in told)


def test_very_many_lost_assets_of_one_name_get_different_ids_soon(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For each of them, names were once made for all."""
    job = ImportJob("mesh", str(source), SETTINGS)
    refs = [SourceRef("apple", "apple.obj", ("apple.obj",)), SourceRef("apple-3", "book.obj", ("book.obj",))]
    lost = [Notice("apple", "find", "file_missing", "apple: is missing")] * 5_000
    monkeypatch.setattr(job, "reader", SimpleNamespace(find=lambda *_: iter([*refs, *lost])))
    with soon(1.0):
        found = [notice.item_id for notice in job.lost()]
    assert found[:3] == ["apple-2", "apple-4", "apple-5"]
    assert len(set(found)) == 5_000
    assert job.about() == {"num_assets": 5_002}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["import", "fbx", "{source}", "--out", "{out}"], "expected one of mesh"),
        (["import", "mesh", "{source}/missing", "--out", "{out}"], "expected the source folder"),
        (["import", "usd", "{source}", "--out", "{out}"], "no assets (kind usd)"),
        (["import", "usd", "{source}", "--out", "{out}", "--preset", "ycb"], "for kind mesh"),
        (["import", "mesh", "{source}", "--out", "{out}", "--licence", "foo"], "no known licence"),
        (["import", "mesh", "{source}", "--out", "{source}/out"], "choose one outside"),
        (["import", "mesh", "{source}", "--out", "{out}", "--manifest", "none.csv"], "none.csv"),
        (["import", "mesh", "{source}", "--out", "{out}", "--preset", "nothing"], "preset"),
        (
            ["import", "mesh", "{source}", "--out", "{out}", "--allow-licence", "foo"],
            "expected one of CC0-1.0, CC-BY, CC-BY-SA",
        ),
        (["import", "mesh", "{source}", "--out", "{out}", "--licence", "free to use"], "names no known licence"),
    ],
)
def test_what_cannot_start_says_so(source: Path, tmp_path: Path, arguments: list[str], message: str) -> None:
    done = CliRunner().invoke(app, [a.format(source=source, out=tmp_path / "out") for a in arguments] + ["--workers", "0"])
    assert done.exit_code == 2, done.output
    assert message in done.output
    assert not (tmp_path / "out").exists()


def test_a_licence_that_is_not_allowed_is_counted(source: Path, tmp_path: Path) -> None:
    other = tmp_path / "source"
    shutil.copytree(source, other)
    (other / "LICENSE.txt").write_text("Creative Commons Attribution-NonCommercial 4.0 International\n", "utf-8")
    done = CliRunner().invoke(app, command_of(other, tmp_path / "out", "--workers", "0"))
    assert done.exit_code == 1
    assert f"licence_refused {len(SIZES_CM)}" in done.output
    assert "--allow-licence" in done.output
    done = CliRunner().invoke(app, command_of(other, tmp_path / "more", "--workers", "0", "--allow-licence", "CC-BY-NC-4.0"))
    assert len(assets_of(tmp_path / "more")) == len(SIZES_CM)


def test_the_job_is_planned_without_a_look_at_geometry(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="no assets"):
        ImportJob("urdf", str(source), SETTINGS).inputs()
