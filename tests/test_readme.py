"""What the README and CONTRIBUTING name is there, and the README's commands run as they are written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from models.semantic_reasoner.engines.registry import EMBEDDED
from stable_data.cli import app as stable_data
from stable_data.embedded_world import EmbeddedWorld, write_world
from tests.stable_data.export.runs import write_run
from tests.stable_data.robot.tables import asked_table

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text("utf-8")
TEXT = README + (ROOT / "CONTRIBUTING.md").read_text("utf-8")
FIRST = ("make demo", "make test")
"""They make an environment; CI begins with the second."""
COMMANDS = [
    line
    for block in re.findall(r"^```\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
    if not line.startswith(FIRST)
]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in the MesaTask-10K format; without meshes, so that it is quickly done."""
    root = tmp_path_factory.mktemp("scenes")
    write_world(root, 2, EmbeddedWorld(pictures=False))
    shutil.rmtree(root / "Assets_library")
    return root


def test_both_commands_are_on_the_first_screen() -> None:
    first = "\n".join(README.splitlines()[:20])
    assert all(command in first for command in FIRST)


def test_there_are_commands_to_run() -> None:
    assert {command.split()[0] for command in COMMANDS} == {"make", "python", "stable-data"}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the README imports as a library."""
    out = tmp_path_factory.mktemp("gazebo") / "library"
    models = ROOT / "tests" / "data" / "import" / "gazebo"
    done = CliRunner().invoke(stable_data, ["import", "sdformat", str(models), "--out", str(out), "--workers", "0"])
    assert done.exit_code == 0, done.output
    return out


LONG = (" preprocess ", " generate ", " correct ", " demonstrate ", " import sdformat ", " synth ")
"""Words of commands that take long, which the default tests of their jobs run too; what generate would do is planned here."""


@pytest.mark.ray
@pytest.mark.parametrize(
    ("command", "more"),
    [
        *(pytest.param(c, "", marks=pytest.mark.slow if any(word in c for word in LONG) else ()) for c in COMMANDS),
        *((c, " --dry-run") for c in COMMANDS if c.startswith("python -m pipelines generate")),
    ],
)
def test_every_command_runs_as_written(
    command: str, more: str, scenes: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if "generate" in command and not (EMBEDDED / "config.json").is_file():
        pytest.skip("the weights of the embedded reasoner are not in this checkout")
    places = {"/data/MesaTask-10K": scenes, "/data/mesatask-tables": tmp_path / "run", "s3://bucket/mesatask": tmp_path / "run"}
    places |= {
        "/data/mesatask-clean": tmp_path / "clean",
        "/data/scenes": tmp_path / "scenes",
        "/data/demonstrations": tmp_path / "demonstrations",
        "/data/apple": tmp_path / "apple",
        "/data/gazebo_models": ROOT / "tests" / "data" / "import" / "gazebo",
        "/data/gazebo-library": tmp_path / "library",
        "/data/real-scenes": tmp_path / "real-scenes",
    }
    places |= {"audit.parquet": tmp_path / "audit.parquet", "/data/world": tmp_path / "world"}
    if "ASSETS=" in command:
        places["/data/gazebo-library"] = request.getfixturevalue("library")
    few = {"--scenes 1000": "--scenes 3", "COUNT=1000": "COUNT=3", "COUNT=200": "COUNT=3"}  # as many as a test has time for
    few["--workers 2"] = "--workers 0"  # `make preprocess` is the command that starts a Ray here
    if "demonstrate" in command:
        places["/data/scenes"] = Path(write_run(tmp_path / "asked", (asked_table(),)).root)
        few["--robot panda"] = "--robot simple"  # whose files are part of the library
    if command.startswith("stable-data robots"):
        few[" --fetch panda"] = ""  # there may be no network: the command lists the robots
    for written, here in (places | few).items():
        command = command.replace(written, str(here))
    binaries = Path(sys.executable).parent
    if command.startswith("make"):
        command += f" BIN={binaries} -o .venv/.ready"  # the environment is this one
    command += more
    if "--address" in command:
        command += " --dry-run"  # there is no cluster here
    elif re.match(r"python -m pipelines (correct|generate|demonstrate)|stable-data import", command):
        command += " --workers 0 --set num_pictures=0"
    done = subprocess.run(
        ["bash", "-c", command],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PATH": f"{binaries}:{os.environ['PATH']}"},
    )
    assert done.returncode == 0, done.stderr
    assert "error" not in done.stderr
    assert list(tmp_path.iterdir()) or "--dry-run" in command or "robots" in command


@pytest.mark.parametrize("target", sorted(set(re.findall(r"`?make ([a-z-]+)", TEXT))))
def test_every_make_target_exists(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)


def test_make_help_lists_every_public_target() -> None:
    listed = subprocess.run(["make", "help"], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    for target in ("demo", "test", "lint", "preprocess", "bench", "schemas", "clean"):
        assert f"make {target}" in listed


@pytest.mark.parametrize("target", ["preprocess", "bench"])
def test_what_takes_the_embedded_set_makes_it(target: str, tmp_path: Path) -> None:
    command = ["make", "-n", "-o", ".venv/.ready", "-f", str(ROOT / "Makefile"), target]
    planned = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout
    assert planned.index("synth data/embedded") < planned.index("--data data/embedded")
