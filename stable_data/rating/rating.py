"""A rating of a scene, its average, and the figures of a set of rated scenes.

Unknown is never a number: the average of a scene of which a criterion is unknown is unknown, and such a scene is in no average of a
set; their number stands beside it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from statistics import fmean
from types import MappingProxyType
from typing import Any

from stable_data.rating.criteria import HIGHEST, KEYS, LOWEST
from stable_data.totals import total

PASS_MARK = 7.0
"""A scene passes if its average is above this and it is clean. The quality-pass of PhyScene3D (arXiv 2606.01649), with the same mark,
asks for no collisions alone: what floats or is out of bounds passes there.
"""


@dataclass(frozen=True, slots=True)
class CriterionScore:
    """The score of a scene by one criterion.

    Attributes:
        score: 1 to 10; None if it is unknown.
        rationale: Why, or why it is unknown; one line.
    """

    score: float | None
    rationale: str

    def __post_init__(self) -> None:
        """Refuses a number that is no score: that is a mistake of whoever rates."""
        assert self.score is None or LOWEST <= self.score <= HIGHEST, f"score is {self.score}, expected 1 to 10 or None"


@dataclass(frozen=True, slots=True)
class Rating:
    """A rating of a scene.

    Attributes:
        scene_id: The scene.
        judge: Who rated it: ``symbolic``, or the name of an engine such as ``openai:gpt-4o``.
        version: Hash of the prompt or of the rules; ratings of different versions are not compared.
        scores: Criterion key -> score. A criterion that is not in it is unknown.
        clean: Whether the scene is clean (docs/audit.md); None if that is unknown.
        code: Short reason why the average is unknown; empty if it is known.
        reason: The same in one line.
        tries: How often an engine was asked.
        prompt_tokens: Tokens that it read; None if it did not count them.
        reply_tokens: Tokens that it wrote; None likewise.
        cost: Cost, in the currency of the engine's prices; None if it is not known.
    """

    scene_id: str
    judge: str
    version: str
    scores: Mapping[str, CriterionScore] = field(default_factory=lambda: MappingProxyType({}))
    clean: bool | None = None
    code: str = ""
    reason: str = ""
    tries: int = 0
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    cost: float | None = 0.0

    def __post_init__(self) -> None:
        """Refuses an unknown average without a reason, and a reason for a known one."""
        assert self.scores.keys() <= set(KEYS), f"criteria are {list(self.scores)}, expected some of {KEYS}"
        assert (self.average is None) == bool(self.code and self.reason), f"{self.scene_id}: {self.average} and {self.code!r}"

    def score(self, key: str) -> float | None:
        """The score by a criterion; None if it is unknown."""
        return self.scores[key].score if key in self.scores else None

    @property
    def average(self) -> float | None:
        """The mean of the five scores; None if one of them is unknown."""
        found = [self.score(key) for key in KEYS]
        known = [score for score in found if score is not None]
        return fmean(known) if len(known) == len(KEYS) else None

    @property
    def quality_pass(self) -> bool | None:
        """Whether the average is above :data:`PASS_MARK` and the scene is clean; None if one of the two is unknown."""
        average = self.average
        return None if average is None or self.clean is None else average > PASS_MARK and self.clean


@dataclass(frozen=True, slots=True)
class RatingSummary:
    """The figures of a set of rated scenes: a row of the paper's table.

    Attributes:
        num_scenes: Number of scenes.
        num_rated: Those whose average is known; the averages are theirs.
        averages: Criterion key -> mean score of these; empty without any.
        average: Mean of their averages; None without any.
        num_unknown: Criterion key -> number of scenes for which the criterion is unknown.
        num_passed: Scenes that pass.
        num_judged: Scenes of which it is known whether they pass.
        codes: Why averages are unknown: code -> number of scenes.
        prompt_tokens: Tokens that an engine read; None if those of a rating are not known.
        reply_tokens: Tokens that it wrote; None likewise.
        cost: Cost of all ratings; None likewise.
    """

    num_scenes: int
    num_rated: int
    averages: Mapping[str, float]
    average: float | None
    num_unknown: Mapping[str, int]
    num_passed: int
    num_judged: int
    codes: Mapping[str, int]
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    cost: float | None = 0.0

    @property
    def pass_rate(self) -> float | None:
        """Share of the scenes that pass among those of which it is known; None without any."""
        return self.num_passed / self.num_judged if self.num_judged else None


def summarise_ratings(ratings: Iterable[Rating]) -> RatingSummary:
    """Computes the figures of a set of ratings."""
    every = list(ratings)
    rated = [(rating, average) for rating in every if (average := rating.average) is not None]
    passes = [rating.quality_pass for rating in every]
    codes: dict[str, int] = {}
    for rating in every:
        if rating.code:
            codes[rating.code] = codes.get(rating.code, 0) + 1
    return RatingSummary(
        num_scenes=len(every),
        num_rated=len(rated),
        averages={key: fmean(_known(rating, key) for rating, _ in rated) for key in KEYS} if rated else {},
        average=fmean(average for _, average in rated) if rated else None,
        num_unknown={key: sum(rating.score(key) is None for rating in every) for key in KEYS},
        num_passed=passes.count(True),
        num_judged=len(passes) - passes.count(None),
        codes=codes,
        prompt_tokens=total(rating.prompt_tokens for rating in every),
        reply_tokens=total(rating.reply_tokens for rating in every),
        cost=total(rating.cost for rating in every),
    )


def _known(rating: Rating, key: str) -> float:
    score = rating.score(key)
    assert score is not None
    return score


def rating_row(rating: Rating) -> dict[str, Any]:
    """Returns a rating as a row of the table ``ratings``."""
    scores = {key: rating.score(key) for key in KEYS}
    rationales = {f"{key}_rationale": rating.scores[key].rationale if key in rating.scores else None for key in KEYS}
    return {
        "scene_id": rating.scene_id,
        "judge": rating.judge,
        "judge_version": rating.version,
        **scores,
        "average": rating.average,
        "clean": rating.clean,
        "quality_pass": rating.quality_pass,
        **rationales,
        "code": rating.code,
        "reason": rating.reason,
        "tries": rating.tries,
        "prompt_tokens": rating.prompt_tokens,
        "reply_tokens": rating.reply_tokens,
        "cost": rating.cost,
    }


def rating_of_row(row: Mapping[str, Any]) -> Rating:
    """Returns the rating of a row of the table ``ratings``."""
    scores = {
        key: CriterionScore(row[key], row[f"{key}_rationale"] or "")
        for key in KEYS
        if row[key] is not None or row[f"{key}_rationale"] is not None
    }
    kept = ("scene_id", "judge", "clean", "code", "reason", "tries", "prompt_tokens", "reply_tokens", "cost")
    return Rating(version=row["judge_version"], scores=scores, **{name: row[name] for name in kept})
