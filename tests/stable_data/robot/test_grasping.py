"""Grasps: opposite points of analytic shapes, a hand that fits, and trials in the scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.robot.arm.clearance import SELF, HeldObject
from stable_data.robot.arm.robots import ROBOTS
from stable_data.robot.grasp_trial import GraspOutcome
from stable_data.robot.grasps import grasps_at, opposite_pairs
from tests.scenes import ball, box, cup
from tests.stable_data.export.runs import thing
from tests.stable_data.robot.tables import BOX, CAN, MUG, PLATE, Bench, geometry_in, laid_table

HAND = ROBOTS["simple"].hand


def test_a_box_is_held_across_its_narrow_sides() -> None:
    pairs = opposite_pairs(box(0.04, 0.3, 0.06), HAND)
    assert len(pairs.widths)
    along = abs(pairs.directions)
    assert (along[:, 1] < 0.5).all()  # never along the 30 cm
    exact = pairs.quality > 0.999
    assert set(np.round(pairs.widths[exact], 3)) <= {0.04, 0.06}


def test_a_ball_is_held_through_its_middle() -> None:
    pairs = opposite_pairs(ball(0.03), HAND)
    assert np.linalg.norm(pairs.centres, axis=1).max() < 0.015
    assert pairs.widths == pytest.approx(0.06, abs=0.0045)  # chords within the cone


def test_a_thin_wall_is_found() -> None:
    pairs = opposite_pairs(cup(0.06, 0.1, 0.003), HAND)
    walls = pairs.widths[abs(pairs.directions[:, 2]) < 0.3]
    assert len(walls)
    assert walls == pytest.approx(0.003, abs=5e-4)


def test_the_order_of_vertices_and_faces_does_not_matter() -> None:
    shape, rng = cup(0.06, 0.1, 0.003), np.random.default_rng(3)
    place = rng.permutation(len(shape.vertices))
    faces = np.argsort(place)[shape.faces][rng.permutation(len(shape.faces))]
    other = Shape(shape.vertices[place], np.roll(faces, 1, axis=1))
    one, two = opposite_pairs(shape, HAND), opposite_pairs(other, HAND)
    assert two.centres == pytest.approx(one.centres, abs=1e-9)
    assert two.widths == pytest.approx(one.widths, abs=1e-9)


@pytest.mark.parametrize("shape", [box(0.2, 0.3, 0.25), ball(0.06)])
def test_what_is_wider_than_the_hand_has_no_grasp(shape: Shape) -> None:
    assert not len(opposite_pairs(shape, HAND).widths)
    assert not len(grasps_at(opposite_pairs(shape, HAND), np.zeros(3), np.eye(3), HAND))


def test_grasps_are_right_handed_and_stay_above_the_table() -> None:
    shape = box(0.05, 0.12, 0.03)
    grasps = grasps_at(opposite_pairs(shape, HAND), np.array([0.3, 0.2, 0.015]), np.eye(3), HAND)
    assert len(grasps)
    assert np.linalg.det(grasps.rotations) == pytest.approx(1.0)
    assert (grasps.rotations[:, 2, 2] < 0).all()  # the approach points down
    tips = grasps.positions[:, 2] + HAND.tip * grasps.rotations[:, 2, 2]
    assert tips.min() > 0
    assert (np.diff(grasps.scores) <= 1e-12).all()


def test_a_can_is_grasped_and_the_scene_is_as_before(bench: Bench) -> None:
    before = bench.world.object_poses
    survey = bench.finder.survey(bench.world, CAN)
    assert survey.reachable
    assert survey.reason is None
    outcomes = [outcome for _, outcome in bench.finder.trials(bench.world, survey.reachable, 3)]
    assert GraspOutcome.HELD in outcomes
    assert bench.world.object_poses == pytest.approx(before, abs=1e-12)


def test_a_held_object_is_in_the_air_and_touches_nothing_else(bench: Bench) -> None:
    survey = bench.finder.survey(bench.world, CAN)
    grasp = next(g for g, outcome in bench.finder.trials(bench.world, survey.reachable, 5) if outcome is GraspOutcome.HELD)
    start = bench.world.object_poses[bench.index(CAN), 2]
    assert bench.finder.try_grasp(bench.world, grasp) is GraspOutcome.HELD
    contacts = bench.world.contacts()
    assert contacts.held == {CAN}
    assert CAN not in contacts.supports
    assert bench.world.object_poses[bench.index(CAN), 2] > start + 0.05
    assert contacts.supports[MUG] == ("table",)


def test_a_lying_box_that_is_too_wide_says_so(bench: Bench) -> None:
    survey = bench.finder.survey(bench.world, BOX)
    if not survey.num_candidates:
        assert survey.reason == "too_wide"
    else:
        assert survey.reachable or survey.reason is not None


def test_grasps_that_are_found_one_by_one_are_those_of_the_survey(bench: Bench) -> None:
    survey, found = bench.finder.survey(bench.world, CAN), list(bench.finder.reachable(bench.world, CAN))
    assert len(found) == len(survey.reachable) > 0
    for one, other in zip(found, survey.reachable, strict=True):
        assert np.array_equal(one.approach, other.approach)


def test_what_is_far_away_is_out_of_reach(tmp_path: Path) -> None:
    scene = laid_table()
    far = replace(scene, table=replace(scene.table, size_xy=(1.0, 2.0)), objects=(thing("can/0", CAN, 0.5, 1.8, 0.0),))
    bench = Bench(geometry_in(tmp_path, far))
    survey = bench.finder.survey(bench.world, CAN)
    assert survey.num_candidates
    assert not survey.reachable
    assert survey.reason == "out_of_reach"


def test_what_stands_in_the_way_is_named(bench: Bench) -> None:
    arm, built = bench.arm, bench.built
    down = np.diag([1.0, -1.0, -1.0])
    into = built.mount.to_base(np.array([0.4, 0.25, 0.03]))  # into the can
    found = arm.solve(into[None], down[None])
    assert found.found[0]
    assert bench.clearance.hits(found.joints[0], 0.08) == CAN
    below = arm.solve((into - [0.0, 0.0, 0.08])[None], down[None])
    assert bench.clearance.hits(below.joints[0], 0.08, allowed=frozenset({CAN})) == "table"
    assert bench.clearance.hits(arm.home, 0.08) is None


def test_an_object_in_the_hand_collides_with_the_scene_but_not_with_the_hand(bench: Bench) -> None:
    bench.clearance.look(bench.world)
    bench.clearance.hold(HeldObject(CAN, np.zeros(3), np.diag([1.0, -1.0, -1.0])))
    assert bench.clearance.hits(bench.arm.home, 0.05) is None
    over_plate = bench.built.mount.to_base(np.array([0.55, 0.45, 0.04]))
    found = bench.arm.solve(over_plate[None], np.diag([1.0, -1.0, -1.0])[None])
    assert bench.clearance.hits(found.joints[0], 0.05) in {PLATE, "table"}
    bench.clearance.hold(None)
    assert bench.clearance.hits(bench.arm.home, 0.05) != SELF
