"""The interface of a judge, and what judges other than MuJoCo share: masses, frictions and the loop over samples."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.scene import FloatArray, Tabletop
from stable_data.simulation.settling import (
    Calm,
    Inertial,
    PhysicsOptions,
    RigidBody,
    SettleResult,
    hull_volume,
    judge_motion,
    start_poses,
    unknown_result,
)

VERDICT_OPTIONS = PhysicsOptions()
"""Options of the verdict on stability."""


class Judge(Protocol):
    """A physics engine that judges scenes."""

    def settle(self, bodies: Sequence[RigidBody], table: Tabletop, options: PhysicsOptions = VERDICT_OPTIONS) -> SettleResult:
        """Lets a scene settle under gravity and watches it, as :func:`stable_data.simulation.settling.settle` does.

        Args:
            bodies: The objects.
            table: The table that supports them.
            options: Times, sliding friction and rules of ending early; an engine other than MuJoCo has its own step and contacts.

        Returns:
            Final poses and the verdict; ``stable`` is None, unknown, with the reason if the engine cannot load the scene.

        Raises:
            MeshError: The engine cannot load the scene.
            ModuleNotFoundError: The package of the engine is not installed.
        """
        ...


@dataclass(frozen=True, slots=True)
class FrictionLayer:
    """Colliders of a body for its contacts with one friction, see :func:`friction_layers`.

    Attributes:
        index: Number of the layer in the scene.
        friction: Sliding coefficient of its contacts.
        decides: Whether it touches all colliders of the layer, else only those that decide.
    """

    index: int
    friction: float
    decides: bool


def friction_layers(frictions: Sequence[float | None], default: float) -> list[tuple[FrictionLayer, ...]]:
    """Returns copies of colliders for engines that combine frictions by another rule than :class:`RigidBody` states.

    Each copy has the friction of its layer, so that any mean of two is that friction; colliders of different layers do not touch.
    Each pair of bodies touches in exactly one layer: that of the friction which the rule gives for the pair.

    Args:
        frictions: Own sliding coefficient of each body; None for bodies without, and for the table.
        default: The coefficient of contacts between bodies without their own.

    Returns:
        The copies of each body; one if no body has a friction of its own. Layer 0 is that of bodies without.
    """
    own = sorted({friction for friction in frictions if friction is not None})
    first = FrictionLayer(0, default, decides=True)
    return [
        (() if mine is not None else (first,))
        + tuple(FrictionLayer(k, v, decides=v == mine) for k, v in enumerate(own, 1) if mine is None or v >= mine)
        for mine in frictions
    ]


def solid_parts(body: RigidBody) -> list[Mesh]:
    """Returns the parts of a body that have a volume; the others do not collide."""
    return [part for part in body.parts if hull_volume(part) > 0]


def inertial_of(body: RigidBody) -> Inertial:
    """Returns the distribution of the mass of a body: its own, or that of its homogeneous parts."""
    if body.inertial is not None:
        return body.inertial
    whole = mass_properties(join_meshes(solid_parts(body)), mass=body.mass)
    return Inertial(whole.center_of_mass, whole.inertia)


def judge_samples(
    bodies: Sequence[RigidBody], advance: Callable[[], FloatArray], options: PhysicsOptions, engine: str
) -> SettleResult:
    """Simulates settling and watch sample by sample, and judges how the bodies moved.

    Args:
        bodies: The objects.
        advance: Simulates ``options.sample_seconds`` and gives the poses of the bodies, (N, 7) float64: position in metres,
            quaternion xyzw. Those of bodies that are not movable are not used.
        options: Times, and rules of ending early.
        engine: Name of the engine in reasons.

    Returns:
        The verdict; unknown if poses are not finite.
    """
    fixed, start = [k for k, body in enumerate(bodies) if not body.movable], start_poses(bodies)
    has_failed = False

    def simulate(seconds: float, calm: Calm, is_watch: bool) -> FloatArray:
        nonlocal has_failed
        samples: list[FloatArray] = []
        num_samples = max(1, round(seconds / options.sample_seconds))
        while len(samples) < num_samples:
            pose = advance()
            pose[fixed] = start[fixed]
            samples.append(pose)
            has_failed = not np.isfinite(pose).all()
            if has_failed or calm.has_come(pose):
                break
        return np.stack(samples)

    result = judge_motion(bodies, None, simulate, options)
    return unknown_result(bodies, f"the simulation in {engine} diverged") if has_failed else result


def has_volume_everywhere(part: Mesh, flattest: float) -> bool:
    """Whether all tetrahedra from the middle of a convex part to its faces are higher than this share of its extent."""
    a, b, c = (part.vertices[part.faces[:, k]] - part.vertices.mean(axis=0) for k in range(3))
    normal = np.cross(b - a, c - a)
    sides = np.stack([normal, np.cross(a, b), np.cross(b, c), np.cross(c, a)])
    largest = np.linalg.norm(sides, axis=2).max(axis=0)  # twice the area of the largest side of each
    heights = np.einsum("ij,ij->i", a, normal) / largest
    return bool((heights > flattest * np.ptp(part.vertices, axis=0).max()).all())
