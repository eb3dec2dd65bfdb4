"""Repeats MuJoCo's verdict under small changes: does a scene also rest if frictions, masses or the engine are a little different?"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stable_data.judges.judge import VERDICT_OPTIONS
from stable_data.random_seeds import named_seed
from stable_data.scene import FloatArray, Tabletop
from stable_data.simulation.settling import Inertial, PhysicsOptions, RigidBody, settle

CHANGE = 0.2
"""Frictions and masses are multiplied by a number from 1 - CHANGE to 1 + CHANGE."""

PUSH = 0.02
"""Largest speed of the nudge along each axis, metres a second. An object that rests stops within 0.03 mm by its friction."""

SPIN = 0.2
"""Largest speed of rotation of the nudge about each axis, radians a second."""

TIMESTEPS = (0.001, 0.002, 0.004)
"""Steps of MuJoCo, seconds; each repetition has one of them."""


def stable_share(
    name: str,
    bodies: Sequence[RigidBody],
    table: Tabletop,
    repetitions: int,
    options: PhysicsOptions = VERDICT_OPTIONS,
) -> float | None:
    """Returns the share of repetitions of MuJoCo's verdict that find a scene stable.

    Each repetition draws, evenly: a factor from 0.8 to 1.2 for the friction of contacts of bodies without their own, and one for the
    own friction of each body (all three coefficients); a factor from 0.8 to 1.2 for the mass of each body, with its inertia; a
    linear velocity of up to 20 mm/s along each axis (downward ones are turned upward) and an angular velocity of up to 0.2 rad/s
    about each axis for each body, at the start; and a time step of 1, 2 or 4 ms. All else is as in the verdict.

    Args:
        name: The scene; the draws follow from it and from the number of the repetition alone.
        bodies: The objects.
        table: The table that supports them.
        repetitions: How often; at least 1.
        options: Settings of MuJoCo.

    Returns:
        From 0 to 1. An unknown verdict counts as not stable; None if all are unknown.
    """
    found = []
    for repetition in range(repetitions):
        rng = np.random.default_rng(named_seed("robust_rest", name, repetition))
        changed, velocities, drawn = _drawn(rng, bodies, options)
        found.append(settle(changed, table, drawn, velocities).stable)
    return None if all(stable is None for stable in found) else sum(stable is True for stable in found) / len(found)


def _drawn(
    rng: np.random.Generator, bodies: Sequence[RigidBody], options: PhysicsOptions
) -> tuple[list[RigidBody], FloatArray, PhysicsOptions]:
    low, high = 1 - CHANGE, 1 + CHANGE
    frictions, masses = rng.uniform(low, high, len(bodies)), rng.uniform(low, high, len(bodies))
    velocities = np.concatenate(
        [rng.uniform(-PUSH, PUSH, (len(bodies), 3)), rng.uniform(-SPIN, SPIN, (len(bodies), 3))], axis=1
    )
    velocities[:, 2] = np.abs(velocities[:, 2])
    step = float(rng.choice(TIMESTEPS))
    factor = rng.uniform(low, high)
    slide, twist, roll = (value * factor for value in options.friction)
    drawn = replace(options, timestep=step, friction=(slide, twist, roll), stops_early=True)
    changed = [_changed(body, float(f), float(m)) for body, f, m in zip(bodies, frictions, masses, strict=True)]
    return changed, velocities, drawn


def _changed(body: RigidBody, friction: float, mass: float) -> RigidBody:
    own, inertial = body.friction, body.inertial
    return replace(
        body,
        mass=body.mass * mass,
        friction=None if own is None else (own[0] * friction, own[1] * friction, own[2] * friction),
        inertial=None if inertial is None else Inertial(inertial.center_of_mass, inertial.inertia * mass),
    )
