"""The arithmetic of ratings: averages, the quality-pass, unknowns, and the paper's table."""

from collections.abc import Mapping
from typing import Any

import pytest

from stable_data.rating.criteria import HIGHEST, KEYS, LOWEST, STEP
from stable_data.rating.rating import CriterionScore, Rating, rating_of_row, rating_row, summarise_ratings
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS

PAPER = {
    "GPT-4o": (6.0, 8.0, 8.4, 6.2, 6.9, 7.1),
    "Holodeck-Table": (4.2, 7.0, 7.8, 5.0, 8.5, 6.5),
    "I-Design-Table": (5.0, 8.0, 8.4, 5.4, 7.7, 6.9),
    "MesaTask": (7.8, 9.2, 9.4, 8.6, 9.0, 8.8),
    "TabletopGen": (8.6, 9.3, 9.5, 8.9, 8.7, 9.0),
    "Steerable": (7.5, 9.2, 9.7, 8.7, 8.8, 8.8),
    "Ours": (9.0, 9.4, 9.6, 9.1, 8.9, 9.2),
}
"""Table 1 of the paper: CwT, OSR, PPI, LCR, OV and Avg."""


def rated(scores: Mapping[str, float | None], scene_id: str = "s", clean: bool | None = True, **more: Any) -> Rating:
    found = {key: CriterionScore(score, "because") for key, score in scores.items()}
    is_known = len(found) == 5 and None not in scores.values()
    code = {} if is_known else {"code": "criterion_unknown", "reason": "why"}
    return Rating(scene_id, "scripted", "v", found, clean, **{**code, **more})


def all_of(score: float) -> dict[str, float | None]:
    return dict.fromkeys(KEYS, score)


def scores_with_mean(mean: float, count: int) -> list[float]:
    """Whole and half scores of some scenes with a mean."""
    steps = round(mean * count / STEP)
    low, more = divmod(steps, count)
    return [STEP * (low + (k < more)) for k in range(count)]


@pytest.mark.parametrize("method", PAPER)
def test_the_averages_of_the_papers_table_follow(method: str) -> None:
    """All seven rows follow: each printed average is the mean of its five columns, rounded to one decimal.

    Steerable's mean is 8.78, that of the others has one decimal. Twenty scenes have whole and half scores, as a judge gives them.
    """
    *columns, average = PAPER[method]
    of_scenes = zip(*(scores_with_mean(mean, 20) for mean in columns), strict=True)
    found = summarise_ratings([rated(dict(zip(KEYS, scores, strict=True)), f"s{k}") for k, scores in enumerate(of_scenes)])
    assert [round(found.averages[key], 1) for key in KEYS] == list(columns)
    assert found.average is not None
    assert round(found.average, 1) == average
    assert found.average == pytest.approx(sum(columns) / 5)
    assert (found.num_scenes, found.num_rated, sum(found.num_unknown.values())) == (20, 20, 0)


def test_the_average_of_a_scene_is_the_mean_of_all_five_or_unknown() -> None:
    scores = dict(zip(KEYS, (9.0, 9.5, 9.5, 9.0, 9.0), strict=True))
    assert rated(scores).average == pytest.approx(9.2)
    assert rated({**scores, "ov": None}).average is None
    assert rated({key: scores[key] for key in KEYS[:4]}).average is None


@pytest.mark.parametrize(
    ("score", "clean", "passes"),
    [(7.5, True, True), (7.0, True, False), (7.5, False, False), (9.0, None, None), (None, True, None), (None, None, None)],
)
def test_a_scene_passes_above_seven_if_it_is_clean_and_both_are_known(
    score: float | None, clean: bool | None, passes: bool | None
) -> None:
    assert rated({**all_of(9.0), **dict.fromkeys(KEYS, score)}, clean=clean).quality_pass is passes


def test_unknown_scenes_are_in_no_average_and_are_counted() -> None:
    ratings = [
        rated(all_of(8.0), "a", cost=0.5, prompt_tokens=10, reply_tokens=3),
        rated(all_of(9.0), "b", clean=False),
        rated({**all_of(1.0), "ppi": None}, "c"),
        rated({}, "d", code="picture_missing", reason="no picture", cost=0.25),
    ]
    found = summarise_ratings(ratings)
    assert found.averages == dict.fromkeys(KEYS, 8.5)
    assert (found.average, found.num_rated, found.num_scenes) == (8.5, 2, 4)
    assert found.num_unknown == {"cwt": 1, "osr": 1, "ppi": 2, "lcr": 1, "ov": 1}
    assert (found.num_passed, found.num_judged, found.pass_rate) == (1, 2, 0.5)
    assert found.codes == {"criterion_unknown": 1, "picture_missing": 1}
    assert (found.cost, found.prompt_tokens, found.reply_tokens) == (0.75, 10, 3)


def test_without_a_known_scene_nothing_is_a_number() -> None:
    for ratings in ([], [rated({})]):
        found = summarise_ratings(ratings)
        assert (found.average, found.averages, found.pass_rate) == (None, {}, None)


def test_a_rating_is_a_row_and_a_row_is_a_rating(tmp_path: Any) -> None:
    ratings = [rated(all_of(8.5), "a", tries=2), rated({**all_of(7.0), "ov": None}, "b", clean=None), rated({}, "c")]
    run = RunFolder(str(tmp_path))
    run.write_shard("ratings", "0" * 16, [rating_row(rating) for rating in ratings])
    rows = run.table("ratings").to_pylist()
    assert list(rows[0]) == SCHEMAS["ratings"].names
    assert [rating_of_row(row) for row in rows] == ratings
    assert [row["quality_pass"] for row in rows] == [True, None, None]
    assert (rows[1]["ov"], rows[1]["ov_rationale"], rows[2]["ov_rationale"]) == (None, "because", None)


@pytest.mark.parametrize("score", [LOWEST - 0.5, HIGHEST + 0.5, 0.0, float("nan")])
def test_a_number_that_is_no_score_cannot_be_a_rating(score: float) -> None:
    with pytest.raises(AssertionError):
        CriterionScore(score, "because")


def test_an_unknown_average_needs_a_reason_and_a_known_one_has_none() -> None:
    with pytest.raises(AssertionError):
        Rating("s", "j", "v")
    with pytest.raises(AssertionError):
        rated(all_of(8.0), code="odd", reason="why")
