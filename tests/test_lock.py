"""requirements.lock fixes every package of the environment with its hashes, and its versions are those of constraints.txt."""

import re
import subprocess
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
ENTRY = re.compile(
    r"^([a-z0-9.-]+)(?:\[[\w,-]+\])?==(\S+)(?: ; [^\\\n]+)? \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", re.MULTILINE
)
EXTRAS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
BASE: list[str] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["dependencies"]


def locked() -> dict[str, set[str]]:
    """Package -> its versions; a package may have one for each version of Python."""
    found: dict[str, set[str]] = {}
    for name, version, _ in ENTRY.findall((ROOT / "requirements.lock").read_text("utf-8")):
        found.setdefault(name, set()).add(version)
    return found


LOCKED = locked()


def pinned() -> dict[str, str]:
    pins = re.findall(r"^([\w-]+)==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.MULTILINE)
    return {canonicalize_name(name): version for name, version in pins}


def extras_of(text: str) -> set[str]:
    return set(re.findall(r"--extra ([a-z]+)", text))


def planned(target: str, *settings: str) -> str:
    command = ["make", "-n", "-W", "pyproject.toml", "-f", str(ROOT / "Makefile"), target, *settings]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout


def test_the_file_has_nothing_but_entries_with_hashes() -> None:
    text = (ROOT / "requirements.lock").read_text("utf-8")
    assert not re.sub(r"^#.*\n", "", ENTRY.sub("", text), flags=re.MULTILINE).strip()
    assert len(LOCKED) > 150


def test_versions_are_those_of_the_constraints() -> None:
    both = pinned().keys() & LOCKED.keys()
    assert {name: LOCKED[name] for name in both} == {name: {version} for name, version in pinned().items() if name in both}
    assert len(both) > 50


@pytest.mark.parametrize("extra", sorted(extras_of(planned("lock"))))
def test_what_an_extra_asks_for_is_locked(extra: str) -> None:
    for text in (*BASE, *EXTRAS[extra]):
        requirement = Requirement(text)
        versions = LOCKED[canonicalize_name(requirement.name)]
        assert all(Version(version) in requirement.specifier for version in versions), text


def asked_by(name: str) -> Iterator[str]:
    """The packages that an installed package asks for here."""
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield canonicalize_name(requirement.name)


def test_what_a_locked_package_asks_for_is_locked_too() -> None:
    missing = set()
    for name in LOCKED:
        try:
            missing |= {f"{name} asks for {other}" for other in asked_by(name) if other not in LOCKED}
        except PackageNotFoundError:  # of another system, or of an extra that is not installed here
            continue
    assert not missing


def test_what_is_built_from_source_has_a_hash_and_what_its_build_needs_is_locked() -> None:
    text = (ROOT / "requirements-source.lock").read_text("utf-8")
    assert [(name, version) for name, version, _ in ENTRY.findall(text)] == [("pysdf", pinned()["pysdf"])]
    assert {"cmeel-eigen", "pybind11", "setuptools"} <= LOCKED.keys()


def test_make_env_can_take_the_lock() -> None:
    extras = extras_of(planned("lock"))
    fixed = planned("env", "LOCKED=1", "VENV=elsewhere").replace("\\\n", " ").splitlines()
    installed = [line for line in fixed if "pip install" in line]
    assert len(installed) == 3
    for line in installed:  # nothing without a hash, but for the checkout itself; and nothing for a build is fetched
        assert "--require-hashes" in line or line.endswith("--no-deps --no-build-isolation -e .")
        assert "--only-binary :all:" in line or "--no-build-isolation" in line
    plain = planned("env", "VENV=elsewhere")
    assert "--require-hashes" not in plain
    (installed,) = re.findall(r"-e '\.\[([a-z,]+)\]'", plain)
    assert set(installed.split(",")) - extras == {"pysdf"}  # it ships as source, which needs a compiler
