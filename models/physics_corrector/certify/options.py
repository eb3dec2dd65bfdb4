"""Settings and results of `certify`."""

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Literal

from stable_data.errors import ConfigError
from stable_data.metrics.verdicts import TOLERANCE, Audit
from stable_data.scene import Relation, Scene

if TYPE_CHECKING:
    from stable_data.simulation.settling import SettleResult  # MuJoCo takes long to import


class CorrectionStatus(StrEnum):
    """The outcome of a correction."""

    CERTIFIED = "certified"
    """Clean by the exact audit, nothing dropped."""

    DROPPED = "dropped"
    """Clean by the exact audit after background objects were dropped."""

    INFEASIBLE = "infeasible"
    """No clean layout was found without a change that is not allowed."""

    UNCLEAN = "unclean"
    """Not clean, because it was not certified (``polish``)."""

    UNKNOWN = "unknown"
    """A mesh is missing: clean with a box in its place, which proves nothing."""


@dataclass(frozen=True, slots=True)
class DroppedObject:
    """A background object that was dropped.

    Attributes:
        instance: Its instance.
        reason: Why it was dropped.
    """

    instance: str
    reason: str


@dataclass(frozen=True, slots=True)
class CertifyOptions:
    """Settings of `certify`.

    Attributes:
        when_full: What to do if there is not a place for every object: drop background objects, or report the scene infeasible.
        fixed: Instances that must not move; they are obstacles.
        asked: Relations that shall hold. Directions and cells of the table come before all other relations of their subjects;
            the carriers of objects follow from the scene's own relations alone, see ``restore``.
        still: Instances that move as little as a clean layout allows: they are lowered straight down where that is clean, even if
            they would not stay there.
        restore: Whether objects return onto or into the carriers that the scene's relations name.
        clearance: Distance between objects that stand side by side, metres.
        tries: How many times a body may be relocated to restore a directional relation.
        rounds: How many times the exact audit may refuse the layout before it is infeasible.
        depth: Allowed penetration of objects, metres: the audit's tolerance, or less, so that the layout is also clean for
            checks that search fewer directions.
        places: Largest number of places at which an object that moves in MuJoCo is tried; 0: none, and the simulation ends
            with the first motion.
        twice: Whether a scene that loses relations after the flow is also certified without the flow, and the better result
            used. A scene that loses objects always is.
    """

    when_full: Literal["drop", "infeasible"] = "drop"
    fixed: frozenset[str] = frozenset()
    asked: frozenset[Relation] = frozenset()
    still: frozenset[str] = frozenset()
    restore: bool = True
    clearance: float = 5e-4
    tries: int = 24
    rounds: int = 8
    depth: float = TOLERANCE
    places: int = 100
    twice: bool = True

    def __post_init__(self) -> None:
        """Refuses values out of range."""
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
    """A corrected scene with its audit.

    Attributes:
        scene: The scene; None if infeasible.
        status: The outcome.
        reason: Why it is not certified, or why the simulation failed; otherwise empty.
        dropped: The dropped objects.
        audit: The exact audit of ``scene``; None without a scene.
        rest: MuJoCo's verdict on ``scene``; None if there was no simulation.
        num_broken: Broken relations of the original layout, by the rules of `certify`: left of, right of, in front of, behind,
            and carriers. It serves to choose between results; the figures of the report are from `relations_kept`.
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
        """The objects that do not stay in MuJoCo at any place that was tried; None if not known."""
        return None if self.rest is None else self.rest.unsteady
