"""What a variant of a scene is: the scene that it varies, and the one axis on which it differs from that."""

from dataclasses import dataclass, field
from enum import StrEnum

from models.semantic_reasoner.staged_layout import LayoutTask
from stable_data.scene import Scene


class Axis(StrEnum):
    """What differs between a scene and its variant; all else is kept."""

    LAYOUT = "layout"
    """Positions and yaws."""

    ASSETS = "assets"
    """Assets, each replaced by another one of its category."""

    TASK = "task"
    """The task info."""

    CLUTTER = "clutter"
    """The objects that neither belong to the task nor carry or rest on one that does."""


@dataclass(frozen=True, slots=True)
class VariantTask(LayoutTask):
    """A variant that is to be made. The instruction is that of the source; empty without one.

    Attributes:
        source: The scene that is varied, with its stages, supports and relations.
        axis: What differs.
        number: Which of the variants of the scene on this axis it is, from 1.
        split: The split of the source; None if it has none.
        duplicate_group: The near-duplicate group of the source; None if it has none.
    """

    source: Scene = field(kw_only=True)
    axis: Axis = field(kw_only=True)
    number: int = field(default=1, kw_only=True)
    split: str | None = field(default=None, kw_only=True)
    duplicate_group: str | None = field(default=None, kw_only=True)

    @property
    def base(self) -> Scene:
        """The source under the name of the variant."""
        return Scene(
            self.scene_id,
            self.source.table,
            self.source.objects,
            self.source.task,
            self.source.relations,
            fixed=self.source.fixed,
            frame=self.source.frame,
        )
