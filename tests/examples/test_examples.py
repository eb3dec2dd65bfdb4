"""Every example runs as its first lines say, and is short."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from PIL import Image

from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.export.runs import at_rest, falling, write_run

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("[!_]*.py"))
COLLIDING = "dining_table_0458"
"""A scene of ``tests/data``: a mug was pushed into a cup."""


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Two scenes with the meshes of their assets."""
    return write_run(tmp_path_factory.mktemp("examples") / "run", [at_rest(), falling()])


@pytest.fixture(scope="session")
def folder(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in the MesaTask-10K format with one scene."""
    root = tmp_path_factory.mktemp("examples") / "data"
    shutil.copytree(real_data, root)
    for layout in root.glob("Layout_info/*/*"):
        if layout.name != COLLIDING:
            shutil.rmtree(layout)
    return root


def run_example(name: str, *arguments: object) -> None:
    """Runs an example as ``python -m examples.<name>`` does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_module(f"examples.{name}", run_name="__main__")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_says_how_it_is_run_and_is_tested(path: Path) -> None:
    text, tests = path.read_text("utf-8"), Path(__file__).parents[1].rglob("test_*.py")
    assert text.count("\n") < 60
    assert re.search(rf"python -m examples\.{path.stem}\b", text)
    is_tested = re.compile(rf'run_example\("{path.stem}"|from examples\.{path.stem} import')
    assert any(is_tested.search(test.read_text("utf-8")) for test in tests)


def test_load_run(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    run_example("load_run", run.uri)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "2 of 2 scenes are clean and have two objects or more"
    assert len(lines) == 3 + len(at_rest().objects) + len(falling().objects)


def test_audit_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_example("audit_folder", folder)
    first = capsys.readouterr().out.splitlines()[0]
    assert re.match(rf"{COLLIDING}: colliding \['\w*(mug|cup)\w* and \w*(mug|cup)\w*'\]", first)


def test_correct_scene(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_example("correct_scene", folder, COLLIDING)
    out = capsys.readouterr().out
    assert out.startswith(f"{COLLIDING}: certified")
    assert " mm" in out


def test_train_policy(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    run_example("train_policy", run.uri)
    losses = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]
    assert losses[1] < losses[0]


def test_own_exporter(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_example("own_exporter", run.uri, tmp_path / "poses")
    assert capsys.readouterr().out == "2 scenes written, 0 failed\n"
    rows = (tmp_path / "poses" / "falling.csv").read_text("utf-8").splitlines()
    assert rows[0] == "instance,x,y,z,yaw"
    assert len(rows) == 1 + len(falling().objects)


def test_draw_scenes(run: RunFolder, tmp_path: Path) -> None:
    try:
        run_example("draw_scenes", run.uri, tmp_path / "pictures", "falling")
    except ConfigError as error:
        if error.code == "no_gl":
            pytest.skip(str(error))
        raise
    (file,) = (tmp_path / "pictures").iterdir()
    with Image.open(file) as picture:
        assert (file.name, picture.size) == ("falling.png", (480, 300))
        assert len(picture.convert("RGB").getcolors(1 << 20) or ()) > 50  # a scene, not a blank sheet


@pytest.mark.slow
@pytest.mark.sim
def test_generate_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_example("generate_scenes", tmp_path / "scenes", 2)
    assert capsys.readouterr().out.splitlines()[-1] == "2 of 2 scenes are clean and stable"
