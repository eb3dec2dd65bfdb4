"""Embedded datasets and runs over them, made once. Tests that change one copy it first."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.preprocess import preprocess
from pipelines.runner import Workers
from stable_data.synth import World, write_world
from tests.pipelines.runs import SMALL, used_assets


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scenes."""
    root = tmp_path_factory.mktemp("embedded") / "data"
    write_world(root, 4, World(seed=3, pictures=False))
    return root


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """An empty cache for the tests of a module, so that nothing depends on what a machine has made before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


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
def clean_run(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over the dataset."""
    out = tmp_path_factory.mktemp("run") / "out"
    preprocess(str(dataset), str(out), SMALL, Workers())
    return out


@pytest.fixture(scope="session")
def tiny_run(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over the one scene."""
    out = tmp_path_factory.mktemp("tiny_run") / "out"
    preprocess(str(tiny), str(out), SMALL, Workers())
    return out


@pytest.fixture(scope="session")
def bare_run(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over the scene without meshes."""
    out = tmp_path_factory.mktemp("bare_run") / "out"
    preprocess(str(bare), str(out), SMALL, Workers())
    return out
