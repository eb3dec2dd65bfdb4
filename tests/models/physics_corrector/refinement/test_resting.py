"""Carried objects come to rest on what is below them; roots stand on the table."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from models.physics_corrector.refinement.resting import lower_onto, stand_on_table, step_aside, unrested
from models.physics_corrector.refinement.steadiness import steadiness
from stable_data.scene import Scene
from tests.models.physics_corrector.geometry.shapes import RADIUS, SHAPES, scene, thing
from tests.models.physics_corrector.refinement.layouts import problem_of


def carried_on(lower: str, upper: str, x: float, z: float) -> Scene:
    below = thing(lower, (0.4, 0.4, SHAPES[lower].size[2] / 2, 0), support="table")
    return scene(below, thing(upper, (0.4 + x, 0.4, z, 0), support=below.instance))


def rested(of: Scene) -> tuple[np.ndarray, float]:
    problem = problem_of(of)
    poses, rest = lower_onto(problem.layout.poses, problem, problem.carried)
    return poses[0].numpy(), float(rest.max())


@pytest.mark.parametrize("start", [0.0, 0.02, -0.008, -0.03])
def test_a_cube_rests_on_a_plate(start: float) -> None:
    """It floats or is sunk by up to the thickness of three plates, and ends on the top, at 1 cm."""
    poses, rest = rested(carried_on("plate", "cube", 0.02, 0.06 + start))
    assert poses[1, 2] == pytest.approx(0.06, abs=4e-4)
    assert rest < 4e-4
    assert poses[1, :2] == pytest.approx([0.42, 0.4])


def test_a_ball_rests_in_a_bowl() -> None:
    poses, rest = rested(carried_on("bowl", "ball", 0.0, 0.12))
    inner = 0.006  # the ball stands on the middle of the floor, which is as thick as the wall
    assert poses[1, 2] == pytest.approx(RADIUS + inner, abs=1.5e-3)
    assert rest < 4e-4


def test_what_an_object_carries_comes_along() -> None:
    of = scene(
        thing("plate_0", (0.4, 0.4, 0.005, 0), support="table"),
        thing("cube", (0.4, 0.4, 0.08, 0), support="plate_0"),
        thing("plate_1", (0.4, 0.4, 0.135, 0), support="cube"),
    )
    problem = problem_of(of)
    moving = torch.tensor([False, True, False])
    poses = lower_onto(problem.layout.poses, problem, moving)[0][0]
    assert float(poses[1, 2]) == pytest.approx(0.06, abs=4e-4)
    assert float(poses[2, 2] - poses[1, 2]) == pytest.approx(0.055, abs=1e-6)


def test_each_object_of_a_stack_is_judged_by_the_one_below_it() -> None:
    cubes = [thing(f"cube_{k}", (0.4, 0.4, 0.06 + 0.1 * k, 0), support=f"cube_{k - 1}" if k else "plate") for k in range(3)]
    plate = thing("plate", (0.4, 0.4, 0.005, 0), support="table")
    problem = problem_of(scene(plate, *cubes))
    assert not unrested(problem.layout.poses, problem, problem.carried).any()
    floating = problem_of(scene(plate, cubes[0], replace(cubes[1], position=(0.4, 0.4, 0.165)), cubes[2]))
    assert unrested(floating.layout.poses, floating, floating.carried).tolist() == [False, False, True, True]


def test_only_what_floats_or_is_sunk_has_to_come_to_rest() -> None:
    found = [
        bool(unrested((p := problem_of(of)).layout.poses, p, p.carried)[1])
        for of in (
            carried_on("plate", "cube", 0, 0.0601),
            carried_on("plate", "cube", 0, 0.063),
            carried_on("plate", "cube", 0, 0.058),
        )
    ]
    assert found == [False, True, True]


def test_roots_stand_on_the_table_with_what_they_carry() -> None:
    of = scene(thing("plate", (0.4, 0.4, 0.025, 0), support="table"), thing("cube", (0.4, 0.4, 0.08, 0), support="plate"))
    problem = problem_of(of)
    assert stand_on_table(problem.layout.poses, problem)[0, :, 2].tolist() == pytest.approx([0.005, 0.06])
    stuck = problem_of(of, fixed=frozenset({"cube"}))
    assert torch.equal(stand_on_table(stuck.layout.poses, stuck), stuck.layout.poses)


def test_things_on_a_plate_step_aside() -> None:
    of = scene(
        thing("plate", (0.4, 0.4, 0.005, 0), support="table"),
        thing("ball_0", (0.38, 0.4, 0.06, 0), support="plate"),
        thing("ball_1", (0.46, 0.4, 0.06, 0), support="plate"),
    )
    problem = problem_of(of)
    poses = step_aside(problem.layout.poses, problem, problem.carried, 3e-4, 20)[0]
    assert float(poses[2, 0] - poses[1, 0]) > 2 * RADIUS - 3e-4
    assert torch.equal(poses[0], problem.layout.poses[0, 0])


@pytest.mark.parametrize(("x", "steady"), [(0.0, 1.0), (0.04, 1.0), (0.09, 0.2), (0.11, -0.2), (0.14, -0.8)])
def test_the_steadiness_of_a_cube_over_the_edge_of_a_plate(x: float, steady: float) -> None:
    """The plate ends 10 cm from its middle: the distance of the cube's middle from there, over half its side."""
    of = carried_on("plate", "cube", x, 0.06)
    problem = problem_of(of)
    found = steadiness(problem.layout.poses, problem, problem.carried)
    assert float(found[1]) == pytest.approx(steady, abs=0.12)
    assert torch.isinf(found[0])


def test_nothing_carries_what_floats() -> None:
    problem = problem_of(carried_on("plate", "cube", 0, 0.08))
    assert float(steadiness(problem.layout.poses, problem, problem.carried)[1]) == -torch.inf
