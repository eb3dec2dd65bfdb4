"""The version that manifests name: one for the same sources, another where a module differs."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import stable_data
from stable_data.code_version import code_version, digest_of, release_of

ROOT = Path(stable_data.__file__).resolve().parents[1]


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The modules of the toolkit elsewhere."""
    for path in ROOT.glob("*/**/*.py"):
        name = path.relative_to(ROOT)
        if name.parts[0] in ("stable_data", "models", "pipelines"):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, tmp_path / name)
    return tmp_path


def test_it_is_the_version_with_a_hash() -> None:
    assert re.fullmatch(rf"{re.escape(stable_data.__version__)}\+[0-9a-f]{{12}}", code_version())
    assert release_of(code_version()) == release_of(stable_data.__version__) == stable_data.__version__


def test_another_process_with_the_same_files_elsewhere_says_the_same(copied: Path) -> None:
    code = "from stable_data.code_version import code_version; print(code_version())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=copied).stdout
    assert said.strip() == f"{stable_data.__version__}+{digest_of(ROOT)}"


@pytest.mark.parametrize(
    ("change", "is_other"),
    [
        (lambda root: (root / "models" / "dual_system" / "batching.py").write_text("a = 1\n"), True),
        (
            lambda root: (root / "models" / "dual_system" / "batching.py").rename(
                root / "models" / "dual_system" / "schedule.py"
            ),
            True,
        ),
        (lambda root: (root / "pipelines" / "new.py").write_text(""), True),
        (lambda root: (root / "stable_data" / "embedded_world" / "modelling" / "solids.py").unlink(), True),
        (lambda root: (root / "pipelines" / "notes.md").write_text("a"), False),
        (lambda root: (root / "new.py").write_text("a = 1\n"), False),
        (lambda root: (root / "models" / ".#batching.py").symlink_to("user@host.1234"), False),  # an editor's lock
        (lambda root: (root / "models" / "notes.py").mkdir(), False),
    ],
)
def test_it_is_another_where_a_module_is(copied: Path, change: Callable[[Path], object], is_other: bool) -> None:
    before = digest_of(copied)
    change(copied)
    assert (digest_of(copied) != before) is is_other


def test_the_light_library_alone_has_one_too(copied: Path) -> None:
    for package in ("models", "pipelines"):
        shutil.rmtree(copied / package)
    assert digest_of(copied) != digest_of(ROOT)
