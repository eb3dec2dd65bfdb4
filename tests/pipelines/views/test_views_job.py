"""The views job: a row for each scene, the same again, and what cannot be drawn."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.views.job import draw_views
from pipelines.views.settings import ViewsSettings
from stable_data.errors import ConfigError
from stable_data.simulation.offscreen import can_render
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.export.runs import write_run

pytestmark = pytest.mark.skipif(not can_render(), reason="this machine cannot render")

SMALL = ViewsSettings(width=64, height=48, features="gradients", scenes_per_shard=2)
HERE = WorkerPool()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_run(tmp_path_factory.mktemp("scenes") / "run").root)


def test_each_scene_has_two_pictures_with_features(run: str, tmp_path: Path) -> None:
    manifest = draw_views(run, str(tmp_path), SMALL, HERE)
    assert (manifest["counts"]["views"], manifest["counts"]["failures"]) == (3, 0)
    assert manifest["distance"] == "Frechet distance (gradients)"
    rows = RunFolder(str(tmp_path)).table("views").to_pylist()
    assert len({row["extractor_fingerprint"] for row in rows}) == 1
    for row in rows:
        assert [shown["view"] for shown in row["views"]] == ["front", "perspective"]
        for shown in row["views"]:
            with Image.open(io.BytesIO(shown["picture"])) as picture:
                assert (picture.size, picture.mode) == ((64, 48), "RGB")
            assert np.isfinite(shown["features"]).all()
    assert (tmp_path / "report" / "index.html").read_text().count("<img") == 6


def test_a_stopped_run_continues_with_the_same_rows(run: str, tmp_path: Path) -> None:
    whole, stopped = str(tmp_path / "whole"), str(tmp_path / "stopped")
    for out in (whole, stopped):
        draw_views(run, out, SMALL, HERE, report=False)
    next((tmp_path / "stopped" / "views").iterdir()).unlink()
    draw_views(run, stopped, SMALL, HERE, report=False)
    one, other = (RunFolder(out).table("views").sort_by("scene_id") for out in (whole, stopped))
    assert one.equals(other)


def test_other_features_are_refused_in_the_same_folder(run: str, tmp_path: Path) -> None:
    draw_views(run, str(tmp_path), SMALL, HERE, report=False)
    with pytest.raises(ConfigError, match="width"):
        draw_views(run, str(tmp_path), ViewsSettings(width=65, height=48, features="gradients"), HERE)


def test_unknown_and_missing_features_do_not_start(run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert ViewsSettings().resolved().features == "gradients"  # nothing was fetched
    for name in ("colours", "inception", "inception:nowhere.pth", "transformers:nowhere"):
        with pytest.raises(ConfigError):
            draw_views(run, str(tmp_path / "out"), ViewsSettings(features=name), HERE)


def test_the_command_draws_chosen_scenes(run: str, tmp_path: Path) -> None:
    words = ["views", "--scenes", run, "--out", str(tmp_path / "out"), "--workers", "0", "--where", "scene_id == 'falling'"]
    sets = [word for key in ("width=32", "height=32", 'features="gradients"') for word in ("--set", key)]
    planned = CliRunner().invoke(app, [*words, *sets, "--dry-run"])
    assert json.loads(planned.output)["settings"]["width"] == 32
    done = CliRunner().invoke(app, [*words, *sets])
    assert done.exit_code == 0, done.output
    assert "1 of 1 scenes drawn, features gradients" in done.output
