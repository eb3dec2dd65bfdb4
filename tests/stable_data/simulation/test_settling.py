import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray, Tabletop, Vec3
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.settling import (
    MOVE_LIMIT,
    Calm,
    Inertial,
    PhysicsOptions,
    RigidBody,
    SettleResult,
    _simulate,
    compile_bodies,
    compile_spec,
    enable_sleeping,
    hull_volume,
    settle,
    spec_of,
)

pytestmark = pytest.mark.sim

TABLE = Tabletop("office_table", (1.0, 0.6))
AT_REST = np.array([[0.5, 0.3, 0.05, 0.0, 0.0, 0.0, 1.0]])
SHORT = PhysicsOptions(settle_seconds=0.4, watch_seconds=0.4)


def box(x: float, y: float, z: float) -> Mesh:
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * (x, y, z)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return Mesh(corners, faces)


def block(name: str, position: Vec3, *, size: Vec3 = (0.1, 0.1, 0.1), yaw: float = 0.0, movable: bool = True) -> RigidBody:
    return RigidBody(name, (box(*size),), 0.5, position, yaw, movable)


def yaw_of(quat_xyzw: FloatArray) -> float:
    return float(2 * np.arctan2(quat_xyzw[2], quat_xyzw[3]))


def test_box_on_table_is_stable_and_keeps_its_pose() -> None:
    result = settle([block("a", (0.5, 0.3, 0.05), yaw=0.7)], TABLE)
    assert result.stable is True
    assert result.reason == ""
    np.testing.assert_allclose(result.positions, [[0.5, 0.3, 0.05]], atol=1e-4)
    assert yaw_of(result.quats_xyzw[0]) == pytest.approx(0.7, abs=1e-4)
    assert result.jitter_mm is not None
    assert result.jitter_mm < 0.01


def test_contact_at_rest_is_shallower_than_the_tolerance() -> None:
    stack = [block(str(k), (0.5, 0.3, 0.05 + 0.1 * k)) for k in range(4)]
    rest = settle(stack, TABLE)
    again = [block(str(k), tuple(rest.positions[k])) for k in range(4)]
    result = settle(again, TABLE, SHORT)
    assert result.engine_penetration_mm is not None
    assert result.engine_penetration_mm < 0.25


@pytest.mark.parametrize("depth", [0.0005, 0.002])
def test_engine_penetration_is_the_depth_in_the_table(depth: float) -> None:
    result = settle([block("a", (0.5, 0.3, 0.05 - depth))], TABLE, SHORT)
    assert result.engine_penetration_mm == pytest.approx(1e3 * depth, rel=1e-3)


@pytest.mark.parametrize("mass", [0.0, -1.0, np.inf, np.nan])
def test_a_mass_that_no_thing_has_is_unknown_and_not_an_explosion(mass: float) -> None:
    result = settle([replace(block("a", (0.5, 0.3, 0.05)), mass=mass)], TABLE, SHORT)
    assert result.stable is None
    assert "body a: mass is" in result.reason


def test_what_has_gone_too_far_is_not_watched_in_a_hurry_and_what_stays_is() -> None:
    """The verdict is the same; what would come later is unknown."""
    falls, stays = block("a", (0.5, 0.3, 0.15)), block("a", (0.5, 0.3, 0.05))
    early = settle([falls], TABLE, PhysicsOptions(stops_early=True))
    whole = settle([falls], TABLE)
    assert (early.stable, early.unsteady) == (whole.stable, whole.unsteady) == (False, ("a",))
    assert (early.drift_mm, early.jitter_mm) == (None, None)
    assert whole.drift_mm is not None
    assert early.settle_move_max_mm == pytest.approx(whole.settle_move_max_mm, rel=0.01)
    same, other = settle([stays], TABLE, PhysicsOptions(stops_early=True)), settle([stays], TABLE)
    assert (same.stable, same.drift_mm, same.jitter_mm) == (True, other.drift_mm, other.jitter_mm)


@pytest.mark.parametrize("speed", [PhysicsOptions().sleep_speed, 1e-3])
def test_what_sleeps_is_judged_as_what_is_looked_at(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    num_awake = []

    def run(model: Any, data: Any, *more: Any, **named: Any) -> FloatArray:
        found = _simulate(model, data, *more, **named)
        num_awake.append(data.ntree_awake)
        return found

    monkeypatch.setattr("stable_data.simulation.settling._simulate", run)
    bodies = [block(str(k), (0.5, 0.3, 0.05 + 0.1 * k)) for k in range(3)]
    awake, asleep = (settle(bodies, TABLE, PhysicsOptions(sleep_speed=s, rest_move=0.0)) for s in (0.0, speed))
    assert num_awake == [3, 3, 3, 0]
    assert awake.stable
    assert asleep.stable
    assert asleep.moves == pytest.approx(awake.moves, abs=1e-6)
    assert asleep.drift_mm == pytest.approx(awake.drift_mm, abs=0.1)


def counted_steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of steps of all calls of the engine from now on."""
    steps, step = [], mujoco.mj_step

    def count(model: Any, data: Any, nstep: int = 1) -> None:
        steps.append(nstep)
        step(model, data, nstep=nstep)

    monkeypatch.setattr(mujoco, "mj_step", count)
    return steps


def test_nothing_is_simulated_once_everything_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The result is that of the whole watch, bit for bit."""
    bodies = [block(str(k), (0.5, 0.3, 0.05 + 0.1 * k)) for k in range(3)]
    model = compile_bodies(bodies, TABLE)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=500)
    enable_sleeping(model, PhysicsOptions())
    mujoco.mj_step(model, data, nstep=1500)
    mujoco.mj_kinematics(model, data)
    steps = counted_steps(monkeypatch)
    result = settle(bodies, TABLE, PhysicsOptions(rest_move=0.0))
    assert 500 < sum(steps) < 1000
    np.testing.assert_array_equal(result.positions, data.xpos[1:])
    np.testing.assert_array_equal(result.quats_xyzw, data.xquat[1:][:, [1, 2, 3, 0]])


def test_a_simulation_ends_when_nothing_can_move_far_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    bodies = [block(str(k), (0.5, 0.3, 0.05 + 0.1 * k)) for k in range(3)]
    steps = counted_steps(monkeypatch)
    early, whole = (settle(bodies, TABLE, PhysicsOptions(sleep_speed=0.0, rest_move=m)) for m in (1e-3, 0.0))
    assert 2000 + 2 * 200 < sum(steps) < 2000 + 600
    assert early.stable is whole.stable is True
    assert early.positions == pytest.approx(whole.positions, abs=1e-3)
    assert early.drift_mm == pytest.approx(whole.drift_mm, abs=1)


def test_what_is_near_a_limit_is_watched_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = counted_steps(monkeypatch)
    fallen = settle([block("a", (0.5, 0.3, 0.05 + 0.0088))], TABLE, PhysicsOptions(sleep_speed=0.0))
    assert fallen.stable is True
    assert sum(steps) == 2000


def ends_after(path: Iterable[FloatArray], *, so_far: FloatArray | None = None) -> int | None:
    """The number of samples after which a watch of 3 s ends; None: it does not."""
    calm = Calm.of_settling(AT_REST, PhysicsOptions(), 3.0) if so_far is None else Calm.of_watch(so_far, PhysicsOptions())
    return next((number for number, pose in enumerate(path, 1) if calm.has_come(pose)), None)


def at_x(distances: npt.ArrayLike) -> FloatArray:
    """A path along x, (T, 1, 7), from distances (T,), metres."""
    path = np.repeat(AT_REST[None], len(np.asarray(distances)), 0)
    path[:, 0, 0] += distances
    return path


def test_a_simulation_does_not_end_while_something_could_move_far() -> None:
    still = np.zeros(150)
    assert ends_after(at_x(still)) == 26  # a tenth of a second, and two windows of a fifth
    assert ends_after(at_x(1e-5 * (-1.0) ** np.arange(150))) == 26  # contacts that jitter
    creep = 0.02 * 1e-3 * np.arange(150)  # 1 mm a second
    assert ends_after(at_x(creep)) == 100  # then less than 1 mm is left
    assert ends_after(at_x(1e-7 * 1.1 ** np.arange(100))) is None  # it may begin to fall
    moved, turned = np.stack([AT_REST, AT_REST]), np.stack([AT_REST, AT_REST])
    moved[1, 0, 0] += 0.51 * MOVE_LIMIT
    turned[1, 0, 3:] = (0.0, 0.0, np.sin(np.radians(2.6) / 2), np.cos(np.radians(2.6) / 2))
    assert ends_after(at_x(still), so_far=moved) is None
    assert ends_after(at_x(still), so_far=turned) is None
    assert ends_after(at_x(still), so_far=AT_REST[None]) == 21  # a watch has no impact before it
    never = Calm.of_settling(AT_REST, PhysicsOptions(rest_move=0.0), 3.0)
    assert not any(never.has_come(AT_REST) for _ in range(150))


@pytest.mark.parametrize("offset", [1e-3, 1e-4, 1e-6, 1e-9])
def test_what_only_just_begins_to_fall_does_not_fall_asleep(offset: float) -> None:
    """A pole on its edge, almost in balance: it takes its time."""
    angle = np.arctan(0.02 / 0.4) + offset
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    pole = box(0.02, 0.02, 0.4)
    vertices = pole.vertices @ turn.T
    result = settle([RigidBody("pole", (Mesh(vertices, pole.faces),), 0.5, (0.5, 0.3, -float(vertices[:, 2].min())))], TABLE)
    assert result.stable is False
    assert result.settle_turn_max_deg == pytest.approx(87, abs=5)


def test_falling_box_moved_by_its_height() -> None:
    result = settle([block("a", (0.5, 0.3, 0.10))], TABLE)
    assert result.stable is False
    assert "a moved" in result.reason
    assert result.settle_move_max_mm == pytest.approx(50, abs=1)
    assert result.drift_mm is not None
    assert result.drift_mm < 1


def test_thing_beyond_the_edge_falls() -> None:
    result = settle([block("a", (1.2, 0.3, 0.05))], TABLE, SHORT)
    assert result.stable is False
    assert result.positions[0, 2] < -0.1


def test_tower_that_overhangs_turns() -> None:
    bodies = [block("low", (0.5, 0.3, 0.05)), block("high", (0.57, 0.3, 0.15))]
    result = settle(bodies, TABLE)
    assert result.stable is False
    assert result.turns[1] > 5
    assert result.moves[0] < 0.01


def test_fixed_body_carries_and_stays() -> None:
    bodies = [block("shelf", (0.5, 0.3, 0.5), movable=False), block("a", (0.5, 0.3, 0.6))]
    result = settle(bodies, TABLE, SHORT)
    assert result.stable is True
    np.testing.assert_array_equal(result.positions[0], [0.5, 0.3, 0.5])


def test_hollow_of_convex_parts_holds_a_thing() -> None:
    walls = (box(0.2, 0.2, 0.01), *(Mesh(box(*s).vertices + c, box(*s).faces) for s, c in _walls()))
    bodies = [RigidBody("tray", walls, 1.0, (0.5, 0.3, 0.005)), block("a", (0.5, 0.3, 0.031), size=(0.04, 0.04, 0.04))]
    result = settle(bodies, TABLE, SHORT)
    assert result.positions[1, 2] == pytest.approx(0.03, abs=5e-4)


def _walls() -> list[tuple[Vec3, Vec3]]:
    return [
        ((0.01, 0.2, 0.06), (0.095, 0, 0.035)),
        ((0.01, 0.2, 0.06), (-0.095, 0, 0.035)),
        ((0.2, 0.01, 0.06), (0, 0.095, 0.035)),
        ((0.2, 0.01, 0.06), (0, -0.095, 0.035)),
    ]


def test_same_input_gives_the_same_bits() -> None:
    bodies = [block("a", (0.5, 0.3, 0.06), yaw=0.3), block("b", (0.52, 0.32, 0.17), yaw=1.0)]
    first, second = (settle(bodies, TABLE, SHORT) for _ in range(2))
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.quats_xyzw, second.quats_xyzw)


def is_unknown(result: SettleResult) -> bool:
    return result.stable is None and result.engine_penetration_mm is None and bool(result.reason)


def test_body_without_a_solid_part_is_unknown_not_stable() -> None:
    flat = Mesh(box(0.1, 0.1, 0.1).vertices * (1, 1, 0), box(0.1, 0.1, 0.1).faces)
    assert is_unknown(settle([RigidBody("sheet", (flat,), 0.1, (0.5, 0.3, 0.1))], TABLE))
    assert is_unknown(settle([RigidBody("nothing", (), 0.1, (0.5, 0.3, 0.1))], TABLE))


def test_body_that_is_not_finite_is_unknown() -> None:
    nan = Mesh(box(0.1, 0.1, 0.1).vertices * np.nan, box(0.1, 0.1, 0.1).faces)
    assert is_unknown(settle([RigidBody("nan", (nan,), 0.1, (0.5, 0.3, 0.1))], TABLE))


def test_pose_that_is_not_finite_is_unknown() -> None:
    assert is_unknown(settle([block("a", (float("nan"), 0.3, 0.05))], TABLE))


def test_simulation_that_blows_up_fails_without_a_log_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = settle([block("a", (1e300, 0.3, 0.05))], TABLE, SHORT)
    assert result.stable is False
    assert "diverged" in result.reason
    assert not list(tmp_path.iterdir())


def test_what_had_gone_too_far_before_is_to_blame_where_a_simulation_blows_up() -> None:
    """One falls past the largest number that the engine takes; that another would have stayed is not known."""
    falls, stays = block("falls", (9.0, 9.0, 0.05 - 1e10)), block("stays", (0.5, 0.3, 0.05))
    result = settle([stays, falls], TABLE)
    assert result.stable is False
    assert result.unsteady == ("falls",)
    assert result.num_restless == 2
    assert re.search(r"diverged after falls moved \d", result.reason)
    assert np.isnan([result.moves[0], result.turns[0]]).all()
    assert result.settle_move_max_mm is None
    np.testing.assert_array_equal(result.positions[0], stays.position)


def test_anything_may_be_to_blame_where_nothing_had_moved_before() -> None:
    result = settle([block("stays", (0.5, 0.3, 0.05)), block("far", (9.0, 9.0, 1e300))], TABLE, SHORT)
    assert result.unsteady == ("stays", "far")


def test_what_is_not_known_to_stay_is_restless() -> None:
    falls, stays = block("a", (0.5, 0.3, 0.15)), block("b", (0.2, 0.3, 0.05))
    assert settle([falls, stays], TABLE, SHORT).num_restless == 1
    assert settle([stays], TABLE, SHORT).num_restless == 0
    assert settle([stays, RigidBody("nothing", (), 0.1, (0.5, 0.3, 0.1))], TABLE, SHORT).num_restless == 2


def test_body_without_mass_is_unknown() -> None:
    assert is_unknown(settle([RigidBody("a", (box(0.1, 0.1, 0.1),), 0.0, (0.5, 0.3, 0.1))], TABLE))


def on_slope(slope: float, friction: Vec3 | None, lean: float = 0.0) -> list[RigidBody]:
    """A fixed plate that descends along x with a slope, and a block on it whose centre of mass is moved down the slope, metres."""
    turn = Rotation.from_euler("y", np.arctan(slope)).as_matrix()
    plate, cube = box(0.6, 0.3, 0.02), box(0.06, 0.06, 0.1)
    middle = np.array([0.5, 0.3, 0.3])
    x, y, z = (middle + turn @ (0.0, 0.0, 0.06)).tolist()
    tensor = turn @ np.diag([1e-3, 1e-3, 6e-4]) @ turn.T
    inertial = Inertial(turn @ (lean, 0.0, 0.0), tensor) if lean else None
    return [
        RigidBody("plate", (Mesh(plate.vertices @ turn.T, plate.faces),), 1.0, (0.5, 0.3, 0.3), movable=False),
        RigidBody("block", (Mesh(cube.vertices @ turn.T, cube.faces),), 0.5, (x, y, z), inertial=inertial, friction=friction),
    ]


@pytest.mark.parametrize(("friction", "stays"), [(0.1, False), (0.3, False), (0.45, True), (0.8, True), (None, True)])
def test_a_block_slides_where_the_slope_is_steeper_than_its_friction(friction: float | None, stays: bool) -> None:
    """Although the plate has the friction of all others, 0.8."""
    own = None if friction is None else (friction, 0.005, 0.0001)
    result = settle(on_slope(0.364, own), TABLE)
    assert (result.stable, result.unsteady) == (stays, () if stays else ("block",))


@pytest.mark.parametrize("lean", [-0.01, 0.0, 0.01])
def test_a_block_tips_at_the_slope_that_its_centre_of_mass_gives(lean: float) -> None:
    """It tips over the edge of its foot, half a side down the slope, once its centre, 5 cm above, is beyond it."""
    critical = (0.03 - lean) / 0.05
    rough = (1.5, 0.005, 0.0001)
    assert settle(on_slope(0.93 * critical, rough, lean), TABLE).stable
    tipped = settle(on_slope(1.07 * critical, rough, lean), TABLE)
    assert tipped.turns[1] > 5


def test_of_two_frictions_the_larger_counts() -> None:
    low, high = (0.1, 0.005, 0.0001), (0.6, 0.005, 0.0001)
    plate, cube = on_slope(0.364, low)
    assert settle([replace(plate, friction=high), cube], TABLE).stable is True
    assert settle([replace(plate, friction=low), cube], TABLE).stable is False


@pytest.mark.parametrize("friction", [(np.nan, 0.0, 0.0), (-0.1, 0.0, 0.0), (0.5, np.inf, 0.0)])
def test_a_friction_that_no_contact_has_is_unknown(friction: Vec3) -> None:
    result = settle([replace(block("a", (0.5, 0.3, 0.05)), friction=friction)], TABLE, SHORT)
    assert is_unknown(result)
    assert "body a: friction is" in result.reason


@pytest.mark.parametrize(
    "inertial",
    [
        Inertial(np.zeros(3), np.diag([1e-3, 1e-3, 3e-3])),
        Inertial(np.zeros(3), np.diag([1e-3, 1e-3, -1e-3])),
        Inertial(np.zeros(3), np.full((3, 3), np.nan)),
        Inertial(np.array([0.0, np.inf, 0.0]), np.diag([1e-3, 1e-3, 1e-3])),
    ],
    ids=["unbalanced", "negative", "nan", "inf"],
)
def test_an_inertial_that_no_body_has_is_unknown(inertial: Inertial) -> None:
    assert is_unknown(settle([replace(block("a", (0.5, 0.3, 0.05)), inertial=inertial)], TABLE, SHORT))


@pytest.mark.parametrize("kept", [0, 64 * 2**20])
def test_a_model_of_kept_hulls_is_the_same(kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.simulation.settling._MAX_CACHED_BYTES", kept)
    pole, brick = box(0.02, 0.02, 0.4), box(0.2, 0.1, 0.05)
    bodies = [
        RigidBody("both", (pole, Mesh(np.add(brick.vertices, (0.05, 0.0, 0.0)), brick.faces)), 0.4, (0.3, 0.3, 0.2), 0.4),
        RigidBody("held", (brick,), 0.2, (0.7, 0.3, 0.025), movable=False),
        RigidBody("again", (pole,), 0.1, (0.5, 0.3, 0.2)),
    ]
    plain = compile_spec(spec_of(bodies, TABLE))
    for _ in range(2):
        model = compile_bodies(bodies, TABLE)
        arrays = [name for name in dir(plain) if not name.startswith("_") and isinstance(getattr(plain, name), np.ndarray)]
        assert {name for name in arrays if not np.array_equal(getattr(model, name), getattr(plain, name))} <= {"mesh_pathadr"}


def test_flat_part_beside_a_solid_one_is_left_out() -> None:
    flat = Mesh(box(0.1, 0.1, 0.1).vertices * (1, 1, 0), box(0.1, 0.1, 0.1).faces)
    model = compile_bodies([RigidBody("a", (flat, box(0.1, 0.1, 0.1)), 0.5, (0.5, 0.3, 0.05))], TABLE)
    assert model.ngeom == 2  # the table and the solid part
    assert model.body_mass[1] == pytest.approx(0.5)


def test_empty_table_is_stable() -> None:
    result = settle([], TABLE)
    assert result.stable is True
    assert result.positions.shape == (0, 3)


def test_hull_volume_of_a_box() -> None:
    assert hull_volume(box(0.1, 0.2, 0.3)) == pytest.approx(0.006)
