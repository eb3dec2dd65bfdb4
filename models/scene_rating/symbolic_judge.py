"""The judge by rules: the five criteria on the geometry, the task and the categories of a scene, without pictures.

The same scene has the same rating of one version on every machine. It is no GPT-score, and nothing is claimed about what people think
of a scene.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from importlib.resources import files

from models.instruction_reader.reader import reader_fingerprint
from models.scene_rating.judge import SYMBOLIC
from models.scene_rating.layout_rules import LayoutRules
from models.scene_rating.placement_rules import PlacementRules
from models.scene_rating.rating_case import AuditedScene, RatingCase
from models.scene_rating.size_rules import SizeRules
from models.scene_rating.task_reader import TaskReader
from models.scene_rating.task_rules import TaskRules, further_categories, interpreter_for
from models.scene_rating.usual_layouts import DEFAULT, UsualLayouts
from models.scene_rating.visibility_rules import VisibilityRules
from models.semantic_reasoner.engines.registry import EMBEDDED
from models.semantic_reasoner.language.category_statistics import FILE
from stable_data.content_id import content_id
from stable_data.rating.criteria import CONSISTENCY, CRITERIA, LAYOUT, PLACEMENT, SIZES, VISIBILITY
from stable_data.rating.rating import CriterionScore, Rating

RULES_VERSION = 3
"""Raised whenever a rule or a constant of a rule changes, so that ratings of different rules are told apart."""

Rules = Callable[[AuditedScene], CriterionScore]
"""The rules of one criterion."""


def rules_version(categories: Iterable[str] = ()) -> str:
    """Returns a hash of the rules and of what they rest on beside the scenes.

    That is the instruction reader, the text encoder, the statistics of categories, usual sizes and usual layouts.

    Args:
        categories: Categories of the scenes, of which those count that the embedded world does not have.

    Raises:
        ConfigError: One of them cannot be read.
    """
    further = further_categories(categories)  # refuses missing statistics
    return content_id(_foundations(), further)


@lru_cache(maxsize=1)
def _foundations() -> str:
    from models.text_encoder import load_default

    sizes = files("stable_data.importers.conversion").joinpath("sizes.csv").read_bytes()
    data = (sizes, DEFAULT.read_bytes(), (EMBEDDED / FILE).read_bytes())
    hashes = [hashlib.sha256(content).hexdigest() for content in data]
    return content_id(SYMBOLIC, RULES_VERSION, reader_fingerprint(), load_default().fingerprint, hashes)


class SymbolicJudge:
    """Rates scenes by rules; pictures are not looked at.

    Args:
        categories: Categories of the scenes beside those of the embedded world, so that instructions with them are understood.

    Raises:
        ConfigError: The statistics or the instruction reader cannot be loaded.
    """

    def __init__(self, categories: Iterable[str] = ()) -> None:
        named = frozenset(categories)
        self.name, self.version = SYMBOLIC, rules_version(named)
        reader = TaskReader(interpreter_for(named))
        self._rules: Mapping[str, Rules] = {
            CONSISTENCY.key: TaskRules(reader),
            SIZES.key: SizeRules(),
            PLACEMENT.key: PlacementRules(),
            LAYOUT.key: LayoutRules(UsualLayouts.load(), reader),
            VISIBILITY.key: VisibilityRules(reader),
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
