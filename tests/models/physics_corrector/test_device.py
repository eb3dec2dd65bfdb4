"""Training, flow and refinement on a GPU give what they give on a CPU; skipped where there is no GPU."""

from dataclasses import replace

import pytest
import torch

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.refinement.layouts import LayoutToRefine
from models.physics_corrector.refinement.refiner import Refiner
from models.physics_corrector.training.settings import CorrectorTrainingSettings, PhysicsSchedule, training_preset
from models.physics_corrector.training.trainer import CorrectorTrainer
from models.training.distributed import CPU
from stable_data.assets.contact_grids import ContactGrids
from tests.models.physics_corrector.flow.conditions import awake_network, small_settings
from tests.models.physics_corrector.geometry.shapes import scene, store, thing
from tests.models.physics_corrector.refinement.layouts import shapes_of
from tests.models.physics_corrector.training.training_scenes import TINY, rows, training_set

DEVICE = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"))

EMBEDDED = training_preset("embedded_set")
EVERYTHING = replace(
    TINY,
    perturbation=EMBEDDED.perturbation,
    scattered=0.5,
    physics=PhysicsSchedule(share=1.0, from_time=0.0, unroll_share=1.0, unroll_scenes=1.0),
    losses=replace(EMBEDDED.losses, support_weight=0.01, table_factor=1.0),
)


@pytest.mark.parametrize("device", ["cpu", DEVICE])
@pytest.mark.parametrize("settings", [TINY, EVERYTHING])
def test_training_steps_run(device: str, settings: CorrectorTrainingSettings) -> None:
    training = CorrectorTrainer(training_set(), settings, replace(CPU, device=torch.device(device)))
    before = {name: value.clone() for name, value in training.network.state_dict().items()}
    for _ in range(3):
        figures, _ = training.advance()
        assert all(torch.isfinite(torch.tensor(value)) for value in figures.values())
    assert any(not torch.equal(before[name], value) for name, value in training.network.state_dict().items())


@pytest.mark.parametrize("device", [DEVICE])
def test_the_flow_gives_the_same_poses(device: str) -> None:
    settings = small_settings("set_transformer")
    settings = replace(settings, network=replace(settings.network, num_features=0, num_texts=0))
    network, condition = awake_network(settings), Condition.of(rows(5))
    _, flow = settings.build()
    with torch.no_grad():
        wanted = flow.sample(network, condition)
        found = flow.sample(network.to(device), condition.to(device))
    assert torch.allclose(found.cpu(), wanted, atol=1e-5)


@pytest.mark.parametrize("device", [DEVICE])
def test_the_refinement_solves_the_same_layouts(device: str) -> None:
    crowded = scene(
        thing("plate", (0.4, 0.4, 0.03, 0.2), support="table"),
        thing("ball", (0.42, 0.4, 0.11, 0), support="plate"),
        thing("cube_0", (0.52, 0.42, 0.05, 0.4), support="table"),
        thing("cube_1", (0.55, 0.48, 0.05, 0), support="table"),
    )
    found = [
        Refiner(store(), ContactGrids(), device=place).refine([LayoutToRefine(crowded, shapes_of(crowded))])[0]
        for place in ("cpu", device)
    ]
    assert all(one is not None and one.is_solved for one in found)
