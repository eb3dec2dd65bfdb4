"""Smaller embedded datasets and runs over them, made once. Tests that change a run copy it first."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from models.semantic_reasoner.training.examples import edit_example_of
from pipelines.edit.job import edit
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from stable_data.embedded_world.drafting import KINDS
from stable_data.embedded_world.edit_table import edit_rows
from stable_data.storage.schemas import Row
from tests.pipelines.edit import edit_runs
from tests.pipelines.runs import SMALL, used_assets
from tests.stable_data.embedded_world.edit_scenes import made_scenes, row_of


@pytest.fixture(scope="session")
def tiny(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset's scene with the fewest objects, alone, with the meshes of three of its assets: quickly done."""
    root = tmp_path_factory.mktemp("tiny") / "data"
    shutil.copytree(dataset, root)
    layouts = sorted(root.glob("Layout_info/*/*/layout.json"), key=lambda p: len(json.loads(p.read_text("utf-8"))["objects"]))
    for layout in layouts[1:]:
        shutil.rmtree(layout.parent)
    kept = sorted(used_assets(root))[:3]
    for mesh in root.glob("Assets_library/*.glb"):
        if mesh.stem not in kept:
            mesh.unlink()
    return root


@pytest.fixture(scope="session")
def bare(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without any mesh: done at once."""
    root = tmp_path_factory.mktemp("bare") / "data"
    shutil.copytree(tiny, root, ignore=shutil.ignore_patterns("Assets_library"))
    return root


@pytest.fixture(scope="session")
def tiny_run(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over the one scene."""
    out = tmp_path_factory.mktemp("tiny_run") / "out"
    preprocess(str(tiny), str(out), SMALL, WorkerPool())
    return out


@pytest.fixture(scope="session")
def bare_run(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over the scene without meshes."""
    out = tmp_path_factory.mktemp("bare_run") / "out"
    preprocess(str(bare), str(out), SMALL, WorkerPool())
    return out


@pytest.fixture(scope="session")
def drafted(dataset: Path) -> list[Row]:
    """Edits of the scenes of ``dataset``: two each, of the kinds in turn, with assets that its library has."""
    there, count, found = used_assets(dataset), Counter[str](), list[Row]()
    for made in made_scenes(0, 1, 2, 3, seed=3):
        usable = [t for t in edit_rows(row_of(made), 60) if {o["asset_id"] for o in t["objects_out"]} <= there]
        for _ in range(2):
            found.append(usable.pop(min(range(len(usable)), key=lambda k: count[usable[k]["kind"]])))
            count[found[-1]["kind"]] += 1
    assert set(count) == set(KINDS)
    return found


@pytest.fixture(scope="session")
def wanted(drafted: list[Row]) -> list[dict[str, Any]]:
    """Lines of a file of edits, each with its reply; the last asks for nothing."""
    lines = [
        {"scene_id": told["scene_id"], "instruction": told["instruction"], "reply": json.loads(edit_example_of(told).answer)}
        for told in drafted
    ]
    return [
        *lines,
        {"scene_id": drafted[0]["scene_id"], "instruction": "Leave it as it is.", "reply": edit_runs.EMPTY, "edit_id": "same"},
    ]


@pytest.fixture(scope="session")
def edits(wanted: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return edit_runs.file_of(wanted, tmp_path_factory.mktemp("edits") / "edits.jsonl")


@pytest.fixture(scope="session")
def edited(dataset: Path, edits: Path, make_once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    def make(folder: Path) -> None:
        manifest = edit(str(dataset), edits, str(folder / "out"), edit_runs.SMALL, edit_runs.ALONE)
        assert manifest["counts"]["scenes"] == manifest["num_edits"] == 9
        assert manifest["counts"]["failures"] == 0

    return make_once("edited", make) / "out"
