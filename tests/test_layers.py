"""Imports run one way: stable_data <- models <- pipelines; heavy libraries stay where they belong."""

import ast
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import networkx as nx
import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_IMPORT = {
    "stable_data": {"stable_data"},
    "models": {"stable_data", "models"},
    "pipelines": {"stable_data", "models", "pipelines"},
}
OURS = set(MAY_IMPORT)
COMMANDS = {"stable_data.cli", "stable_data.__main__"}
MOST_MODULES = 20


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@cache
def imports(path: Path) -> tuple[str, ...]:
    found = list[str]()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            found += (node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names))
    return tuple(found)


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


def test_viser_is_imported_by_the_live_viewer_alone() -> None:
    users = {p.name for o in OURS for p in modules(o) if any(n.split(".")[0] == "viser" for n in imports(p))}
    assert users == {"live.py"}


def test_the_library_imports_nothing_heavy_by_itself() -> None:
    code = "import sys, stable_data, stable_data.scene, stable_data.errors; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    assert not {"torch", "trimesh", "igl", "mujoco", "ray", "scipy", "pyarrow"} & set(loaded)


def test_processes_that_read_foreign_files_do_without_torch() -> None:
    """One is started for a file or an asset, and torch takes longer to import than most of them to read."""
    jobs = ("asset_import.shard", "correct.scene_shard", "preprocess.shard", "scene_files.importing", "supports.preparing")
    code = f"import sys, {', '.join(f'pipelines.{job}' for job in jobs)}; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == ["False"]


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


def folder_of(name: str, path: Path) -> str:
    """The folder of a module. The commands in stable_data count as a folder of their own, above all others of the library."""
    return name if name in COMMANDS else ".".join(path.relative_to(ROOT).parent.parts)


def edges_between_folders() -> dict[tuple[str, str], list[str]]:
    """Every import of ours that leaves its folder: (folder, folder that it imports from) -> the imports."""
    paths = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for o in OURS for p in modules(o)}
    edges: dict[tuple[str, str], list[str]] = {}
    for name, path in paths.items():
        for target in sorted({n for n in imports(path) if n in paths}):
            ends = folder_of(name, path), folder_of(target, paths[target])
            if ends[0] != ends[1]:
                edges.setdefault(ends, []).append(f"{name} imports {target}")
    return edges


def test_there_are_no_circles_between_folders() -> None:
    edges = edges_between_folders()
    circles = [c for c in nx.strongly_connected_components(nx.DiGraph(list(edges))) if len(c) > 1]
    offending = [line for ends, lines in edges.items() if any(set(ends) <= c for c in circles) for line in lines]
    assert not offending, "these imports close circles between folders:\n" + "\n".join(offending)


def test_the_modules_directly_in_stable_data_are_the_lowest_layer() -> None:
    offending = [line for (folder, _), lines in edges_between_folders().items() if folder == "stable_data" for line in lines]
    assert not offending, "a module directly in stable_data imports from a folder above it:\n" + "\n".join(offending)


def test_a_folder_has_at_most_twenty_modules() -> None:
    count = Counter(p.relative_to(ROOT).parent.as_posix() for o in OURS for p in modules(o) if p.name != "__init__.py")
    crowded = {folder: n for folder, n in count.items() if n > MOST_MODULES and folder != "stable_data/embedded_world/families"}
    assert not crowded, f"more than {MOST_MODULES} modules in a folder: {crowded}; make a folder of those that belong together"


def test_versions_are_pinned_in_one_place() -> None:
    constraints = (ROOT / "constraints.txt").read_text("utf-8")
    assert "torch==2.13.0" in constraints
    for path in (ROOT / "pyproject.toml", ROOT / "Makefile", ROOT / ".ci" / "run"):
        assert not re.search(r"[a-z]==\d", path.read_text("utf-8")), path


@pytest.mark.parametrize("package", sorted(OURS))
def test_no_group_of_a_pattern_is_repeated_possessively(package: str) -> None:
    """Python before 3.11.5 matches that wrongly (gh-106052); an atomic group does it."""
    for path in modules(package):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.search(r"(?<!\\)\)(?:[*+?]|\{[\d,]+\})\+", node.value), f"{path}:{node.lineno}"
