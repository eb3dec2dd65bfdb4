"""The limits by which simulations in MuJoCo decide what stays, what leans and what has fallen: one table for the folder."""

from dataclasses import dataclass

from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """How far an object may move from where a simulation starts it.

    Attributes:
        move: Metres.
        turn: Degrees.
    """

    move: float
    turn: float


STAYS = MotionLimits(MOVE_LIMIT, TURN_LIMIT)
"""An object within these stays at rest: the limits of the verdict of stability (``stable_data.simulation.settling``)."""

# The limits below differ, and a single one would change the scenes that are generated. All share the distance, at which an
# object has left its place. The angles differ because the simulations start differently. Tuned on: not recorded.
DROPPED_ON_OBJECT = MotionLimits(0.05, 5.0)
"""An object that is dropped flat onto another one: what turns more tips over an edge."""
DROPPED_IN_CONTAINER = MotionLimits(0.05, 45.0)
"""An object that is dropped into a container: it may lean against the wall there."""
LEANS = MotionLimits(0.05, 60.0)
"""An object that a certified scene did not hold: within these it leans on something, and keeps the tilt at which it ended."""

VERDICT_SECONDS = 4.0
"""Simulated time after which an object counts as staying, seconds: as long as the verdict of stability lasts."""
LOOK_SECONDS = 1.5
"""Simulated time after which one sees where an object falls to, seconds."""
