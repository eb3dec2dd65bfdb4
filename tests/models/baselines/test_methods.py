"""Every baseline behind the one interface, on scenes whose answer is plain."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from models.baselines.mesatask import MesaTask
from models.baselines.methods import METHODS
from models.baselines.outcome import Baseline, BaselineResult
from models.baselines.penalty import PenaltyDescent
from models.baselines.settling import Settle
from models.baselines.steerable import Steerable
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.scene import Relation, RelationKind, Scene, SceneObject
from stable_data.simulation.collision_bodies import parts_of
from stable_data.simulation.settling import PhysicsOptions
from tests.models.physics_corrector.geometry.shapes import RADIUS, SIDE, scene, store, thing

MOVERS: Mapping[str, Baseline] = {name: m for name, m in METHODS.items() if name != "mesatask_released"}


def corrected(method: Baseline, given: Scene) -> BaselineResult:
    resolved, shapes, _ = store().resolved(given)
    return method.correct(resolved, shapes, store())


def card(given: Scene) -> MetricCard:
    return audit_scene(given, store().shapes(given)[0]).card()


def moves(given: Scene, outcome: BaselineResult) -> list[float]:
    shift: list[float] = np.linalg.norm(outcome.scene.poses()[:, :3] - given.poses()[:, :3], axis=1).tolist()
    return shift


def two_cubes(overlap: float = 0.02) -> Scene:
    """On the table, side by side, one a little in the other; and one that is nobody's concern."""
    z = SIDE / 2 + 1e-4
    return scene(
        thing("cube_0", (0.4, 0.4, z, 0.0)),
        thing("cube_1", (0.4 + SIDE - overlap, 0.42, z, 0.0)),
        thing("cube_2", (0.8, 0.2, z, 0.7)),
    )


def ball_in_bowl() -> Scene:
    """A small ball in a bowl: no collision, but the bowl's hull is full."""
    bowl, ball = thing("bowl_0", (0.5, 0.4, 0.04, 0.0)), thing("ball_0", (0.5, 0.4, 0.031, 0.0), scale=(0.4, 0.4, 0.4))
    relation = Relation("ball_0", RelationKind.IN, "bowl_0")
    return replace(scene(bowl, ball), relations=(relation,))


@pytest.mark.parametrize("name", sorted(MOVERS))
def test_two_cubes_are_parted(name: str) -> None:
    start = two_cubes()
    assert card(start).num_collisions == 1
    outcome = corrected(MOVERS[name], start)
    assert outcome.converged, outcome.reason
    assert card(outcome.scene).num_collisions == 0
    assert card(outcome.scene).clean
    assert [o.instance for o in outcome.scene.objects] == [o.instance for o in start.objects]
    left, right, idle = moves(start, outcome)
    assert left + right > 0.02 - 1e-3
    assert idle < 1e-3
    assert outcome.seconds > 0


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_scene_without_objects_stays(name: str) -> None:
    assert corrected(METHODS[name], scene()).scene == scene()


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_missing_mesh_is_a_box(name: str) -> None:
    gone = SceneObject("gone_0", "gone", (0.45, 0.4, SIDE / 2), 0.0, (SIDE, SIDE, SIDE), "nowhere", (1.0, 1.0, 1.0))
    start = scene(*two_cubes().objects, gone)
    outcome = corrected(METHODS[name], start)
    assert [o.instance for o in outcome.scene.objects] == [o.instance for o in start.objects]
    assert card(outcome.scene).clean is not True


def test_yaw_and_tilt_stay_where_only_positions_are_free() -> None:
    start = two_cubes()
    turned = replace(start, objects=tuple(o.moved(o.position, 0.3) for o in start.objects))
    for name in ("steerable", "steerable_parts", "mesatask"):
        objects = corrected(METHODS[name], turned).scene.objects
        assert [(o.yaw, o.tilt_quat_xyzw) for o in objects] == [(o.yaw, o.tilt_quat_xyzw) for o in turned.objects]


def test_steerable_moves_as_little_as_can_be() -> None:
    start = two_cubes()
    outcome = corrected(Steerable(), start)
    assert moves(start, outcome)[:2] == pytest.approx([0.01, 0.01], abs=2e-5)


def test_steerable_lifts_what_is_in_the_table() -> None:
    sunk = scene(thing("cube_0", (0.4, 0.4, SIDE / 2 - 0.01, 0.0)))
    outcome = corrected(Steerable(), sunk)
    assert outcome.scene.objects[0].position == pytest.approx((0.4, 0.4, SIDE / 2), abs=5e-5)


def test_hulls_expel_what_convex_parts_hold() -> None:
    start = ball_in_bowl()
    assert card(start).num_collisions == 0
    assert max(moves(start, corrected(Steerable(), start))) > 0.01
    assert max(moves(start, corrected(Steerable(with_parts=True), start))) < 0.005


def test_out_of_time_is_not_converged() -> None:
    outcome = corrected(Steerable(max_seconds=-1.0), two_cubes())
    assert not outcome.converged
    assert "out of time" in outcome.reason


def test_mesatask_leaves_a_centimetre_and_heights() -> None:
    start = two_cubes()
    outcome = corrected(MesaTask(), start)
    first, second, _ = outcome.scene.poses()
    assert abs(first[0] - second[0]) == pytest.approx(SIDE + 0.01, abs=3e-5)
    assert outcome.scene.poses()[:, 2].tolist() == start.poses()[:, 2].tolist()


def test_mesatask_lifts_what_the_scene_graph_says_is_on_or_in_something() -> None:
    bowl = thing("bowl_0", (0.5, 0.4, 0.02, 0.0), scale=(1.5, 1.5, 0.5))
    ball = thing("ball_0", (0.5, 0.4, 0.03, 0.0), scale=(0.2, 0.2, 0.2))
    start = replace(scene(bowl, ball), relations=(Relation("ball_0", RelationKind.IN, "bowl_0"),))
    after = corrected(MesaTask(), start).scene.poses()
    assert after[0, 2] == start.poses()[0, 2]
    assert after[1, 2] == pytest.approx(0.04 + 0.01 + 0.01, abs=1e-3)
    # Without the relation it may only go sideways, where the distance does not change at first: no gradient leads out.
    stuck = corrected(MesaTask(), replace(start, relations=()))
    assert not stuck.converged
    assert stuck.scene.poses().tolist() == start.poses().tolist()
    # What stands on something may go up only.
    stack = scene(thing("cube_0", (0.4, 0.4, SIDE / 2, 0.0)), thing("cube_1", (0.42, 0.4, 1.4 * SIDE, 0.0)))
    stack = replace(stack, relations=(Relation("cube_1", RelationKind.ON, "cube_0"),))
    after = corrected(MesaTask(), stack).scene.poses()
    assert after[:, :2].tolist() == stack.poses()[:, :2].tolist()
    assert after[1, 2] - after[0, 2] == pytest.approx(SIDE + 0.01, abs=3e-5)


def test_mesatask_s_windows_reach_around_the_scene() -> None:
    z = SIDE / 2
    row = scene(*(thing(f"cube_{n}", (0.06 + 0.105 * n, 0.4, z, 0.0)) for n in range(8)))
    outcome = corrected(MesaTask(), row)
    assert outcome.converged, outcome.reason
    apart = np.diff(outcome.scene.poses()[:, 0])
    assert (outcome.scene.poses()[:, :2] <= (1.0, 0.8)).all()
    assert card(outcome.scene).num_collisions == 0
    assert np.abs(apart).max() < 1


def test_mesatask_as_released() -> None:
    few = corrected(MesaTask(is_released=True), two_cubes())
    assert not few.converged
    assert few.scene == two_cubes()
    assert "repeats one" in few.reason
    z = SIDE / 2
    # It keeps 1 cm and counts 5 cm: the pair that it parts is still near, so the result is not taken.
    six = scene(
        *two_cubes().objects,
        *(thing(f"cube_{n}", (0.1 + 0.2 * n, 0.7, z, 0.0)) for n in (3, 4, 5)),
        thing("cube_6", (0.1, 0.1, z, 0.0)),
    )
    six = scene(*(o.moved((min(o.position[0], 0.94), *o.position[1:]), o.yaw) for o in six.objects if o.instance != "cube_5"))
    taken = corrected(MesaTask(is_released=True), six)
    assert not taken.converged
    assert taken.scene == six
    assert "not used" in taken.reason
    # A plate on its edge is taken to lie as its file has it: what collides is not what it sees.
    assert card(taken.scene).num_collisions == 1


def test_penalty_descent_reduces_the_overlap_and_keeps_heights() -> None:
    start = two_cubes(overlap=0.05)
    before = card(start).max_penetration_mm
    halfway = corrected(PenaltyDescent(num_steps=10), start)
    assert not halfway.converged
    assert "mm deep" in halfway.reason
    some, end = card(halfway.scene).max_penetration_mm, corrected(PenaltyDescent(), start)
    left = card(end.scene).max_penetration_mm
    assert before is not None
    assert some is not None
    assert left is not None
    assert before > some > left
    assert end.converged
    assert end.scene.poses()[:, 2].tolist() == start.poses()[:, 2].tolist()


def test_penalty_descent_leaves_a_clean_scene_alone_and_brings_back_what_leaves_the_table() -> None:
    clean = scene(thing("cube_0", (0.4, 0.4, SIDE / 2, 0.0)), thing("ball_0", (0.6, 0.4, RADIUS, 0.0)))
    assert max(moves(clean, corrected(PenaltyDescent(), clean))) == 0
    over = scene(thing("cube_0", (0.98, 0.4, SIDE / 2, 0.0)))
    assert corrected(PenaltyDescent(), over).scene.objects[0].position[0] < 0.952
    assert corrected(PenaltyDescent(bounds_weight=0.0), over).scene == over


def test_settling_lets_things_fall_and_tip() -> None:
    # A cube turned a little on its edge comes to lie flat on a side; the store gives its new shape the size that it says.
    a = np.radians(20)
    tilted = thing("cube_0", (0.5, 0.4, 0.1, 0.4), tilt=(float(np.sin(a / 2)), 0.0, 0.0, float(np.cos(a / 2))))
    start = scene(tilted)
    outcome = corrected(Settle(), start)
    assert outcome.converged, outcome.reason
    (o,) = outcome.scene.objects
    assert o.size == pytest.approx((SIDE, SIDE, SIDE), abs=2e-3)
    assert o.position[2] == pytest.approx(SIDE / 2, abs=1e-3)
    shape = store().shapes(outcome.scene)[0][0]
    assert shape.size == pytest.approx(o.size, abs=1e-9)
    assert card(outcome.scene).num_collisions == 0


def test_settling_keeps_the_yaw_of_what_stays() -> None:
    start = scene(thing("cube_0", (0.5, 0.4, SIDE / 2, 2.5)))
    (o,) = corrected(Settle(), start).scene.objects
    assert o.yaw == pytest.approx(2.5, abs=1e-3)
    assert o.position == pytest.approx((0.5, 0.4, SIDE / 2), abs=1e-3)


def test_what_still_falls_has_not_settled() -> None:
    start = scene(thing("cube_0", (1.5, 0.4, SIDE / 2, 0.0)))
    outcome = corrected(Settle(PhysicsOptions(settle_seconds=0.2, watch_seconds=0.1)), start)
    assert not outcome.converged
    assert "still moves" in outcome.reason
    assert outcome.scene.objects[0].position[2] < 0


def test_convex_parts_lie_where_the_shape_does() -> None:
    o = thing("bowl_0", (0.0, 0.0, 0.0, 0.0), scale=(1.2, 1.2, 0.9), tilt=(0.6, 0.0, 0.0, 0.8))
    shape = store().shapes(scene(o))[0][0]
    parts = parts_of(o, shape, store())
    assert len(parts) > 1
    corners = np.concatenate([part.vertices for part in parts])
    assert np.abs(corners.min(axis=0) - shape.vertices.min(axis=0)).max() < 2e-3
    assert np.abs(corners.max(axis=0) - shape.vertices.max(axis=0)).max() < 2e-3
    assert parts_of(o, shape, store())[0].faces is parts[0].faces  # cut up once
