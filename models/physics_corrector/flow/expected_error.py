"""How far given layouts are expected to be from where things belong; the flow is told this."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """Errors of poses; None where they are not known.

    Attributes:
        position: Standard deviation along x and along y, metres.
        yaw: Standard deviation, radians.
    """

    position: float | None = None
    yaw: float | None = None


UNKNOWN_ERROR = ExpectedError()

PROPOSAL_ERROR = ExpectedError(0.01, 0.1)
"""Of layouts that a reasoner proposes: what a correction moves and turns them by."""
