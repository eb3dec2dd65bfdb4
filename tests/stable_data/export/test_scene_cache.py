"""A scene that did not change is copied, byte for byte; what changed is made; the cache is bounded, checked and shared."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from typer.testing import CliRunner

from stable_data.atomic_files import write_file_atomically
from stable_data.cli import app
from stable_data.export import scene_cache
from stable_data.export.exporter import export_run
from stable_data.export.formats import FORMATS
from stable_data.simulation.run_reader import SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "stable-data" / "exports"


def files(folder: Path) -> dict[str, bytes]:
    """The files of an export, without those that name its run."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name not in (".lock", "export.json"))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def copied(run: Path, to: Path, table: str, change: Any) -> RunFolder:
    """A copy of a run with changed rows of a table."""
    shutil.copytree(run, to)
    folder = RunFolder(str(to))
    for path in folder.files(table):
        rows = folder.read_file(table, path).to_pylist()
        changed = pa.Table.from_pylist([change(row) for row in rows], SCHEMAS[table])
        folder.write_table(table, Path(path).stem.removeprefix("part-"), changed)
    return folder


@pytest.mark.parametrize(
    "name",
    [name if name in ("mjcf", "sdformat", "usd") else pytest.param(name, marks=pytest.mark.slow) for name in sorted(FORMATS)],
)
def test_a_second_export_copies_the_same_files(name: str, run: RunFolder, tmp_path: Path) -> None:
    plain = export_run(run, tmp_path / "plain", name, SceneSelection())
    first = export_run(run, tmp_path / "first", name, SceneSelection(), is_cached=True)
    again = copied(Path(run.root), tmp_path / "copy", "scenes", lambda row: row)
    second = export_run(again, tmp_path / "second", name, SceneSelection(), is_cached=True)
    assert (first.num_written, first.num_cached, first.num_boxes) == (plain.num_written, 0, plain.num_boxes)
    assert (second.num_written, second.num_cached, second.num_boxes) == (plain.num_written, plain.num_written, plain.num_boxes)
    assert first.failures == plain.failures == second.failures
    assert files(tmp_path / "plain") == files(tmp_path / "first") == files(tmp_path / "second")
    alone = export_run(run, tmp_path / "alone", name, SceneSelection(scene_ids=("falling",)), is_cached=True)
    made = export_run(run, tmp_path / "made", name, SceneSelection(scene_ids=("falling",)))
    assert (alone.num_cached, made.num_cached) == (1, 0)
    assert files(tmp_path / "alone") == files(tmp_path / "made")


def test_a_mesh_that_is_refused_is_no_box_in_exports_of_others(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run states the hashes of meshes of another one with other content, and is exported first."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    plain = export_run(run, tmp_path / "plain", "glb", SceneSelection())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))
    hostile = copied(Path(run.root), tmp_path / "hostile", "meshes", lambda row: {**row, "glb": row["glb"] + bytes(4)})
    refused = export_run(hostile, tmp_path / "refused", "glb", SceneSelection(), is_cached=True)
    assert refused.num_boxes > plain.num_boxes
    honest = export_run(run, tmp_path / "honest", "glb", SceneSelection(), is_cached=True)
    assert honest.num_boxes == plain.num_boxes
    assert files(tmp_path / "honest") == files(tmp_path / "plain")


def test_what_changed_is_made(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    total = export_run(run, tmp_path / "out", "glb", SceneSelection(), is_cached=True).num_written

    def moved(row: dict[str, Any]) -> dict[str, Any]:
        if row["scene_id"] == "falling":
            row["objects"][0]["yaw"] += 0.1
        return row

    other = copied(Path(run.root), tmp_path / "moved", "scenes", moved)
    result = export_run(other, tmp_path / "moved_out", "glb", SceneSelection(), is_cached=True)
    assert (result.num_written, result.num_cached) == (total, total - 1)
    assert (tmp_path / "moved_out" / "falling.glb").read_bytes() != (tmp_path / "out" / "falling.glb").read_bytes()

    licensed = copied(Path(run.root), tmp_path / "licensed", "assets", lambda row: row | {"licence": "CC-BY-4.0"})
    result = export_run(licensed, tmp_path / "licensed_out", "glb", SceneSelection(), is_cached=True)
    assert result.num_cached == 1  # the scene without objects

    parts = copied(Path(run.root), tmp_path / "parts", "meshes", lambda row: row | {"parts_method": "hull"})
    assert export_run(parts, tmp_path / "parts_out", "glb", SceneSelection(), is_cached=True).num_cached == 1

    monkeypatch.setattr(scene_cache, "code_version", lambda: "other")
    assert export_run(run, tmp_path / "code_out", "glb", SceneSelection(), is_cached=True).num_cached == 0


@pytest.mark.slow
def test_damage_and_loss_cost_time_only(run: RunFolder, tmp_path: Path, cache: Path) -> None:
    export_run(run, tmp_path / "out", "mjcf", SceneSelection(), is_cached=True)
    for number, damage in enumerate((b"", b"x", b"{}", b'{"files": {"../evil": "00"}, "num_boxes": 0}', None)):
        for path in cache.rglob("*"):
            if path.is_file() and (number % 2 == 0 or path.suffix == ".json"):
                path.unlink() if damage is None else path.write_bytes(damage)
        place = tmp_path / f"out{number}"
        assert export_run(run, place, "mjcf", SceneSelection(), is_cached=True).num_cached == 0
        assert files(place) == files(tmp_path / "out")
    assert not (tmp_path / "evil").exists()


def test_the_cache_is_bounded(run: RunFolder, tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_cache, "MAX_CACHE_BYTES", 200_000)
    for name in ("glb", "mjcf", "mesatask"):
        export_run(run, tmp_path / name, name, SceneSelection(), is_cached=True)
        assert sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) <= 200_000
    assert files(tmp_path / "mjcf")
    again = export_run(run, tmp_path / "again", "mjcf", SceneSelection(), is_cached=True)
    assert not again.failures
    assert files(tmp_path / "again") == files(tmp_path / "mjcf")


def test_without_a_folder_scenes_are_made(run: RunFolder, tmp_path: Path, cache: Path) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_text("in the way")
    result = export_run(run, tmp_path / "out", "glb", SceneSelection(), is_cached=True)
    assert (result.num_cached, result.failures) == (0, ())
    assert (tmp_path / "out" / "falling.glb").exists()


@pytest.mark.slow
def test_two_processes_at_once(run: RunFolder, tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; import stable_data as sd\n"
        "r = sd.export_run(sd.RunFolder(sys.argv[1]), Path(sys.argv[2]), 'mjcf', sd.SceneSelection(), is_cached=True)\n"
        "assert not r.failures"
    )
    both = [subprocess.Popen([sys.executable, "-c", code, run.root, str(tmp_path / name)]) for name in ("one", "other")]
    assert [process.wait() for process in both] == [0, 0]
    export_run(run, tmp_path / "plain", "mjcf", SceneSelection())
    assert files(tmp_path / "one") == files(tmp_path / "other") == files(tmp_path / "plain")


def test_formats_of_other_programs_are_made(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Names:
        ABOUT = "Names."

        def scene_path(self, scene: Any, out: Path) -> Path:
            return out / f"{len(scene.objects)}.txt"

        def export_scene(self, geometry: Any, out: Path) -> None:
            self.scene_path(geometry.scene, out).write_text(geometry.scene.scene_id)

    monkeypatch.setitem(FORMATS, "names", Names())
    for number in range(2):
        result = export_run(run, tmp_path / str(number), "names", SceneSelection(), is_cached=True)
        assert result.num_cached == 0
        assert result.num_written + result.num_existing > 0


def test_query_with_a_format_is_a_cached_export(run: RunFolder, tmp_path: Path) -> None:
    where = "num_objects >= 0 or num_objects is None"
    asked = ["query", run.root, where, "--to", str(tmp_path / "out"), "--format", "glb"]
    first = CliRunner().invoke(app, asked)
    assert first.exit_code == 0, first.stderr
    assert "0 were copied from the cache" in first.stdout
    exported = CliRunner().invoke(app, ["export", run.root, str(tmp_path / "other"), "--format", "glb", "--cached"])
    assert "3 were copied from the cache" in exported.stdout
    assert files(tmp_path / "out") == files(tmp_path / "other")
    for wrong, said in (
        (["query", run.root, where, "--format", "glb"], "name it with --to"),
        (["query", run.root, "objects > 1", "--to", str(tmp_path / "x"), "--format", "glb"], "query 'objects > 1' names"),
        (["query", run.root, where, "--to", str(tmp_path / "x"), "--format", "stl"], "format is 'stl'"),
    ):
        refused = CliRunner().invoke(app, wrong)
        assert refused.exit_code == 2
        assert said in refused.stderr
        assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", ["urdf", "usd"])
def test_what_says_that_a_thing_is_complete_is_put_in_place_after_it(
    name: str, run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that an export that was stopped goes on without the cache."""
    choice = SceneSelection(scene_ids=("falling",))
    export_run(run, tmp_path / "whole", name, choice, is_cached=True)
    num_files, write = len(files(tmp_path / "whole")), write_file_atomically
    for count in (num_files // 4, num_files // 2, num_files - 6):
        left = iter(range(count))

        def stop(path: Path, content: bytes, left: Any = left) -> None:
            if "out" in str(path.relative_to(tmp_path)):
                next(left)  # ends with StopIteration
            write(path, content)

        out = tmp_path / f"out_{count}"
        with monkeypatch.context() as patch:
            patch.setattr(scene_cache, "write_file_atomically", stop)
            export_run(run, out, name, choice, is_cached=True)
        export_run(run, out, name, choice)
        assert files(out) == files(tmp_path / "whole")
