"""From published weights to a corrected scene: an encoder is fitted, features are computed with it, and a corrector is trained."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.learned_flow import load_flow
from models.point_encoder import load as load_encoder
from models.point_encoder.transformer import PointTransformer, TransformerConfig
from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from pipelines.train.corrector import CorrectorTrainingJob
from pipelines.train.layouts import LayoutMonitoring
from pipelines.train.point_encoder import fit_encoder
from stable_data.assets.store import AssetStore
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from tests.models.physics_corrector.training.training_scenes import TINY
from tests.models.point_encoder.test_checkpoint import FIRST, SECOND
from tests.pipelines.runs import SMALL

WATCH = LayoutMonitoring(log_every=2, card_every=9, final_scenes=2, exact_scenes=0)


def published(folder: Path, config: TransformerConfig) -> Path:
    """A file like those that are published: weights of a first-generation or a Sonata network, of random numbers."""
    torch.manual_seed(1)
    path = folder / "model.pth"
    state = {f"module.backbone.{name}": value for name, value in PointTransformer(config).state_dict().items()}
    torch.save({"state_dict": state}, path)
    return path


@pytest.mark.slow
def test_published_weights_become_a_corrector_that_corrects(dataset: Path, clean_run: Path, tmp_path: Path) -> None:
    file, encoder = published(tmp_path, FIRST), tmp_path / "encoder.safetensors"
    words = ["fit-encoder", "--data", str(clean_run), "--weights", f"modelnet:{file}", "--out", str(encoder)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "no projection is needed" in done.output
    run, out = tmp_path / "run", tmp_path / "corrector"
    preprocess(str(dataset), str(run), replace(SMALL, features=str(encoder), all_assets=False), WorkerPool())
    network = replace(TINY.corrector.network, num_features=64)
    settings = replace(
        TINY, steps=2, features="point", num_surface=64, corrector=CorrectorSettings(network, TINY.corrector.flow)
    )
    assert "2 of 2 steps" in CorrectorTrainingJob(str(run), out, settings, WATCH).run()  # the run names its encoder
    weights = out / CorrectorTrainingJob.WEIGHTS
    assert load_encoder(weights.with_name("point_encoder.safetensors")).fingerprint() == load_encoder(encoder).fingerprint()
    folder = MesaTaskDataset(dataset)
    scene, _ = folder.read(folder.scene_ids[0])
    (correction,) = PhysicsCorrector(load_flow(str(weights))).correct([scene], AssetStore(folder))
    assert correction.card_after is not None
    assert correction.card_after.clean


@pytest.mark.parametrize("weights", ["model.pth", "other:model.pth", "sonata:"])
def test_weights_of_no_known_kind_are_refused(weights: str, clean_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected KIND:FILE with KIND of scannet, modelnet, sonata"):
        fit_encoder(str(clean_run), weights, tmp_path / "encoder.safetensors", tmp_path / "cache")


@pytest.mark.slow
def test_a_projection_is_fitted_on_the_shapes_of_a_run(tmp_path: Path) -> None:
    world, run, encoder = tmp_path / "world", tmp_path / "run", tmp_path / "encoder.safetensors"
    write_world(world, 12, EmbeddedWorld(pictures=False))
    preprocess(str(world), str(run), replace(SMALL, features="none", all_assets=False), WorkerPool())
    line = fit_encoder(str(run), f"sonata:{published(tmp_path, SECOND)}", encoder, tmp_path / "cache")
    assert "channels to 64, fitted on" in line
    assert load_encoder(encoder).basis.any()
