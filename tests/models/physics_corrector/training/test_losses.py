"""The paper's terms on shapes whose answers are known, and what must not change them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.corrector_losses import all_pairs, copied_losses, our_losses, with_cubes
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeCollector, ShapeTensors
from models.physics_corrector.training.losses import (
    LossSettings,
    PhysicsLosses,
    bounds_loss,
    colliding_pairs,
    flow_loss,
    object_object_loss,
    object_table_loss,
    physics_losses,
    support_loss,
)
from stable_data.assets.store import AssetStore
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.mesatask import MesaTaskDataset
from tests.models.physics_corrector.geometry.shapes import RADIUS, SIDE, batch_of, scene, thing

GRID_ERROR = 1e-3  # metres, of the grids of these shapes at their surfaces
PAPER = LossSettings()
ALL = LossSettings(bounds_weight=1.0, clearance=2e-3)
NAMES = ("ball", "cube", "plate", "bowl", "cube_2", "cloth")


def shaken(seed: int, num_scenes: int = 2, num_slots: int = 0, spread: float = 0.1) -> tuple[LayoutBatch, ShapeTensors]:
    """Scenes of all shapes, piled up so that they collide, float, sink and stick out."""
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(num_scenes):
        x, y, z, yaw = (rng.uniform(low, high, len(NAMES)) for low, high in ((-1, 1), (-1, 1), (-0.02, 0.2), (-4, 4)))
        poses = np.stack([0.1 + spread * x, 0.1 + spread * y, z, yaw], axis=1).tolist()
        things = [thing(name, (pose[0], pose[1], pose[2], pose[3])) for name, pose in zip(NAMES, poses, strict=True)]
        scenes.append(scene(*things, zone=(0.15, 0.3, 0.05, 0.2)))
    return batch_of(scenes, num_slots=num_slots)


def total(batch: LayoutBatch, geometry: ShapeTensors, chosen: LossSettings = ALL) -> tuple[torch.Tensor, torch.Tensor]:
    """Weighted losses (B,) and their gradient (B, N, 4), float64."""
    poses = batch.poses.double().requires_grad_()
    losses = physics_losses(poses, batch, geometry, chosen).weighted(chosen)
    (gradient,) = torch.autograd.grad(losses.sum(), poses)
    return losses.detach(), gradient


def terms(batch: LayoutBatch, geometry: ShapeTensors, chosen: LossSettings = PAPER) -> PhysicsLosses:
    """The losses, lengths in metres."""
    return physics_losses(batch.poses.double(), batch, geometry, replace(chosen, length_unit=1.0))


def test_cubes_in_each_other_cost_the_square_of_their_depth_and_are_pushed_apart() -> None:
    for depth in (0.004, 0.02, 0.04):
        one, other = thing("cube_1", (0.5, 0.5, 0.05, 0.0)), thing("cube_2", (0.5 + SIDE - depth, 0.5, 0.05, np.pi / 2))
        batch, geometry = batch_of([scene(one, other)])
        losses = terms(batch, geometry)
        assert losses.object_object.sqrt().item() == pytest.approx(depth, abs=GRID_ERROR)
        assert losses.object_table.item() == pytest.approx(0, abs=1e-12)
        _, gradient = total(batch, geometry, LossSettings())
        assert gradient[0, 0, 0] > 0 > gradient[0, 1, 0]  # descent takes the left one left
        assert gradient[0, 0, 0].item() == pytest.approx(-gradient[0, 1, 0].item())


def test_balls_cost_at_most_their_depth_and_nothing_once_apart() -> None:
    batch, geometry = batch_of([scene(thing("ball_1", (0.5, 0.5, 0.05, 0.0)), thing("ball_2", (0.57, 0.5, 0.05, 0.0)))])
    depth = terms(batch, geometry).object_object.sqrt().item()
    assert 0.9 * 0.03 < depth <= 0.03 + GRID_ERROR  # no sample lies exactly on the line of the centres
    apart = replace(batch, poses=batch.poses + torch.tensor([[[0.0] * 4, [0.031, 0, 0, 0]]]))
    assert terms(apart, geometry).object_object.item() == 0
    assert terms(apart, geometry, LossSettings(clearance=5e-3)).object_object.sqrt().item() == pytest.approx(4e-3, abs=1e-3)


def test_an_object_in_a_container_that_it_does_not_touch_costs_nothing() -> None:
    inside = thing("ball_1", (0.5, 0.5, 0.006 + 0.5 * RADIUS + 0.001, 0.0), scale=(0.5, 0.5, 0.5))
    batch, geometry = batch_of([scene(thing("bowl", (0.5, 0.5, 0.04, 0.0)), inside)])
    assert terms(batch, geometry).object_object.item() == 0


def test_sinking_below_the_table_costs_the_square_of_the_depth() -> None:
    batch, geometry = batch_of([scene(thing("cube", (0.5, 0.5, 0.03, 0.7)), thing("ball", (0.2, 0.2, 0.2, 0.0)))])
    assert object_table_loss(batch.poses, batch).item() == pytest.approx(0.02**2)
    assert terms(batch, geometry).object_table.sqrt().item() == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize("height", [0.0003, 0.004, 0.03])
def test_floating_costs_the_gap_beyond_the_tolerance(height: float) -> None:
    on_table = scene(thing("cube", (0.5, 0.5, 0.05 + height, 0.4)))
    on_plate = scene(thing("plate", (0.5, 0.5, 0.005, 0.1)), thing("cube", (0.5, 0.5, 0.06 + height, 0.4)))
    small = thing("ball", (0.5, 0.5, 0.006 + 0.4 * RADIUS + height, 0.0), scale=(0.4, 0.4, 0.4))
    in_bowl = scene(thing("bowl", (0.5, 0.5, 0.04, 0.0)), small)
    batch, geometry = batch_of([on_table, on_plate, in_bowl])
    expected = max(0.0, height - 5e-4)
    found = terms(batch, geometry).support.sqrt()
    # In the bowl a wall is a little nearer than the floor, and above it the table is hidden but near.
    assert found[:2].tolist() == pytest.approx([expected] * 2, abs=GRID_ERROR)
    assert found[2].item() <= expected + GRID_ERROR
    assert height < 0.03 or found[2].item() > 0.4 * expected


def test_what_is_inside_its_support_is_far_from_the_surface_too() -> None:
    small = thing("ball", (0.5, 0.5, 0.2 - 0.03 + 0.5 * RADIUS, 0.0), scale=(0.5, 0.5, 0.5))
    batch, geometry = batch_of([scene(thing("cube", (0.5, 0.5, 0.1, 0.0), scale=(2.0, 2.0, 2.0)), small)])
    # The bottom region reaches 5 % of the height up from the lowest point.
    assert 0.0275 - GRID_ERROR < terms(batch, geometry).support.sqrt().item() + 5e-4 < 0.03 + GRID_ERROR


def test_a_carried_object_does_not_carry_its_carrier() -> None:
    batch, geometry = batch_of([scene(thing("cube", (0.5, 0.5, 0.1, 0.0)), thing("ball", (0.5, 0.5, 0.2, 0.0)))])
    # The cube hangs 5 cm above the table; the ball on it does not.
    assert terms(batch, geometry).support.sqrt().item() == pytest.approx(0.05 - 5e-4, abs=GRID_ERROR)


def test_descent_settles_a_floating_and_frees_a_sunk_object() -> None:
    batch, geometry = batch_of(
        [
            scene(thing("cube", (0.5, 0.5, 0.08, 0.0))),
            scene(thing("plate", (0.5, 0.5, 0.005, 0)), thing("cube", (0.5, 0.5, 0.08, 0))),
        ]
    )
    _, gradient = total(batch, geometry, LossSettings(sdf_weight=0))
    assert gradient[0, 0, 2] > 0
    assert gradient[1, 1, 2] > 0 > gradient[1, 0, 2]  # and the plate comes to meet it
    _, gradient = total(
        replace(batch, poses=batch.poses - torch.tensor([0, 0, 0.05, 0])), geometry, LossSettings(support_weight=0)
    )
    assert gradient[0, 0, 2] < 0


def test_beyond_the_edge_and_in_the_zone_costs_only_where_it_is_asked_for() -> None:
    over = scene(thing("cube_1", (1.03, 0.4, 0.05, 0.0)))
    entering = scene(thing("cube_1", (0.21, 0.4, 0.05, 0.0)), zone=(0.0, 0.2, 0.0, 0.8))
    batch, geometry = batch_of([over, entering, scene(thing("cube_1", (0.5, 0.4, 0.05, 0.0)))])
    found = bounds_loss(batch.poses, batch, geometry).sqrt()
    assert found.tolist() == pytest.approx([0.08, 0.04, 0.0], abs=1.5e-3)
    assert terms(batch, geometry).bounds.tolist() == [0.0] * 3
    assert terms(batch, geometry, LossSettings(bounds_weight=0.1)).bounds.sqrt()[0].item() == pytest.approx(0.08, abs=1.5e-3)
    _, gradient = total(batch, geometry, LossSettings(bounds_weight=1, sdf_weight=0, support_weight=0))
    assert gradient[0, 0, 0] > 0 > gradient[1, 0, 0]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_gradients_are_those_of_finite_differences(seed: int) -> None:
    batch, geometry = shaken(seed, num_scenes=4)
    poses = batch.poses.double().requires_grad_()
    chosen = replace(ALL, length_unit=0.1)  # of order one

    def losses(moved: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = physics_losses(moved, batch, geometry, chosen)
        return found.object_object, found.object_table, found.support, found.bounds

    assert all(value.sum() > 0 for value in losses(poses))
    assert torch.autograd.gradcheck(losses, poses, eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_it_agrees_with_grid_sample_on_one_grid_a_pair(seed: int) -> None:
    batch, geometry = shaken(seed, num_scenes=3)
    cubes, every = with_cubes(geometry), all_pairs(batch.poses, batch)
    found: list[torch.Tensor] = []
    for is_ours in (False, True):
        poses = batch.poses.double().requires_grad_()
        value = our_losses(poses, batch, cubes, PAPER) if is_ours else copied_losses(poses, batch, cubes, every, PAPER)
        found += [value.detach(), *torch.autograd.grad(value.sum(), poses)]
    assert found[0].min() > 0
    torch.testing.assert_close(found[2], found[0], rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found[3], found[1], rtol=1e-4, atol=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 1e-3, 2e-2]), st.sampled_from([0.05, 0.1, 0.3]))
def test_the_broad_phase_drops_no_pair_that_contributes(seed: int, clearance: float, spread: float) -> None:
    batch, geometry = shaken(seed, num_scenes=1, spread=spread)
    near = colliding_pairs(batch.poses, batch, geometry, clearance)
    every = all_pairs(batch.poses, batch)
    kept, full = (object_object_loss(batch.poses, batch, geometry, pairs, clearance) for pairs in (near, every))
    torch.testing.assert_close(kept, full)


def test_padding_leaks_nothing() -> None:
    batch, geometry = shaken(0)
    padded, _ = shaken(0, num_slots=11)
    expected, gradient = total(batch, geometry)
    poses, sizes = padded.poses.clone(), padded.sizes.clone()
    poses[~padded.mask], sizes[~padded.mask] = torch.nan, torch.nan
    found, padded_gradient = total(replace(padded, poses=poses, sizes=sizes), geometry)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(padded_gradient[:, : gradient.shape[1]], gradient)
    assert (padded_gradient[~padded.mask] == 0).all()


def test_scenes_do_not_know_of_each_other() -> None:
    batch, geometry = shaken(1, num_scenes=3)
    losses, gradient = total(batch, geometry)
    for k in range(3):
        alone, its_gradient = total(batch.take(torch.tensor([k])), geometry)
        torch.testing.assert_close(alone, losses[k : k + 1])
        torch.testing.assert_close(its_gradient, gradient[k : k + 1])


def test_permuting_the_objects_permutes_the_gradients() -> None:
    batch, geometry = shaken(2, num_slots=8)
    losses, gradient = total(batch, geometry)
    order = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    names = ("poses", "mask", "sizes", "shape_index", "is_fixed", "parent")
    permuted = replace(batch, **{name: getattr(batch, name)[:, order] for name in names})
    found, permuted_gradient = total(permuted, geometry)
    torch.testing.assert_close(found, losses)
    torch.testing.assert_close(permuted_gradient, gradient[:, order])


def test_fixed_objects_are_obstacles() -> None:
    batch, geometry = shaken(3)
    batch.is_fixed[:, :3] = True
    _, gradient = total(batch, geometry)
    assert (gradient[:, :3] == 0).all()
    assert (gradient[:, 3:] != 0).any()
    batch.is_fixed[:] = True
    losses, gradient = total(batch, geometry)
    assert (losses == 0).all()
    assert (gradient == 0).all()


def test_half_precision_around_it_changes_nothing() -> None:
    batch, geometry = shaken(0)
    expected = physics_losses(batch.poses, batch, geometry, ALL).weighted(ALL)
    with torch.autocast("cpu", torch.bfloat16):
        found = physics_losses(batch.poses, batch, geometry, ALL).weighted(ALL)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    torch.testing.assert_close(expected.double(), total(batch, geometry)[0], rtol=1e-3, atol=1e-6)


def test_scenes_without_objects_cost_nothing() -> None:
    batch, geometry = batch_of([scene(), scene(thing("cube", (0.5, 0.5, 0.05, 0.0)))])
    assert total(batch, geometry)[0][0] == 0
    nothing, geometry = batch_of([])
    assert total(nothing, geometry)[0].shape == (0,)


@pytest.mark.slow
def test_physically_clean_scenes_cost_nearly_nothing(tmp_path: Path) -> None:
    write_world(tmp_path, 3, EmbeddedWorld(pictures=False))
    dataset = MesaTaskDataset(tmp_path)
    shapes = ShapeCollector(AssetStore(dataset))
    batch = LayoutBatch.from_scenes([dataset.read(scene_id)[0] for scene_id in dataset.scene_ids], shapes)
    losses = physics_losses(batch.poses, batch, shapes.geometry(), LossSettings(length_unit=1e-3, bounds_weight=1))
    for value in (losses.object_object, losses.object_table, losses.support, losses.bounds):
        assert value.sqrt().max() < 0.5  # millimetres


def test_the_preset_is_the_papers() -> None:
    one = torch.ones(1)
    assert PhysicsLosses(one, one, one, one).weighted(LossSettings()).item() == pytest.approx(2 * 0.02 + 0.01)


def test_a_centimetre_is_the_unit_of_the_preset() -> None:
    batch, geometry = batch_of([scene(thing("cube", (0.5, 0.5, 0.03, 0.0)))])
    assert physics_losses(batch.poses, batch, geometry).object_table.item() == pytest.approx(4.0, rel=1e-4)


def test_the_flow_loss_is_a_mean_over_objects() -> None:
    velocity, target = torch.zeros(2, 3, 4), torch.ones(2, 3, 4)
    mask = torch.tensor([[True, False, False], [True, True, False]])
    target[~mask] = torch.nan
    velocity[1, 1] = 3.0
    velocity.requires_grad_()
    loss = flow_loss(velocity, target, mask)
    assert loss.item() == pytest.approx((4 + 4 + 16) / 3)
    loss.backward()  # type: ignore[no-untyped-call]
    assert velocity.grad is not None
    assert (velocity.grad[~mask] == 0).all()
    assert flow_loss(velocity, target, torch.zeros_like(mask)).item() == 0
    torch.testing.assert_close(support_loss(torch.zeros(1, 0, 4), *batch_of([scene()])), torch.zeros(1))
