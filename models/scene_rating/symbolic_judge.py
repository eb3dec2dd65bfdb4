"""The judge by rules: the five criteria on the geometry, the task and the categories of a scene, without pictures.

The same scene has the same rating on every machine. It is no GPT-score, and nothing is claimed about what people think of a scene.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from importlib.resources import files

from models.instruction_reader.reader import reader_fingerprint
from models.scene_rating.layout_rules import LayoutRules
from models.scene_rating.placement_rules import PlacementRules
from models.scene_rating.rating_case import AuditedScene, RatingCase
from models.scene_rating.size_rules import SizeRules
from models.scene_rating.task_rules import TaskRules, interpreter_for
from models.scene_rating.usual_layouts import DEFAULT, UsualLayouts
from models.scene_rating.visibility_rules import VisibilityRules
from stable_data.content_id import content_id
from stable_data.rating.criteria import CONSISTENCY, CRITERIA, LAYOUT, PLACEMENT, SIZES, VISIBILITY
from stable_data.rating.rating import CriterionScore, Rating

RULES_VERSION = 1
"""Raised whenever a rule or a constant of a rule changes, so that ratings of different rules are told apart."""

NAME = "symbolic"
"""Name of the judge."""

Rules = Callable[[AuditedScene], CriterionScore]
"""The rules of one criterion."""


@lru_cache(maxsize=1)
def rules_version() -> str:
    """Returns a hash of the rules and of what they rest on: the instruction reader, usual sizes and usual layouts."""
    sizes = files("stable_data.importers.conversion").joinpath("sizes.csv").read_bytes()
    data = [hashlib.sha256(content).hexdigest() for content in (sizes, DEFAULT.read_bytes())]
    return content_id(NAME, RULES_VERSION, reader_fingerprint(), data)


class SymbolicJudge:
    """Rates scenes by rules; pictures are not looked at.

    Args:
        categories: Categories of the scenes beside those of the embedded world, so that instructions with them are understood.

    Raises:
        ConfigError: The statistics or the instruction reader cannot be loaded.
    """

    def __init__(self, categories: Iterable[str] = ()) -> None:
        self.name, self.version = NAME, rules_version()
        self._rules: Mapping[str, Rules] = {
            CONSISTENCY.key: TaskRules(interpreter_for(categories)),
            SIZES.key: SizeRules(),
            PLACEMENT.key: PlacementRules(),
            LAYOUT.key: LayoutRules(UsualLayouts.load()),
            VISIBILITY.key: VisibilityRules(),
        }

    def rate(self, cases: Sequence[RatingCase]) -> list[Rating]:
        """Returns one rating for each scene, in their order."""
        return [self._rated(case) for case in cases]

    def score(self, key: str, audited: AuditedScene) -> CriterionScore:
        """Returns the score of a scene by one criterion."""
        return self._rules[key](audited)

    def _rated(self, case: RatingCase) -> Rating:
        if case.audited is None:
            reason = f"{case.scene_id}: has no geometry, which rules need"
            return Rating(case.scene_id, self.name, self.version, {}, case.clean, "geometry_missing", reason)
        scores = {criterion.key: self.score(criterion.key, case.audited) for criterion in CRITERIA}
        open_ = [f"{c.name}: {scores[c.key].rationale}" for c in CRITERIA if scores[c.key].score is None]
        code, reason = ("criterion_unknown", f"{case.scene_id}: unknown is {'; '.join(open_)}") if open_ else ("", "")
        return Rating(case.scene_id, self.name, self.version, scores, case.clean, code, reason)
