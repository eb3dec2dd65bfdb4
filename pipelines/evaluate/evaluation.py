"""The result of an evaluation: what each system gave, and what is not known and why."""

from dataclasses import dataclass, field
from typing import Any

from pipelines.evaluate.collect import RunsOfSystem
from pipelines.evaluate.figures import Estimate, Repetition
from pipelines.evaluate.systems import EvaluatedSystem


@dataclass(slots=True)
class SystemResult:
    """A system with what it gave.

    Attributes:
        system: The system.
        row: What it is in the paper's tables.
        repetitions: Its repetitions; none if it was not run.
        notes: What is unknown and why, and what to know about its figures.
        runs: The runs of each repetition.
        has_failed: Whether something that was asked for could not be done.
    """

    system: EvaluatedSystem
    row: str
    repetitions: list[Repetition] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    runs: list[RunsOfSystem] = field(default_factory=list)
    has_failed: bool = False

    def note(self, text: str) -> None:
        """Adds a note once."""
        if text not in self.notes:
            self.notes.append(text)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        out: Its folder.
        num_tasks: Number of tasks of a repetition.
        results: The systems.
        estimates: Label -> key of a figure -> estimate.
        names: What distances of pictures are called, and who rated: keys ``frechet``, ``kernel``, ``judge``.
        notes: What is unknown for all systems.
    """

    out: str
    num_tasks: int
    results: tuple[SystemResult, ...]
    estimates: dict[str, dict[str, Estimate]]
    names: dict[str, str]
    notes: tuple[str, ...]

    @property
    def has_failed(self) -> bool:
        """Whether something that was asked for could not be done."""
        return any(result.has_failed for result in self.results)


def to_json(evaluation: Evaluation) -> dict[str, Any]:
    """Returns an evaluation as JSON values."""
    systems = {}
    for result in evaluation.results:
        label = result.system.label
        figures = {
            key: {"value": e.value, "low": e.low, "high": e.high, "known": e.known, "unknown": e.unknown}
            for key, e in evaluation.estimates[label].items()
        }
        systems[label] = {
            "system": result.system.name,
            "row": result.row,
            "given": result.system.given,
            "repetitions": len(result.repetitions),
            "figures": figures,
            "notes": result.notes,
        }
    return {
        "num_tasks": evaluation.num_tasks,
        "names": evaluation.names,
        "notes": list(evaluation.notes),
        "systems": systems,
    }
