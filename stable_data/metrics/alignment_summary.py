"""Alignment of a set of generated scenes: means and pooled shares."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

from stable_data.metrics.alignment import Alignment
from stable_data.scene import Relation


@dataclass(frozen=True, slots=True)
class RelationFigures:
    """Numbers of relations that hold, over scenes.

    Attributes:
        num_scenes: Scenes that have relations and could be judged.
        num_unknown: Scenes that have relations and could not be judged.
        num_relations: Relations of the scenes that could be judged.
        num_held: Those relations that hold.
        macro: Mean over the judged scenes of the share that holds; None without such scenes.
    """

    num_scenes: int
    num_unknown: int
    num_relations: int
    num_held: int
    macro: float | None

    @property
    def micro(self) -> float | None:
        """Relations that hold over all relations, pooled; None without relations."""
        return self.num_held / self.num_relations if self.num_relations else None


@dataclass(frozen=True, slots=True)
class AlignmentSummary:
    """The figures of a set of scenes. A mean over no scene is None.

    Attributes:
        num_scenes: Number of scenes.
        awt: Mean AwT over the scenes.
        num_complete: Scenes with every required object.
        aws: The entailed relations.
        aws_graph: The full graphs between task objects.
        distractor_rate: Mean over the scenes that have objects.
        num_empty: Scenes without objects.
        num_objects: Mean number of objects.
        num_objects_reference: Mean number of objects of the reference scenes.
        num_stacked: Mean number of objects that stand on another object.
        num_contained: Mean number of objects that are in another object.
    """

    num_scenes: int
    awt: float | None
    num_complete: int
    aws: RelationFigures
    aws_graph: RelationFigures
    distractor_rate: float | None
    num_empty: int
    num_objects: float | None
    num_objects_reference: float | None
    num_stacked: float | None
    num_contained: float | None

    def __str__(self) -> str:
        empty = f", {self.num_empty} of {self.num_scenes} scenes without objects" if self.num_empty else ""
        lines = (
            (
                "required objects present (AwT)",
                f"{_percent(self.awt)}, all of them in {self.num_complete} of {self.num_scenes}",
            ),
            ("entailed relations that hold (AwS)", _relations(self.aws)),
            ("full graph between task objects", _relations(self.aws_graph)),
            ("objects that are not task objects", _percent(self.distractor_rate) + empty),
            (
                "objects per scene, in the reference",
                f"{_two_digits(self.num_objects)}, {_two_digits(self.num_objects_reference)}",
            ),
            (
                "on another object, in another object",
                f"{_two_digits(self.num_stacked)}, {_two_digits(self.num_contained)} a scene",
            ),
        )
        return "\n".join(f"{label:<44} {figures}" for label, figures in lines)


def summarise_alignment(alignments: Iterable[Alignment]) -> AlignmentSummary:
    """Summarises alignments, one for each scene. A request without a scene is included, aligned as a scene without objects."""
    found = list(alignments)
    counts = (a.reference.num_objects for a in found)
    return AlignmentSummary(
        num_scenes=len(found),
        awt=_mean_of(a.awt for a in found),
        num_complete=sum(not a.missing for a in found),
        aws=_figures(found, lambda a: (a.broken, a.reference.entailed)),
        aws_graph=_figures(found, lambda a: (a.graph_broken, a.reference.graph or ())),
        distractor_rate=_mean_of(a.distractor_rate for a in found),
        num_empty=sum(not a.num_objects for a in found),
        num_objects=_mean_of(a.num_objects for a in found),
        num_objects_reference=_mean_of(counts),
        num_stacked=_mean_of(a.num_stacked for a in found),
        num_contained=_mean_of(a.num_contained for a in found),
    )


def _figures(
    alignments: Sequence[Alignment], of: Callable[[Alignment], tuple[tuple[Relation, ...] | None, tuple[Relation, ...]]]
) -> RelationFigures:
    asked = [(broken, relations) for broken, relations in map(of, alignments) if relations]
    known = [(len(relations) - len(broken), len(relations)) for broken, relations in asked if broken is not None]
    return RelationFigures(
        num_scenes=len(known),
        num_unknown=len(asked) - len(known),
        num_relations=sum(total for _, total in known),
        num_held=sum(held for held, _ in known),
        macro=_mean_of(held / total for held, total in known),
    )


def _mean_of(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def _relations(figures: RelationFigures) -> str:
    unknown = f", {figures.num_unknown} scenes unknown" if figures.num_unknown else ""
    if not figures.num_scenes:
        return f"unknown{unknown}" if unknown else "none asked for"
    pooled = f"{figures.num_held} of {figures.num_relations} ({_percent(figures.micro)})"
    return f"{pooled}, mean over {figures.num_scenes} scenes {_percent(figures.macro)}{unknown}"


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.1f} %"


def _two_digits(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f}"
