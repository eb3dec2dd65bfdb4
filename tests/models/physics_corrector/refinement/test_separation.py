"""Bodies are parted along the table with little movement; what is carried comes along."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.physics_corrector.refinement.separation import separate_bodies
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene
from tests.models.physics_corrector.geometry.shapes import scene, thing
from tests.models.physics_corrector.refinement.layouts import problem_of, shapes_of

CLEAR = 4e-4


def separated(of: Scene, fixed: frozenset[str] = frozenset()) -> np.ndarray:
    problem = problem_of(of, fixed=fixed)
    return separate_bodies(problem.layout.poses, problem, CLEAR, 60)[0].numpy()


def test_two_cubes_part_by_their_overlap() -> None:
    before = scene(thing("cube_0", (0.4, 0.4, 0.05, 0)), thing("cube_1", (0.49, 0.4, 0.05, 0)))
    after = separated(before)
    assert after[1, 0] - after[0, 0] == pytest.approx(0.1 + CLEAR, abs=1e-3)
    assert after[:, 0].mean() == pytest.approx(0.445, abs=1e-4)  # each moves as far
    assert after[:, 1] == pytest.approx([0.4, 0.4], abs=1e-6)
    assert after[:, 2:] == pytest.approx(before.poses()[:, 2:])


def test_a_fixed_cube_stays_and_the_other_moves() -> None:
    before = scene(thing("cube_0", (0.4, 0.4, 0.05, 0)), thing("cube_1", (0.49, 0.4, 0.05, 0)))
    after = separated(before, frozenset({"cube_0"}))
    assert after[0].tolist() == before.poses().astype(np.float32)[0].tolist()
    assert after[1, 0] == pytest.approx(0.5 + CLEAR, abs=1e-3)


def test_what_is_carried_comes_along() -> None:
    before = scene(
        thing("plate", (0.4, 0.4, 0.005, 0), support="table"),
        thing("ball", (0.4, 0.4, 0.06, 0), support="plate"),
        thing("cube", (0.52, 0.4, 0.05, 0), support="table"),
    )
    after = separated(before)
    assert after[1] - after[0] == pytest.approx(before.poses()[1] - before.poses()[0], abs=1e-6)
    assert after[2, 0] - after[0, 0] > 0.15


@pytest.mark.parametrize(("x", "y"), [(0.02, 0.4), (0.97, 0.77), (0.4, -0.1)])
def test_bodies_return_to_the_table(x: float, y: float) -> None:
    (after,) = separated(scene(thing("cube", (x, y, 0.05, 0))))
    assert (after[:2] - 0.05 >= -1e-3).all()
    assert (after[:2] + 0.05 <= np.array([1.0, 0.8]) + 1e-3).all()


def test_bodies_leave_the_restricted_zone_on_the_table() -> None:
    before = scene(thing("cube", (0.5, 0.12, 0.05, 0)), zone=(0.3, 0.7, 0.0, 0.2))
    (after,) = separated(before)
    assert after[1] - 0.05 >= 0.2 - 1e-3
    assert after[0] == pytest.approx(0.5)


def test_objects_that_do_not_touch_stay_bit_by_bit() -> None:
    before = scene(thing("cube_0", (0.2, 0.2, 0.05, 0.3)), thing("ball", (0.6, 0.5, 0.05, 0)))
    problem = problem_of(before)
    assert torch.equal(separate_bodies(problem.layout.poses, problem, CLEAR, 60), problem.layout.poses)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_loose_tables_are_parted(seed: int) -> None:
    """Of seven things at random on a table with much room none is deeper in another one than the grids and samples can see."""
    rng = np.random.default_rng(seed)
    names = ("cube_0", "cube_1", "ball_0", "ball_1", "bowl_0", "cup_0", "plate_0")
    height = {"cube": 0.05, "ball": 0.05, "bowl": 0.04, "cup": 0.05, "plate": 0.005}
    things = []
    for name in names:
        x, y, yaw = rng.uniform([0.15, 0.15, -3], [0.85, 0.65, 3])
        o = thing(name, (x, y, height[name.split("_")[0]], yaw), support="table")
        things.append(o.moved((x, y, o.size[2] / 2), yaw))
    before = scene(*things)
    problem = problem_of(before)
    poses = problem.layout.poses
    for clearance, iterations in ((CLEAR, 60), (1e-3, 100), (2e-3, 200)):
        poses = separate_bodies(poses, problem, clearance, iterations)
    after = before.with_poses(poses[0].double().numpy())
    card = audit_scene(after, shapes_of(before)).card()
    assert card.max_penetration_mm is not None
    assert card.max_penetration_mm < 2.0
    assert card.out_of_bounds_rate == 0
