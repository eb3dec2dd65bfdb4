"""Exports of runs: what is chosen, what is written, what stops them, and that they go on where they were stopped."""

import errno
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.licences import attribution_text
from stable_data.cli import app
from stable_data.commands.command_line import DONE, NOT_STARTED, SOME_FAILED
from stable_data.export import exporter
from stable_data.export.exporter import _readme, export_run
from stable_data.export.formats import FORMATS
from stable_data.scene import Scene, SceneObject
from stable_data.simulation.run_reader import NEEDED, RunScenes, SceneSelection, SettledPoses
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import scene_row
from tests.object_store import object_store
from tests.stable_data.export.runs import EMPTY, ODD, SCENES, TABLE, at_rest, falling, write_run

pytestmark = pytest.mark.sim


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def content(out: Path) -> dict[str, bytes]:
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file() and p.name != ".lock"}


def last_files(name: str, out: Path) -> list[Path]:
    """The file of each scene that is put in place last."""
    known = [scene for scene in SCENES if name != "mesatask" or scene.scene_id != ODD]  # a name that this format does not take
    return [path for scene in known if (path := FORMATS[name].scene_path(scene, out)).exists()]


@pytest.mark.parametrize("name", sorted(FORMATS.keys() - {"mesatask"}))
def test_every_scene_is_written_whatever_its_name(name: str, run: RunFolder, tmp_path: Path) -> None:
    result = command(run.uri, tmp_path / "out", "--format", name)
    assert result.exit_code == DONE, result.stderr
    assert f"3 of 3 scenes as {name}" in result.stdout
    assert "1 objects have no mesh and are boxes" in result.stdout
    assert len(last_files(name, tmp_path / "out")) == len(SCENES)
    card = (tmp_path / "out" / "README.md").read_text("utf-8")
    assert FORMATS[name].ABOUT in card
    assert "| CC0 | synth | 4 |" in card
    attribution = (tmp_path / "out" / "ATTRIBUTION.md").read_text("utf-8")
    assert "## CC0-1.0\n\nAsked: nothing.\n" in attribution
    assert attribution.count("; synth; stated as CC0\n") == 4


def test_an_attribution_says_what_each_licence_asks_for() -> None:
    given = {"a": "CC BY 4.0", "b": "cc-by-4.0", "c": "CC BY-NC-SA 3.0", "d": "ask\nme", "e": ""}
    text = attribution_text([AssetAnnotation(name, category="mug", raw={"licence": said}) for name, said in given.items()])
    assert (
        "## CC-BY-4.0\n\nAsked: name the author and the licence.\n\n- a: mug; source not known; stated as CC BY 4.0\n" in text
    )
    assert "Asked: name the author and the licence; give changed assets the same licence; do not use them commercially." in text
    assert "## ask me\n\nWhat this licence asks for is not known" in text
    assert "## not known\n" in text


def test_a_scene_that_the_format_cannot_name_is_a_line_and_status_1(run: RunFolder, tmp_path: Path) -> None:
    result = command(run.uri, tmp_path / "out", "--format", "mesatask")
    assert result.exit_code == SOME_FAILED
    assert f"not exported: {ODD}: {ODD!r} cannot name a folder" in result.stderr
    assert "2 of 3 scenes" in result.stdout


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_an_export_that_was_stopped_goes_on(name: str, run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    choice = SceneSelection(scene_ids=("empty", "falling"))
    export_run(run, tmp_path / "whole", name, choice)

    rows = RunScenes.rows

    def one_and_no_more(scenes: RunScenes) -> Iterator[Row]:
        yield next(rows(scenes))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunScenes, "rows", one_and_no_more)
        with pytest.raises(KeyboardInterrupt):
            export_run(run, tmp_path / "out", name, choice)
    there = {path: path.stat().st_mtime_ns for path in last_files(name, tmp_path / "out")}
    assert there
    again = export_run(run, tmp_path / "out", name, choice)
    assert (again.num_written, again.num_existing) == (1, 1)
    assert {path: path.stat().st_mtime_ns for path in there} == there
    assert content(tmp_path / "out") == content(tmp_path / "whole")


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        (SceneSelection(), [s.scene_id for s in SCENES]),
        (SceneSelection(where="num_objects >= 2"), [ODD, "falling"]),
        (SceneSelection(scene_ids=("empty", ODD)), [ODD, "empty"]),
        (SceneSelection(where="num_objects < 6", limit=1), ["falling"]),
        (SceneSelection(limit=0), []),
    ],
)
def test_scenes_are_chosen(choice: SceneSelection, expected: list[str], run: RunFolder) -> None:
    scenes = RunScenes(run, choice)
    assert [scene.scene_id for scene in scenes] == expected
    assert len(scenes) == len(expected)


def test_what_nobody_foresaw_loses_one_scene(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = SceneGeometry.of

    def fail(scene: Scene, *rest: object) -> SceneGeometry:
        if scene.scene_id == "falling":
            raise IndexError("list index\nout of range")
        return written(scene, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(SceneGeometry, "of", fail)
    result = command(run.uri, tmp_path / "out", "--format", "glb")
    assert result.exit_code == SOME_FAILED
    assert "not exported: falling: unexpected IndexError: list index out of range; please report it\n" in result.stderr
    assert "2 of 3 scenes" in result.stdout


def test_settled_poses_come_from_the_table(run: RunFolder) -> None:
    scenes = RunScenes(run, SceneSelection(settled=True))
    for scene in scenes:
        solid = scenes.geometry(scene)
        rest = settle(solid.bodies, scene.table)
        assert rest.settle_move_max_mm is not None
        assert rest.settle_move_max_mm < 0.5
    assert SettledPoses(run).of("unheard of") == {}


def test_a_scene_that_was_never_settled_is_a_line(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", (EMPTY, falling()))
    [path] = run.files("settled")
    Path(path).unlink()
    run.write_shard("settled", "0" * 16, [{"scene_id": "empty", "poses": []}])
    result = command(run.uri, tmp_path / "out", "--format", "glb", "--settled")
    assert result.exit_code == SOME_FAILED
    assert "not exported: falling: no settled pose of ['0_can_0', '1_mug_0']" in result.stderr


def test_a_row_without_an_id_is_a_line(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", (EMPTY,))
    run.write_shard("scenes", "f" * 16, [run.table("scenes").to_pylist()[0] | {"scene_id": None}])
    found = export_run(run, tmp_path / "out", "glb", SceneSelection())
    assert found.num_written == 1
    assert ["None: the row of its scene cannot be used" in failure for failure in found.failures] == [True]


def test_a_body_that_the_engine_refuses_loses_one_scene(tmp_path: Path) -> None:
    flat = SceneObject("0_sheet_0", "sheet", (0.5, 0.4, 0.0), 0.0, (0.1, 0.1, 0.0))
    run = write_run(tmp_path / "run", (EMPTY,))
    blank = run.table("scenes").to_pylist()[0]
    run.write_shard("scenes", "f" * 16, [blank | scene_row(Scene("flat", TABLE, (flat,)))])
    result = command(run.uri, tmp_path / "out", "--format", "mjcf")
    assert result.exit_code == SOME_FAILED
    assert "not exported: flat: body 0_sheet_0: none of its 1 convex parts is solid" in result.stderr
    assert command(run.uri, tmp_path / "out", "--format", "mjcf").stdout.endswith(
        "1 of 2 scenes as mjcf, 1 of them existed already; README.md explains how to open them\n"
    )


@pytest.mark.parametrize("table", NEEDED)
def test_a_run_without_a_table_is_refused(table: str, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", (EMPTY,))
    for path in run.files(table):
        Path(path).unlink()
    result = command(run.uri, tmp_path / "out", "--format", "mjcf")
    assert result.exit_code == NOT_STARTED
    assert f"the run has no table {table}, expected scenes, assets, meshes; preprocess" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_run_that_keeps_no_settled_poses_says_so(tmp_path: Path) -> None:
    bare = write_run(tmp_path / "run", (EMPTY,))
    [path] = bare.files("settled")
    Path(path).unlink()
    for _ in ("no table", "a table without rows"):
        result = command(bare.uri, tmp_path / "out", "--format", "mjcf", "--settled")
        assert result.exit_code == NOT_STARTED
        assert "the run stores no settled poses" in result.stderr
        assert "--set keep_settled=true" in result.stderr
        bare.write_shard("settled", "0" * 16, [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--format", "stl"],
            "format is 'stl', expected one of arena, glb, manipvqa, mesatask, mjcf, mjcf-objects, sdformat, urdf",
        ),
        (["--format", "glb", "--where", "num_objects >"], "cannot be read"),
        (["--format", "glb", "--where", "num_objects > 1000"], "no scene is selected, expected at least one"),
        (["--format", "glb", "--limit", "0"], "no scene is selected, expected at least one"),
        (["--format", "glb", "--scene", "nowhere"], "the run has no scenes ['nowhere']"),
        (["--format", "glb", "--scene", "empty", "--where", "num_objects > 1"], "no scenes ['empty'] where num_objects > 1"),
    ],
)
def test_what_cannot_start_is_one_line_and_status_2(arguments: list[str], message: str, run: RunFolder, tmp_path: Path) -> None:
    result = command(run.uri, tmp_path / "out", *arguments)
    assert result.exit_code == NOT_STARTED
    assert message in result.stderr
    assert result.stderr.strip().count("\n") == 0
    assert not (tmp_path / "out").exists()


def test_a_folder_with_another_export_is_refused(run: RunFolder, tmp_path: Path) -> None:
    assert command(run.uri, tmp_path / "out", "--format", "glb", "--scene", "empty").exit_code == DONE
    for arguments in (["--format", "mjcf", "--scene", "empty"], ["--format", "glb"]):
        result = command(run.uri, tmp_path / "out", *arguments)
        assert result.exit_code == NOT_STARTED
        assert "was made with another configuration" in result.stderr
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").touch()
    assert "contains other files" in command(run.uri, tmp_path / "other", "--format", "glb").stderr


def test_a_run_on_an_object_store_is_exported_the_same(run: RunFolder, tmp_path: Path) -> None:
    with object_store() as uri:
        remote = RunFolder(uri)
        for path in Path(run.root).glob("*/part-*.parquet"):
            remote.write_bytes(path.relative_to(run.root).as_posix(), path.read_bytes())
        for source, out in ((run, tmp_path / "local"), (remote, tmp_path / "remote")):
            assert export_run(source, out, "mjcf", SceneSelection(settled=True, where="num_objects > 0")).num_written == 2
    here, there = content(tmp_path / "local"), content(tmp_path / "remote")
    assert here.pop(exporter.MANIFEST_FILE) != there.pop(exporter.MANIFEST_FILE)  # it says from where
    assert here == there


def test_the_library_exports_without_torch(run: RunFolder, tmp_path: Path) -> None:
    arguments = ["export", run.uri, str(tmp_path / "out"), "--format", "mjcf", "--limit", "1"]
    code = f"import sys; from stable_data.cli import app; app({arguments}, standalone_mode=False); assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == DONE, done.stderr
    assert json.loads((tmp_path / "out" / exporter.MANIFEST_FILE).read_text("utf-8"))["limit"] == 1


def test_objects_keep_their_place_in_the_order(run: RunFolder) -> None:
    scenes = RunScenes(run, SceneSelection(settled=True))
    solid = SceneGeometry.of(at_rest(), scenes.store, SettledPoses(run).of(ODD))
    assert [o.instance for o in solid.scene.objects] == [o.instance for o in at_rest().objects]
    assert replace(solid.scene, objects=()) == replace(at_rest(), objects=())


def test_an_id_that_no_file_can_have_loses_its_scene_only(run: RunFolder, tmp_path: Path) -> None:
    """It once ended the export with the advice to free space."""
    scenes = [replace(EMPTY, scene_id="x" * 300), replace(EMPTY, scene_id="é" * 120), replace(EMPTY, scene_id="plain")]
    odd = write_run(tmp_path / "odd", scenes)
    for name in ("mesatask", "mjcf", "glb"):
        result = command(odd.uri, tmp_path / name, "--format", name)
        if name == "mesatask":
            assert result.exit_code == SOME_FAILED
            assert result.stderr.count("cannot name a folder, expected a plain name of at most 200 bytes") == 2
            assert "1 of 3 scenes" in result.stdout
        else:
            assert result.exit_code == DONE, result.stderr


def test_a_file_system_that_does_not_take_a_name_loses_its_scene_only(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(geometry: SceneGeometry, out: Path) -> None:
        if geometry.scene.scene_id == "empty":
            raise OSError(errno.ENAMETOOLONG, "File name too long")

    monkeypatch.setattr(FORMATS["glb"], "export_scene", refuse)
    result = command(run.uri, tmp_path / "out", "--format", "glb")
    assert result.exit_code == SOME_FAILED
    assert "not exported: empty: File name too long: a name in it cannot be the name of a file here" in result.stderr


def test_names_of_a_run_are_no_markup_in_its_card() -> None:
    hostile = "[free](http://evil) <img src=x> | `rm` # *x*\n# Title \x1b[2J" + "y" * 5000
    asset = AssetAnnotation(hostile, category=hostile, source=hostile, raw={"licence": hostile, "author": hostile})
    for text in (attribution_text([asset]), _readme(FORMATS["glb"], 1, [asset])):
        assert "\x1b" not in text
        assert "<img" not in text.replace("\\<img", "")
        assert "[free](" not in text.replace("\\[free", "")
        assert not any(line.startswith("# Title") for line in text.splitlines())
        assert max(map(len, text.splitlines())) < 5000
