"""Imports run one way: stable_data <- models <- pipelines; heavy libraries stay where they belong."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_IMPORT = {
    "stable_data": {"stable_data"},
    "models": {"stable_data", "models"},
    "pipelines": {"stable_data", "models", "pipelines"},
}
OURS = set(MAY_IMPORT)


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


@pytest.mark.parametrize("package", sorted(OURS))
def test_a_package_imports_only_what_lies_below_it(package: str) -> None:
    for path in modules(package):
        roots = {name.split(".")[0] for name in imports(path)}
        assert roots & OURS <= MAY_IMPORT[package], path


def test_torch_is_imported_by_the_loader_alone() -> None:
    users = {p.name for p in modules("stable_data") if any(n.split(".")[0] == "torch" for n in imports(p))}
    assert users <= {"torch_dataset.py"}


def test_ray_is_imported_by_pipelines_alone() -> None:
    for package in ("stable_data", "models"):
        assert not [p for p in modules(package) if any(n.split(".")[0] == "ray" for n in imports(p))]


def test_the_library_imports_nothing_heavy_by_itself() -> None:
    code = "import sys, stable_data, stable_data.scene, stable_data.errors; print(*sys.modules)"
    import subprocess

    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    assert not {"torch", "trimesh", "igl", "mujoco", "ray", "scipy", "pyarrow"} & set(loaded)


def test_there_are_no_circles_within_a_package() -> None:
    known = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for package in OURS for p in modules(package)}
    edges = {name: {n for n in imports(path) if n in known} for name, path in known.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name not in done:
            for target in edges[name]:
                visit(target, (*trail, name))
            done.add(name)

    for name in known:
        visit(name, ())


def test_versions_are_pinned_in_one_place() -> None:
    constraints = (ROOT / "constraints.txt").read_text("utf-8")
    assert "torch==2.13.0" in constraints
    for path in (ROOT / "pyproject.toml", ROOT / "Makefile", ROOT / ".ci" / "run"):
        assert not re.search(r"[a-z]==\d", path.read_text("utf-8")), path
