"""The limits by which simulations in MuJoCo decide whether an object stays, leans or has fallen: one table for the folder."""

from dataclasses import dataclass

from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """How far an object may move from its start pose in a simulation.

    Attributes:
        move: Distance, metres.
        turn: Rotation, degrees.
    """

    move: float
    turn: float


STAYS = MotionLimits(MOVE_LIMIT, TURN_LIMIT)
"""Within these an object stays at rest: the limits of the verdict on stability (``stable_data.simulation.settling``)."""

# The limits below differ, and a single one would change the generated scenes. The distance, beyond which an object has left its
# place, is the same. The angles differ because the simulations start differently. Tuned on: not recorded.
DROPPED_ON_OBJECT = MotionLimits(0.05, 5.0)
"""For an object that is dropped flat onto another one: with a larger turn it tips over an edge."""
DROPPED_IN_CONTAINER = MotionLimits(0.05, 45.0)
"""For an object that is dropped into a container: it may lean against the wall."""
LEANS = MotionLimits(0.05, 60.0)
"""For an object that moves in a certified scene: within these it leans on another one, and keeps its final tilt."""

VERDICT_SECONDS = 4.0
"""Simulated time after which an object counts as stable, seconds: the same as for the verdict on stability."""
LOOK_SECONDS = 1.5
"""Simulated time after which the direction of a fall is read, seconds."""
