"""What `certify` is asked for and what it answers."""

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Literal

from stable_data.errors import ConfigError
from stable_data.metrics.audit import Audit
from stable_data.metrics.collision import TOLERANCE
from stable_data.scene import Scene

if TYPE_CHECKING:
    from stable_data.simulation.settling import SettleResult  # the engine takes long to import


class CorrectionStatus(StrEnum):
    """How a correction came out."""

    CERTIFIED = "certified"
    """Clean by the exact audit, nothing dropped."""

    DROPPED = "dropped"
    """Clean by the exact audit after background objects were dropped."""

    INFEASIBLE = "infeasible"
    """No clean layout was found that keeps what must be kept."""

    UNKNOWN = "unknown"
    """A mesh is missing: clean with boxes in its place, which proves nothing."""


@dataclass(frozen=True, slots=True)
class DroppedObject:
    """A background object that was given up.

    Attributes:
        instance: Its name.
        reason: Why.
    """

    instance: str
    reason: str


@dataclass(frozen=True, slots=True)
class CertifyOptions:
    """Settings of `certify`.

    Attributes:
        when_full: What to do where no place is found for everything: drop background objects, or say that it is infeasible.
        fixed: Instances that must not move; they are obstacles.
        restore: Put objects back into or onto what the scene's own relations say, where the layout has lost that.
        clearance: Air between things that stand side by side, metres.
        tries: How many times a body may be put elsewhere to win back a directional relation.
        rounds: How many times the exact check may send the layout back.
        depth: How deep things may be in each other, metres: the audit's tolerance, or less for a layout that is clean for
            coarser judges too, which try fewer ways to part them.
        places: At how many places at most a thing that the physics engine moves, where it is asked, is tried until it stays;
            0: it is left where it moves, and looked at no longer than that takes.
        twice: Whether a layout that begins elsewhere than it came, where the flow put it, and loses relations is certified from
            where it came too, and the better taken; where it loses objects it always is.
    """

    when_full: Literal["drop", "infeasible"] = "drop"
    fixed: frozenset[str] = frozenset()
    restore: bool = True
    clearance: float = 5e-4
    tries: int = 24
    rounds: int = 8
    depth: float = TOLERANCE
    places: int = 100
    twice: bool = True

    def __post_init__(self) -> None:
        """Refuses settings that make no sense."""
        if not 0 <= self.clearance <= 0.1:
            raise ConfigError(f"clearance is {self.clearance}, expected 0 to 0.1 metres", "clearance_invalid")
        if self.when_full not in ("drop", "infeasible"):
            raise ConfigError(f'when_full is {self.when_full!r}, expected "drop" or "infeasible"', "when_full_invalid")
        if not 0 < self.depth <= TOLERANCE:
            raise ConfigError(f"depth is {self.depth}, expected over 0 to {TOLERANCE} metres", "depth_invalid")
        if self.tries < 0 or self.rounds < 1 or self.places < 0:
            found = f"tries is {self.tries}, rounds {self.rounds} and places {self.places}"
            raise ConfigError(f"{found}, expected >= 0, >= 1 and >= 0", "rounds_invalid")


@dataclass(frozen=True, slots=True)
class CertificationResult:
    """A corrected scene with its proof.

    Attributes:
        scene: The scene; None where it is infeasible.
        status: How it came out.
        reason: Why it is not certified, or why the engine could not be asked; else empty.
        dropped: What was given up.
        audit: The exact audit of ``scene``; None where there is none.
        rest: The physics engine's verdict on ``scene``; None where it was not asked or could not be.
        num_broken: Relations of the original layout that no longer hold, as `certify` reads them: left of, right of, in front
            of, behind; and what is no longer carried by what carried it. A figure to choose by; the audit's own are
            `relations_kept`.
    """

    scene: Scene | None
    status: CorrectionStatus
    reason: str = ""
    dropped: tuple[DroppedObject, ...] = ()
    audit: Audit | None = None
    rest: "SettleResult | None" = None
    num_broken: int = 0

    @property
    def unsteady(self) -> tuple[str, ...] | None:
        """What does not stay in the engine, wherever it was tried; None where that is not known."""
        return None if self.rest is None else self.rest.unsteady
