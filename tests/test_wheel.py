"""The wheel holds the light library alone, and reads a run in an empty environment with the base dependencies."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.stable_data.storage import small_run

ROOT = Path(__file__).resolve().parents[1]
READS_A_RUN = """
import sys
import stable_data as sd
assert set(sys.modules).isdisjoint({"pyarrow", "numpy", "torch", "scipy"}), "import stable_data loads more than itself"
run = sd.RunFolder(sys.argv[1])
scenes = [sd.scene_from_row(row) for row in run.table("scenes").to_pylist()]
print(len(scenes), sum(len(scene.objects) for scene in scenes))
try:
    sd.audit_scene
except ModuleNotFoundError as error:
    print(error)
"""

DATA = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["package-data"]["stable_data"]
"""Files of the library that are no modules."""

pytestmark = pytest.mark.slow  # both tests install packages


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "--outdir", out], check=True, cwd=ROOT, capture_output=True)
    [found] = out.glob("*.whl")
    return found


def test_the_wheel_holds_the_library_alone(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    data = {path.relative_to(ROOT).as_posix() for pattern in DATA for path in (ROOT / "stable_data").glob(pattern)}
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "stable_data").rglob("*.py")}
    assert {name for name in names if ".dist-info/" not in name} == sources | data


def test_an_empty_environment_reads_a_run(wheel: Path, tmp_path: Path) -> None:
    run = small_run.write_run(tmp_path / "run")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "env"], check=True)
    python = tmp_path / "env" / "bin" / "python"
    options = ["--quiet", "--only-binary", ":all:", "-c", str(ROOT / "constraints.txt")]
    install = [str(python), "-m", "pip", "install", *options, str(wheel)]
    subprocess.run(install, check=True, cwd=tmp_path)
    done = subprocess.run([python, "-c", READS_A_RUN, run], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    counts, hint = done.stdout.splitlines()
    assert counts == f"{small_run.NUM_ROWS} {sum(len(scene.objects) for scene in small_run.SCENES)}"
    assert hint.startswith("stable_data.audit_scene needs ")
    assert hint.endswith("pip install 'stable-data[geometry,sim]'")
    subprocess.run([tmp_path / "env" / "bin" / "stable-data", "inspect", "--help"], check=True, capture_output=True)
