"""The wheel holds the light library alone, and works in an empty environment without a compiler, with each extra that it serves."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
DATA = PROJECT["tool"]["setuptools"]["package-data"]["stable_data"]
"""Files of the library that are no modules."""

RUN = ROOT / "tests" / "data" / "run_v3" / "generate"
"""A stored run with two scenes, their assets and meshes."""

SCENES = ("bathroom_vanity_00000", "coffee_table_00001")
"""Its scenes."""

FROM_SOURCE = {"pysdf"}
"""Extras with a package that has no wheel."""

OWN_PINS = {"vllm"}
"""Extras whose packages ask for other versions than ours."""

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
OPENS_MJCF = """
import sys
from pathlib import Path
import mujoco
for path in sorted(Path(sys.argv[1]).glob("*/scene.xml")):
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=5)
    print(path.parent.name, model.nbody > 4, bool(abs(data.qpos).max() < 10))
"""
LOADS_TENSORS = """
import sys
import stable_data as sd
[batch] = sd.TableStream(sys.argv[1], batch_size=2, collate=sd.collate_scenes)
print(len(batch["scene_ids"]), int(batch["mask"].sum()) > 8)
"""
AUDITS = """
import sys
from pathlib import Path
import stable_data as sd
result = sd.lint_folder(Path(sys.argv[2]), progress=False)
print(len(result.rows), sum(row["clean"] for row in result.rows))
"""
STEPS = """
import sys
import stable_data as sd
env = sd.make_env(sys.argv[1], "coffee_table_00001")
env.reset(seed=0)
print(len(env.step(env.action_space.sample())))
"""
SHOWS = """
import sys
import urllib.request
import stable_data as sd
from stable_data.viewer.live import LiveViewer
with LiveViewer(sd.RunFolder(sys.argv[1])) as viewer:
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.server.get_port()}/") as answer:
        print(answer.status)
"""
WRITES_USD = """
import sys
from pathlib import Path
import stable_data as sd
from pxr import Usd
sd.export_run(sd.RunFolder(sys.argv[1]), Path("usd"), "usd", sd.SceneSelection())
for path in sorted(Path("usd", "scenes").glob("*.usda")):
    stage = Usd.Stage.Open(str(path))
    print(path.stem, stage.GetPrimAtPath("/World/Table/Collider").IsValid())
"""
WRITES_LANCE = """
import sys
from stable_data.cli import app
import lance
app(["export", sys.argv[1], "lance", "--format", "lance"], standalone_mode=False)
print(lance.dataset("lance/scenes.lance").count_rows())
"""
SERVED = {
    "torch": (LOADS_TENSORS, ["2 True"]),
    "geometry": (AUDITS, ["12 3"]),
    "lance": (WRITES_LANCE, ["2"]),
    "geometry,sim,env": (STEPS, ["5"]),
    "geometry,sim,view": (SHOWS, ["200"]),
    "geometry,sim,import": (WRITES_USD, ["bathroom_vanity_00000 True", "coffee_table_00001 True"]),
}
"""Extras of the library -> a program that needs them, and the last lines that it prints."""

IMPORTED = {
    "bench": "coacd, embreex",
    "cluster": "boto3, ray.dashboard.modules.job.sdk",
    "dev": "boto3, build, datasets, gymnasium, hypothesis, moto.server, mypy, pandas, sentence_transformers, uv, xdist",
    "docs": "furo, myst_parser, sphinx",
    "geometry,sim,drake": "pydrake.multibody.plant",
    "geometry,sim,sapien": "sapien",
    "models": "llguidance, openai, peft, pydantic, rapidfuzz, safetensors, tensorboard, torch, transformers",
    "pipelines": "jsonschema, pydantic, ray",
}
"""Extras that serve the jobs and their developers -> modules of their packages."""

pytestmark = pytest.mark.slow  # they install packages


@dataclass(frozen=True)
class EmptyEnvironment:
    """A new environment; the only programs that its commands find are its own, so there is no compiler.

    Attributes:
        folder: Its folder.
    """

    folder: Path

    @classmethod
    def create(cls, folder: Path) -> "EmptyEnvironment":
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        made = cls(folder)
        found = made.run(
            "-c", "import shutil; print([c for c in ('cc', 'gcc', 'c++', 'g++', 'clang', 'make') if shutil.which(c)])"
        )
        assert found == "[]\n"
        return made

    def run(self, *arguments: str | Path) -> str:
        """Runs Python; returns what it prints."""
        kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "CC", "CXX")}
        environment = kept | {
            "PATH": str(self.folder / "bin"),
            "OMP_NUM_THREADS": "1",
            "XDG_CACHE_HOME": str(self.folder / "cache"),
        }
        command = [str(self.folder / "bin" / "python"), *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=self.folder, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def install(self, wheel: Path, extras: str = "") -> None:
        """Installs the wheel with the pinned versions."""
        named = f"{wheel}[{extras}]" if extras else str(wheel)
        self.run("-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", named)

    def stable_data(self, *arguments: str | Path) -> str:
        """Runs the command line of the library by its installed name; returns what it prints."""
        return self.run(self.folder / "bin" / "stable-data", *arguments)


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sdist, and the wheel that is built from it."""
    out = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "--outdir", out], check=True, cwd=ROOT, capture_output=True)
    return out


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    [found] = dist.glob("*.whl")
    return found


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A copy of the stored run."""
    return Path(shutil.copytree(RUN, tmp_path / "run"))


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_the_wheel_holds_the_library_alone_and_all_licences(wheel: Path) -> None:
    names = set(contents(wheel))
    data = {path.relative_to(ROOT).as_posix() for pattern in DATA for path in (ROOT / "stable_data").glob(pattern)}
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "stable_data").rglob("*.py")}
    assert {name for name in names if ".dist-info/" not in name} == sources | data
    licences = {name.partition(".dist-info/licenses/")[2] for name in names} - {""}
    assert licences == set(PROJECT["project"]["license-files"])


def test_the_sdist_gives_the_same_wheel_as_the_checkout(dist: Path, wheel: Path, tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"  # a build leaves files behind, which would be in the next wheel
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, tracked.split("\0")):
        if name.startswith("stable_data/") or "/" not in name:
            (checkout / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, checkout / name)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", tmp_path], check=True, cwd=checkout, capture_output=True
    )
    [other] = tmp_path.glob("*.whl")
    assert contents(other) == contents(wheel)
    [sdist] = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {Path(*Path(member.name).parts[1:]).as_posix() for member in archive if member.isfile()}
    assert {"CHANGELOG.md", "CITATION.cff", "SECURITY.md", "pyproject.toml"} <= names
    assert not {name for name in names if name.startswith(("tests/", "models/", "pipelines/"))}


def test_the_library_alone_reads_a_run_and_with_geometry_and_simulation_lints_and_exports(
    dist: Path, wheel: Path, run: Path, tmp_path: Path
) -> None:
    [sdist] = dist.glob("*.tar.gz")
    of_source = EmptyEnvironment.create(tmp_path / "of_source")
    of_source.install(sdist)
    assert of_source.run("-c", READS_A_RUN, run).startswith("2 23\n")

    env = EmptyEnvironment.create(tmp_path / "env")
    env.install(wheel)
    counts, hint = env.run("-c", READS_A_RUN, run).splitlines()
    assert counts == "2 23"
    assert hint.startswith("stable_data.audit_scene needs ")
    assert hint.endswith("pip install 'stable-data[geometry,sim]'")
    assert "1 of 2 scenes" in env.stable_data("query", run, "table_type == 'coffee_table'")
    assert re.search(r"^scenes +2 rows", env.stable_data("inspect", run), re.MULTILINE)

    env.install(wheel, "geometry,sim")
    summary = env.stable_data("lint", ROOT / "tests" / "data", "--quiet")
    assert "12 scenes, 0 not usable, 0 warnings" in summary
    assert re.search(r"^scenes clean .* 3 of 12 ", summary, re.MULTILINE)
    for name in ("mjcf", "glb"):
        assert f"2 of 2 scenes as {name}" in env.stable_data("export", run, tmp_path / name, "--format", name)
    assert env.run("-c", OPENS_MJCF, tmp_path / "mjcf").splitlines() == [f"{name} True True" for name in SCENES]
    assert [path.read_bytes()[:4] for path in sorted((tmp_path / "glb").glob("*.glb"))] == [b"glTF"] * len(SCENES)


@pytest.mark.parametrize("extras", SERVED)
def test_an_extra_works_without_a_compiler(extras: str, wheel: Path, run: Path, tmp_path: Path) -> None:
    program, expected = SERVED[extras]
    env = EmptyEnvironment.create(tmp_path / "env")
    env.install(wheel, extras)
    assert env.run("-c", program, run, ROOT / "tests" / "data").splitlines()[-len(expected) :] == expected


@pytest.mark.parametrize("extras", IMPORTED)
def test_the_packages_of_an_extra_fit_together(extras: str, wheel: Path, tmp_path: Path) -> None:
    env = EmptyEnvironment.create(tmp_path / "env")
    env.install(wheel, extras)
    env.run("-c", f"import {IMPORTED[extras]}")
    assert env.run("-m", "pip", "check").startswith("No broken requirements")


def test_every_extra_is_installed_by_a_test() -> None:
    tried = {extra for extras in (*SERVED, *IMPORTED) for extra in extras.split(",")}
    assert tried | FROM_SOURCE | OWN_PINS == set(PROJECT["project"]["optional-dependencies"])


@pytest.mark.parametrize("extra", PROJECT["project"]["optional-dependencies"])
def test_every_extra_but_pysdf_has_wheels_alone(extra: str, wheel: Path, tmp_path: Path) -> None:
    uv = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    assert uv, "uv is not installed; run make env"
    command = [uv, "pip", "install", "--dry-run", "--no-build", "--python", sys.executable, "--target", str(tmp_path / "none")]
    pins = [] if extra in OWN_PINS else ["-c", str(ROOT / "constraints.txt")]
    done = subprocess.run([*command, *pins, f"stable-data[{extra}] @ {wheel.as_uri()}"], capture_output=True, text=True)
    if extra in FROM_SOURCE:
        assert "building from source is disabled" in done.stderr
    else:
        assert done.returncode == 0, done.stderr
        assert re.search(r"^ \+ stable-data", done.stderr, re.MULTILINE)
