"""The training of the rearrangers: equal to that of the corrector in what it costs, resumed bit for bit, able to learn a scene."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from models.physics_corrector.training.layout_settings import LayoutTrainingSettings
from models.physics_corrector.training.layout_trainer import train
from models.physics_corrector.training.settings import training_preset as corrector_preset
from models.physics_corrector.training.validation import ValidationScenes, validation_card
from models.rearrangement.settings import METHODS, LegoNetSettings, Method, RearrangerSettings
from models.rearrangement.training import RearrangerTrainer, RearrangerTrainingSettings, training_preset
from models.rearrangement.weights import build_network, save_rearranger
from stable_data.errors import ConfigError
from tests.models.physics_corrector.training.training_scenes import TINY, training_set

DATA = training_set()
SHARED = {f.name: getattr(TINY, f.name) for f in fields(LayoutTrainingSettings)}


def tiny(method: Method) -> RearrangerTrainingSettings:
    return RearrangerTrainingSettings(**SHARED, rearranger=RearrangerSettings(method, TINY.network)).resolved(6)


def trained(settings: RearrangerTrainingSettings, steps: int, training: RearrangerTrainer | None = None) -> RearrangerTrainer:
    training = RearrangerTrainer(DATA, settings) if training is None else training
    count = iter(range(steps + 1))
    train(training, wants_stop=lambda: next(count) >= steps - 1, after=lambda *_: None)
    return training


def content(training: RearrangerTrainer, path: Path) -> bytes:
    save_rearranger(path, training.settings.rearranger, training.average, {})
    return path.read_bytes()


@pytest.mark.parametrize("method", METHODS)
def test_a_run_that_was_killed_and_resumed_gives_the_same_bytes(tmp_path: Path, method: Method) -> None:
    settings = replace(tiny(method), warm_up=3, cool_down=0.5, scattered=0.3)
    clean = trained(settings, 8)
    first = trained(settings, 3)
    first.save(tmp_path / "state.pt")
    trained(settings, 2, first)  # lost: it was killed before it was kept
    second = RearrangerTrainer(DATA, settings)
    assert second.resume(tmp_path / "state.pt")
    trained(settings, 8, second)
    assert second.step == clean.step == 8
    assert content(second, tmp_path / "second") == content(clean, tmp_path / "clean")


def test_a_checkpoint_of_another_method_is_refused(tmp_path: Path) -> None:
    trained(tiny("lego_net"), 1).save(tmp_path / "state.pt")
    with pytest.raises(ConfigError, match=r"rearranger.method: lego_net -> struct_diffusion"):
        RearrangerTrainer(DATA, tiny("struct_diffusion")).resume(tmp_path / "state.pt")


@pytest.mark.parametrize("method", METHODS)
def test_the_presets_cost_what_the_corrector_costs(method: Method) -> None:
    ours, theirs = corrector_preset("embedded_set"), training_preset(method)
    for f in fields(LayoutTrainingSettings):
        assert getattr(theirs, f.name) == getattr(ours, f.name), f.name
    with torch.device("meta"):
        sizes = [sum(p.numel() for p in n.parameters()) for n in (ours.corrector.build()[0], build_network(theirs.rearranger))]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)
    assert theirs.rearranger.heights == ours.corrector.flow.heights
    assert theirs.rearranger.coordinates == ours.corrector.flow.coordinates  # so that a turn weighs as much in the loss


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected one of lego_net, struct_diffusion"):
        training_preset("lego")


LEARNS = {
    "lego_net": RearrangerSettings("lego_net", TINY.network, lego_net=LegoNetSettings(noise=0.0, noise_yaw=0.0, max_steps=60)),
    "struct_diffusion": RearrangerSettings("struct_diffusion", TINY.network),
}


@pytest.mark.parametrize(
    ("method", "steps"), [("lego_net", 150), pytest.param("struct_diffusion", 500, marks=pytest.mark.slow)]
)
def test_a_tiny_network_learns_a_scene(method: Method, steps: int) -> None:
    """Overfitted on one scene, what it gives is nearer to the clean scene than what it got."""
    data = training_set(1, 0)
    settings = replace(
        tiny(method), steps=steps, batch_size=16, chunk=16, learning_rate=5e-3, cool_down=0.5, rearranger=LEARNS[method]
    ).resolved(1)
    training, losses = RearrangerTrainer(data, settings), list[float]()
    train(training, wants_stop=lambda: False, after=lambda _, figures: losses.append(figures["denoising"]))
    assert sum(losses[-20:]) < 0.5 * sum(losses[:20])
    held_out = ValidationScenes(data, torch.zeros(8, dtype=torch.long))
    card = validation_card(training.mover(), held_out, settings.perturbation, 0, ("jitter",))["jitter"]
    before, after = card["coarse"]["target_distance_mm"], card["raw"]["target_distance_mm"]
    assert before is not None
    assert after is not None
    assert after < 0.6 * before
