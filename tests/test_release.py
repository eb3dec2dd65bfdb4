"""What belongs to a release: the changelog, the citation, the threat model, and the workflows of the public CI."""

import json
import os
import re
import shutil
import subprocess
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

import stable_data
from pipelines.__main__ import app as pipelines
from stable_data.cli import app as stable_data_cli

ROOT = Path(__file__).resolve().parents[1]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text("utf-8")
THREATS = (ROOT / "docs" / "threat_model.md").read_text("utf-8")
GROUPS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
WORKFLOWS: dict[str, Any] = {
    p.name: yaml.safe_load(p.read_text("utf-8")) for p in (ROOT / ".github" / "workflows").glob("*.yml")
}
JOBS = {(name, job): content for name, workflow in WORKFLOWS.items() for job, content in workflow["jobs"].items()}
STEPS = [(name, job, step) for (name, job), content in JOBS.items() for step in content.get("steps", ())]


def released() -> dict[str, date]:
    found = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d{2}-\d{2})$", CHANGELOG, re.MULTILINE)
    return {version: date.fromisoformat(day) for version, day in found}


def test_the_changelog_has_the_form_of_keep_a_changelog() -> None:
    headings = re.findall(r"^## (.+)$", CHANGELOG, re.MULTILINE)
    assert headings[0] == "[Unreleased]"
    assert len(headings) == 1 + len(released()), "each section is [VERSION] - YYYY-MM-DD"
    assert list(released().values()) == sorted(released().values(), reverse=True)
    assert set(re.findall(r"^### (.+)$", CHANGELOG, re.MULTILINE)) <= GROUPS
    unreleased = CHANGELOG.partition("## [Unreleased]")[2].partition("\n## [")[0]
    assert stable_data.__version__ in released() or stable_data.__version__ in unreleased


def test_commands_that_the_changelog_names_are_there() -> None:
    for program, app in (("stable-data", stable_data_cli), ("python -m pipelines", pipelines)):
        known = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
        named = set(re.findall(rf"`{program} ([a-z-]+)", CHANGELOG))
        assert len(named) > 5
        assert named <= known


def test_the_citation_is_complete_and_names_the_paper_as_the_readme_does() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    assert cited["version"] == stable_data.__version__
    assert cited["license"] == tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["license"]
    [paper] = cited["references"]
    readme = (ROOT / "README.md").read_text("utf-8")
    names = " and ".join(f"{author['family-names']}, {author['given-names']}" for author in paper["authors"])
    assert f"{{{names}}}" in readme
    assert f"{paper['identifiers'][0]['value']}}}" in readme
    assert paper["title"].replace("–", "--") in re.sub(r"\{(STABLE)\}", r"\1", readme)


def test_what_the_threat_model_names_is_there() -> None:
    named = set(re.findall(r"`((?:stable_data|models|pipelines|tests|workflows|\.github)/[\w./]+)`", THREATS))
    assert len(named) > 60
    assert {name for name in named if not (ROOT / name).is_file()} == set()
    rows = re.findall(r"^\| .+ \| .+ \| `(.+)` \| `(.+)` \|$", THREATS, re.MULTILINE)
    assert len(rows) > 25
    assert all(tests.startswith("tests/") and not code.startswith("tests/") for code, tests in rows)


def test_attacks_that_once_worked_are_tried_again() -> None:
    section = THREATS.partition("## Attacks that once worked\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ") and not line.startswith("| attack ")]
    assert len(rows) >= 24
    for row in rows:
        named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", row)
        assert named, row
        for file, test in named:
            found = re.search(rf"((?:^@.*\n)*)^def {test}\(", (ROOT / file).read_text("utf-8"), re.MULTILINE)
            assert found, f"{file}::{test}"
            assert "mark.slow" not in found[1], f"{file}::{test}: the page says that it is run by make test"


def test_actions_are_pinned_to_commits_and_keep_no_credentials() -> None:
    used = [(name, step) for name, _, step in STEPS if "uses" in step]
    assert len(used) > 8
    for name, step in used:
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step["uses"]), step["uses"]
        text = (ROOT / ".github" / "workflows" / name).read_text("utf-8")
        assert re.search(rf"uses: {re.escape(step['uses'])} # v\d+\.\d+\.\d+\n", text), "say the version of the commit"
        if step["uses"].startswith("actions/checkout@"):
            assert step["with"]["persist-credentials"] is False
    versions = {step["uses"].partition("@")[0]: step["uses"] for _, step in used}
    assert {step["uses"] for _, step in used} == set(versions.values()), "one action, one commit"


def test_jobs_have_the_least_permissions() -> None:
    assert {name: workflow["permissions"] for name, workflow in WORKFLOWS.items()} == {
        "ci.yml": {"contents": "read"},
        "release.yml": {},
    }
    granted = {job: content["permissions"] for job, content in JOBS.items() if "permissions" in content}
    assert granted == {
        ("release.yml", "ci"): {"contents": "read"},
        ("release.yml", "build"): {"contents": "read"},
        ("release.yml", "publish"): {"id-token": "write"},
        ("release.yml", "announce"): {"contents": "write"},
    }
    assert JOBS["release.yml", "publish"]["environment"]["name"] == "pypi"  # which a person approves
    text = "".join(path.read_text("utf-8") for path in (ROOT / ".github" / "workflows").iterdir())
    assert "pull_request_target" not in text
    assert "secrets." not in text
    scripts = [step["run"] for _, _, step in STEPS if "run" in step]
    assert not [script for script in scripts if "${{" in script], "contexts come as variables of the environment"


def test_the_public_ci_does_what_ci_does_and_the_wheel_with_each_python() -> None:
    runs = {job: [step.get("run", "") for step in content.get("steps", ())] for (_, job), content in JOBS.items()}
    assert "bash .ci/run" in runs["checks"]
    assert "make test-wheel" in (ROOT / ".ci" / "run").read_text("utf-8")
    assert any("-m slow tests/test_wheel.py" in run for run in runs["wheel"])
    assert "make test-all" in runs["all-tests"]
    assert WORKFLOWS["ci.yml"][True]["schedule"]  # YAML reads "on" as true
    assert JOBS["ci.yml", "all-tests"]["if"] == "github.event_name == 'schedule' || startsWith(github.ref, 'refs/tags/v')"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    pythons = JOBS["ci.yml", "wheel"]["strategy"]["matrix"]["python"]
    assert {f"Programming Language :: Python :: {python}" for python in pythons} <= set(project["classifiers"])
    assert {"make wheel", "make sbom LOCKED=1"} <= set(runs["build"])
    assert JOBS["release.yml", "build"]["needs"] == "ci"
    assert JOBS["release.yml", "publish"]["needs"] == "build"
    assert JOBS["release.yml", "announce"]["needs"] == "publish"


@pytest.mark.slow  # installs packages
def test_the_bill_of_materials_names_packages_and_licences() -> None:
    subprocess.run(["make", "sbom"], check=True, cwd=ROOT, capture_output=True)
    found = json.loads((ROOT / "build" / "sbom.cdx.json").read_text("utf-8"))
    assert found["bomFormat"] == "CycloneDX"
    assert found["metadata"]["component"]["name"] == "stable-data"
    packages = {part["name"].lower(): part for part in found["components"]}
    assert {"numpy", "pyarrow", "ray", "torch", "mujoco"} <= packages.keys()
    assert all(packages[name].get("version") for name in packages)
    assert "Apache" in json.dumps(packages["pyarrow"]["licenses"])


def script_of(begin: str) -> str:
    [found] = [step["run"] for _, job, step in STEPS if job == "build" and step.get("name", "").startswith(begin)]
    return str(found)


def run_step(begin: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Runs a step of the job ``build`` as the workflow does."""
    command = ["bash", "-e", "-o", "pipefail", "-c", script_of(begin)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ | variables)


@pytest.fixture
def release(tmp_path: Path) -> Path:
    """A checkout of version 1.2.3."""
    (tmp_path / "stable_data").mkdir()
    (tmp_path / "stable_data" / "__init__.py").write_text('"""Scenes."""\n\n__version__ = "1.2.3"\n')
    older = "## [1.2.2] - 2026-01-02\n\n### Fixed\n\n- Another.\n"
    text = f"# Changelog\n\n## [Unreleased]\n\n## [1.2.3] - 2026-02-03\n\n### Fixed\n\n- One.\n\n{older}"
    (tmp_path / "CHANGELOG.md").write_text(text)
    (tmp_path / "CITATION.cff").write_text("version: 1.2.3\ndate-released: 2026-02-03\n")
    return tmp_path


def test_the_notes_of_a_release_are_its_section_of_the_changelog(release: Path) -> None:
    assert run_step("The tag is", release, TAG="v1.2.3").returncode == 0
    assert (release / "build" / "notes.md").read_text().strip() == "### Fixed\n\n- One."


def test_a_tag_of_another_version_is_refused(release: Path) -> None:
    done = run_step("The tag is", release, TAG="v1.2.4")
    assert done.returncode == 1
    assert done.stdout == "the tag is v1.2.4, expected v1.2.3 of stable_data/__init__.py\n"


def test_a_version_without_a_section_is_refused(release: Path) -> None:
    (release / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n\n- One.\n")
    done = run_step("The tag is", release, TAG="v1.2.3")
    assert done.returncode == 1
    assert done.stdout == "CHANGELOG.md has no section for 1.2.3\n"


def test_a_version_without_a_day_to_cite_is_refused(release: Path) -> None:
    (release / "CITATION.cff").write_text("version: 1.2.3\n")
    done = run_step("The tag is", release, TAG="v1.2.3")
    assert (done.returncode, done.stdout) == (1, "CITATION.cff has no date-released\n")


def test_links_of_the_readme_lead_to_the_repository_on_the_package_index(tmp_path: Path) -> None:
    shutil.copy(ROOT / "README.md", tmp_path)
    assert run_step("Links of", tmp_path, TAG="v1.2.3", REPOSITORY="https://github.com/o/r").returncode == 0
    before, after = (re.findall(r"(!?)\[[^]]*\]\(([^)]+)\)", (f / "README.md").read_text("utf-8")) for f in (ROOT, tmp_path))
    assert len(before) > 50
    for (mark, old), (_, new) in zip(before, after, strict=True):
        kind = "raw" if mark else "blob"
        assert new == (old if old.startswith("http") else f"https://github.com/o/r/{kind}/v1.2.3/{old}")
