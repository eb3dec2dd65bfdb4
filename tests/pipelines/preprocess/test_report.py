"""The report page: what it says, and that one scene that cannot be drawn costs its own picture alone."""

import base64
import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pipelines.preprocess.report import write_report
from pipelines.reports import scene_pictures
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.run_folder import RunFolder
from stable_data.viewer.page import SCRIPT_NAME, script


@pytest.fixture(scope="module")
def clean_run(clean_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, whose report is written anew."""
    return Path(shutil.copytree(clean_run, tmp_path_factory.mktemp("reported") / "run"))


def page(run: Path, data: Path, num_pictures: int) -> str:
    manifest = json.loads((run / "manifest.json").read_text("utf-8"))
    write_report(RunFolder(str(run)), manifest, AssetStore(MesaTaskDataset(data)), num_pictures)
    return (run / "report" / "index.html").read_text("utf-8")


def scene_names(run: Path) -> list[str]:
    return sorted(RunFolder(str(run)).table("scenes", ["scene_id"])["scene_id"].to_pylist())


def drawn(*_: Any, **__: Any) -> Any:
    return np.zeros((4, 4, 3), np.uint8)


def test_the_report_shows_the_scenes_and_the_counts(clean_run: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_pictures, "draw_geometry", drawn)
    text = page(clean_run, dataset, 4)
    assert "<h2>Audit</h2>" in text
    assert "<b>4 / 4</b><span>scenes usable</span>" in text
    assert "<b>0</b><span>unusable scenes</span>" in text
    report = clean_run / "report"
    for name in scene_names(clean_run):
        assert f"<figcaption><b>{name}</b>" in text
        assert f'<a class="turn" href="scenes/{name}.html#scene=0"><img' in text
        own = (report / "scenes" / f"{name}.html").read_text("utf-8")
        assert f'<script src="../{SCRIPT_NAME}"></script>' in own
        [glb] = re.findall(r'data-model="0">([^<]*)</script>', own)
        loaded = trimesh.load(io.BytesIO(base64.b64decode(glb)), file_type="glb")
        scene = next(row for row in RunFolder(str(clean_run)).table("scenes").to_pylist() if row["scene_id"] == name)
        assert {o["instance"] for o in scene["objects"]} <= set(loaded.graph.nodes)
    assert (report / SCRIPT_NAME).read_bytes() == script()


def test_assets_without_a_mesh_are_counted(bare_run: Path, bare: Path) -> None:
    count = json.loads((bare_run / "manifest.json").read_text("utf-8"))["num_assets_without_mesh"]
    assert f"<b>{count}</b><span>assets without a mesh file</span>" in page(bare_run, bare, 0)


def test_a_scene_that_cannot_be_drawn_is_a_note(clean_run: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *others = scene_names(clean_run)

    def draw(geometry: Any, *_: Any, **__: Any) -> Any:
        if geometry.scene.scene_id == first:
            raise ValueError("too <small>")
        return drawn()

    monkeypatch.setattr(scene_pictures, "draw_geometry", draw)
    text = page(clean_run, dataset, 4)
    assert f"{first} cannot be rendered: ValueError: too &lt;small&gt;" in text
    assert all(f"<figcaption><b>{name}</b>" in text for name in others)
    assert f'<a class="turn bare" href="scenes/{first}.html#scene=0">' in text


def test_a_scene_that_cannot_be_turned_keeps_its_picture(
    clean_run: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> bytes:
        raise ConfigError("a page with 1 scenes has 999 MB", "page_too_big")

    monkeypatch.setattr(scene_pictures, "draw_geometry", drawn)
    monkeypatch.setattr(scene_pictures, "html_page", refuse)
    text = page(clean_run, dataset, 4)
    for name in scene_names(clean_run):
        assert f"{name} cannot be turned: ConfigError: a page with 1 scenes has 999 MB" in text
        assert f'<figure><img alt="{name}"' in text


def test_a_machine_that_cannot_draw_is_said_once(clean_run: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(*_: Any, **__: Any) -> Any:
        raise ConfigError("rendering failed: OpenGL does not start", "no_gl")

    monkeypatch.setattr(scene_pictures, "draw_geometry", draw)
    text = page(clean_run, dataset, 4)
    assert text.count("OpenGL does not start") == 1
    assert text.count('<a class="turn bare"') == 4
    assert "<img" not in text
