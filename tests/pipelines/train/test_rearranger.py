"""The job that trains a rearranger: what it leaves, that it continues, and what the command refuses."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from models.physics_corrector.training.layout_settings import LayoutTrainingSettings
from models.physics_corrector.training.sources import TrainingScenes
from models.rearrangement.settings import LegoNetSettings, RearrangerSettings
from models.rearrangement.training import RearrangerTrainingSettings
from models.rearrangement.weights import load_rearranger
from pipelines.__main__ import app
from pipelines.train.layouts import LayoutMonitoring
from pipelines.train.rearranger import RearrangerTrainingJob
from stable_data.errors import ConfigError
from tests.models.physics_corrector.training.training_scenes import TINY

SHARED = {f.name: getattr(TINY, f.name) for f in fields(LayoutTrainingSettings)} | {
    "steps": 3,
    "batch_size": 4,
    "chunk": 2,
    "num_surface": 64,
    "num_bottom": 16,
}
SETTINGS = RearrangerTrainingSettings(
    **SHARED, rearranger=RearrangerSettings("lego_net", TINY.network, lego_net=LegoNetSettings(max_steps=4))
)
WATCH = LayoutMonitoring(log_every=1, card_every=2, card_scenes=1, final_scenes=1, exact_scenes=0)


def job(run: Path, out: Path, minutes: float = 0.0) -> RearrangerTrainingJob:
    return RearrangerTrainingJob(str(run), out, SETTINGS, WATCH, minutes)


def test_stopped_and_run_again_it_gives_the_bytes_of_one_run(clean_run: Path, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert "3 of 3 steps" in job(clean_run, whole).run()
    shutil.copytree(whole / "cache", parts / "cache")
    assert "1 of 3 steps" in job(clean_run, parts, minutes=1e-9).run()
    assert "3 of 3 steps" in job(clean_run, parts).run()
    weights = RearrangerTrainingJob.WEIGHTS
    assert (whole / weights).read_bytes() == (parts / weights).read_bytes()
    read = load_rearranger(whole / weights)
    assert read.settings == SETTINGS.resolved(4).rearranger
    assert read.notes["data_fingerprint"] == TrainingScenes((str(clean_run),), whole / "cache", 64, 16).fingerprint()
    assert json.loads(read.notes["training"])["rearranger"]["method"] == "lego_net"
    assert json.loads((whole / "manifest.json").read_text("utf-8"))["status"] == "complete"
    with pytest.raises(ConfigError, match=r"rearranger.method: lego_net -> struct_diffusion"):
        replace(
            job(clean_run, parts), settings=replace(SETTINGS, rearranger=RearrangerSettings("struct_diffusion", TINY.network))
        ).run()


def test_the_command_shows_its_plan_and_names_mistakes(clean_run: Path, tmp_path: Path) -> None:
    command = ["train-rearranger", "--data", str(clean_run), "--out", str(tmp_path / "out"), "--method"]
    shown = CliRunner().invoke(
        app, [*command, "struct_diffusion", "--set", "rearranger.struct_diffusion.samples=2", "--dry-run"]
    )
    assert shown.exit_code == 0, shown.stderr
    plan = json.loads(shown.stdout)
    assert plan["settings"]["rearranger"]["struct_diffusion"]["samples"] == 2
    assert plan["settings"]["steps"] == 60_000
    assert 1.6e6 < plan["num_parameters"] < 1.9e6
    for words, said in (
        (["lego"], "method 'lego' is unknown, expected one of lego_net, struct_diffusion"),
        (["lego_net", "--set", "rearranger.method=struct_diffusion"], "name it with --method alone"),
        (["lego_net", "--set", "rearranger.network.reads_errors=true"], "reads_errors is true, expected false"),
    ):
        result = CliRunner().invoke(app, [*command, *words])
        assert result.exit_code == 2
        assert said in result.stderr
