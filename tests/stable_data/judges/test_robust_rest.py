"""The share of changed repetitions in which a scene rests."""

from dataclasses import replace

import numpy as np
import pytest

from stable_data.geometry.mesh import Mesh
from stable_data.judges import robust_rest
from stable_data.judges.robust_rest import stable_share
from stable_data.simulation.settling import RigidBody, settle
from tests.stable_data.judges.test_judges import TABLE, ball, block, box, on_slope

pytestmark = pytest.mark.sim


def test_a_box_rests_in_every_repetition_and_what_falls_in_none() -> None:
    assert stable_share("a", [block("a", (0.5, 0.3, 0.05))], TABLE, 4) == 1.0
    assert stable_share("a", [block("a", (0.5, 0.3, 0.35))], TABLE, 4) == 0.0


def test_what_hardly_rests_does_so_in_a_part_of_the_repetitions_always_the_same() -> None:
    """On a slope near the critical angle the drawn friction decides."""
    bodies = on_slope(37.0, box(0.06, 0.06, 0.03), 0.015)
    first, second = (stable_share("slope", bodies, TABLE, 8) for _ in range(2))
    assert first == second
    assert first is not None
    assert 0 < first < 1
    assert len({stable_share(name, bodies, TABLE, 8) for name in ("b", "c", "d", "e")}) > 1


def test_a_body_that_no_engine_can_simulate_is_unknown() -> None:
    flat = Mesh(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), np.array([[0, 1, 2]]))
    assert stable_share("a", [RigidBody("a", (flat,), 0.1, (0.5, 0.3, 0.1))], TABLE, 3) is None


def test_fixed_bodies_and_own_properties_are_changed_too(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def record(bodies, table, options, velocities):  # type: ignore[no-untyped-def]
        seen.append((bodies, options, velocities))
        return real(bodies, table, options, velocities)

    real = settle
    monkeypatch.setattr(robust_rest, "settle", record)
    bodies = on_slope(10.0, ball(0.03), 0.03, friction=0.5)
    stable_share("a", [*bodies, replace(block("b", (0.9, 0.5, 0.05)), mass=2.0)], TABLE, 6)
    masses = np.array([[body.mass for body in changed] for changed, _, _ in seen]) / [1.0, 0.2, 2.0]
    frictions = np.array([changed[1].friction[0] / 0.5 for changed, _, _ in seen])
    general = np.array([options.friction[0] / 0.8 for _, options, _ in seen])
    for factors in (masses, frictions, general):
        assert 0.8 <= factors.min() < factors.max() <= 1.2
    pushes = np.stack([velocities for _, _, velocities in seen])
    assert np.abs(pushes[..., :3]).max() <= robust_rest.PUSH
    assert np.abs(pushes[..., 3:]).max() <= robust_rest.SPIN
    assert pushes[..., 2].min() >= 0
    assert {options.timestep for _, options, _ in seen} <= set(robust_rest.TIMESTEPS)
