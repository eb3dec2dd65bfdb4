from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.physics_corrector.flow.flow_matching import FlowMatching, FlowSettings
from models.physics_corrector.training.perturbation import PerturbationSettings
from models.physics_corrector.training.validation import ROWS, ValidationScenes, grid_figures, scalar_figures, validation_card
from tests.models.physics_corrector.geometry.shapes import store
from tests.models.physics_corrector.training.training_scenes import row, training_set

DATA = training_set(2, 2)
SCENES = [row(n) for n in range(4)]
FLOW = FlowMatching(FlowSettings())


def still(y: Tensor, *_: object) -> Tensor:
    """The velocity of a corrector that leaves everything where it is."""
    return torch.zeros_like(y)


def test_a_corrector_that_does_nothing_gives_back_the_coarse_figures() -> None:
    held_out = ValidationScenes(DATA, torch.arange(4), SCENES[:2], store())
    card = validation_card(FLOW.mover(still), held_out, PerturbationSettings(), 0)
    assert set(card) == set(ROWS)
    for sides in card.values():
        assert sides["raw"]["move_mean_mm"] == pytest.approx(0, abs=1e-3)
        assert sides["raw"]["target_distance_mm"] == pytest.approx(sides["coarse"]["target_distance_mm"], rel=1e-3)
        assert sides["coarse"]["relations_kept_on_in"] in (None, 1.0)
    again = validation_card(FLOW.mover(still), held_out, PerturbationSettings(), 0, ("pile",))
    assert again["pile"] == card["pile"]


def test_a_pile_collides_and_its_clean_scene_does_not() -> None:
    held_out = ValidationScenes(DATA, torch.arange(4), SCENES, store())
    settings = PerturbationSettings(picked=1.0)
    pile = validation_card(FLOW.mover(still), held_out, settings, 0, ("pile",))["pile"]["coarse"]
    assert pile["grid_oc"] is not None
    assert pile["grid_oc"] > 0.1
    assert pile["oc"] == pytest.approx(pile["grid_oc"], abs=0.15)
    assert pile["num_judged"] == 4
    assert pile["clean"] == 0
    clean = grid_figures(DATA.batch.poses, DATA.batch.poses, DATA.batch, DATA.geometry)
    assert clean["grid_oc"] == 0
    assert clean["target_distance_mm"] == 0


def test_distances_are_those_of_the_objects_that_may_move() -> None:
    moved = DATA.batch.poses.clone()
    moved[:, 4, 0] += 0.05
    moved[:, 4, 3] += 0.2
    figures = grid_figures(moved, DATA.batch.poses, DATA.batch, DATA.geometry)
    assert figures["move_mean_mm"] == pytest.approx(50 / 5, rel=1e-3)
    assert figures["target_distance_mm"] == pytest.approx(1e3 * (0.05**2 + 0.02**2) ** 0.5 / 5, rel=1e-3)
    assert figures["target_yaw_deg"] == pytest.approx(11.459 / 5, rel=1e-3)
    fixed = DATA.batch.is_fixed.clone()
    fixed[:, :4] = DATA.batch.mask[:, :4]
    figures = grid_figures(moved, DATA.batch.poses, replace(DATA.batch, is_fixed=fixed), DATA.geometry)
    assert figures["move_mean_mm"] == pytest.approx(50, rel=1e-3)


def test_fixed_objects_of_earlier_stages_stay() -> None:
    def away(y: Tensor, t: Tensor, condition: object, *_: object) -> Tensor:
        return torch.where(condition.is_movable[..., None], 1.0, 0.0).expand_as(y)  # type: ignore[attr-defined]

    card = validation_card(FLOW.mover(away), ValidationScenes(DATA, torch.arange(4)), PerturbationSettings(), 0)
    for name in ("jitter", "jitter_fixed"):
        assert card[name]["raw"]["move_mean_mm"] == pytest.approx(1e3 * 0.05 * 3**0.5, rel=1e-3)


def test_unknown_figures_are_left_out_of_logs() -> None:
    card = {"pile": {"raw": {"oc": None, "grid_oc": 0.5}}}
    assert scalar_figures(card) == {"pile/grid_oc/raw": 0.5}
