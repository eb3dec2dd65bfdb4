"""Figures of systems: a failure never looks like a success, and what is unknown is never a number."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.evaluate.collect import figures_row
from pipelines.evaluate.figures import FIGURES, Estimate, Repetition, estimate, estimate_figures
from pipelines.evaluate.published import TABLE_1, TABLE_3B
from stable_data.scores.intervals import wilson_interval

VALUES = st.lists(st.one_of(st.none(), st.floats(0.0, 1.0)), max_size=8)


def row(**values: Any) -> dict[str, Any]:
    """A scene with values of all figures."""
    return {figure.key: 0.5 for figure in FIGURES} | {"made": True} | values


def figures_of(*repetitions: Repetition) -> dict[str, Estimate]:
    """The figures of the only system."""
    return estimate_figures({"one": repetitions})["one"]


@given(st.lists(VALUES, min_size=1, max_size=4))
def test_every_value_is_known_or_unknown_and_the_mean_is_between_the_bounds(samples: list[list[float | None]]) -> None:
    found = estimate(samples)
    assert found.known + found.unknown == sum(map(len, samples))
    assert (found.value is None) == (found.known == 0)
    if found.value is not None:
        assert -1e-12 <= found.value <= 1.0 + 1e-12
    if found.low is not None and found.high is not None and found.value is not None:
        assert found.low <= found.value <= found.high


def test_no_known_value_is_unknown_and_not_zero() -> None:
    assert estimate([[None, None]]).text(1) == "unknown"
    assert estimate([[]]).value is None
    assert estimate([]).value is None


def test_repetitions_are_weighed_equally_and_their_spread_is_the_interval() -> None:
    found = estimate([[1.0, 1.0, 1.0], [0.0]], 100.0)
    assert found.value == 50.0
    assert found.high is not None
    assert found.high - 50.0 == pytest.approx(12.706 * 50, rel=1e-3)
    assert estimate([[1.0], []]).low is None  # one repetition has no spread


def test_the_interval_of_one_repetition_is_over_its_scenes() -> None:
    assert estimate([[0.0, 1.0, 0.0, 1.0]]).text(2) == "0.50 [-0.42, 1.42]"
    assert estimate([[1.0]]).text(1) == "1.0"
    assert estimate([[0.0, 0.0, 0.0]]).text(1) == "0.0"  # equal values do not show how they spread


def test_verdicts_have_the_interval_of_a_rate_also_if_all_are_the_same() -> None:
    found = estimate([[True] * 6, [True] * 6], 100.0, are_verdicts=True)
    assert (found.value, found.high) == (100.0, 100.0)
    assert found.low == pytest.approx(100 * wilson_interval(12, 12)[0])


def test_intervals_end_at_what_is_possible() -> None:
    found = figures_of(Repetition(("a", "b"), {"a": row(oc=0.0), "b": row(oc=0.1)}, {}))["oc"]
    assert (found.value, found.low) == (5.0, 0.0)
    assert found.high is not None
    assert 60.0 < found.high < 100.0


def test_a_task_without_a_scene_lowers_alignment_and_does_not_look_clean() -> None:
    rows = {"a": row(awt=1.0, clean=True, ready=True), "b": row(awt=1.0, clean=False, ready=False)}
    found = figures_of(Repetition(("a", "b", "c", "d"), rows, {}))
    assert (found["made"].value, found["ready"].value) == (50.0, 25.0)
    assert (found["awt"].value, found["awt"].known) == (50.0, 4)
    assert (found["clean"].value, found["clean"].known) == (50.0, 2)


def test_a_system_without_any_scene_fails_and_is_not_unknown() -> None:
    found = figures_of(Repetition(("a", "b"), {}, {}))
    assert (found["made"].value, found["awt"].value, found["aws"].value) == (0.0, 0.0, 0.0)
    assert found["oc"].value is None


def test_a_task_that_states_no_relation_is_left_out_for_all_and_one_without_scenes_is_not() -> None:
    tasks = ("states", "silent", "lost")
    first = Repetition(tasks, {"states": row(aws=1.0), "silent": row(aws=None)}, {})
    second = Repetition(tasks, {"silent": row(aws=None)}, {})
    found = estimate_figures({"first": [first], "second": [second]})
    assert (found["first"]["aws"].value, found["first"]["aws"].known) == (50.0, 2)
    assert found["second"]["aws"].value is None  # its only scene was not asked, and zeros alone are no mean


def test_tasks_without_labels_ask_for_nothing_also_of_a_system_without_scenes() -> None:
    tasks = ("labelled", "bare")
    first = Repetition(tasks, {"bare": row(awt=None)}, {}, frozenset({"bare"}))
    second = Repetition(tasks, {}, {}, frozenset({"bare"}))
    found = estimate_figures({"first": [first], "second": [second]})
    assert (found["second"]["awt"].value, found["second"]["awt"].known) == (0.0, 1)
    assert found["second"]["made"].known == 2
    alone = figures_of(Repetition(tasks, {}, {}, frozenset(tasks)))
    assert (alone["awt"].value, alone["aws"].value, alone["made"].value) == (None, None, 0.0)


def test_verdicts_of_the_same_tasks_do_not_make_the_interval_narrow() -> None:
    rows = {"a": row(clean=True), "b": row(clean=False)}
    once, twice = figures_of(Repetition(("a", "b"), rows, {})), figures_of(*[Repetition(("a", "b"), rows, {})] * 2)
    others = figures_of(
        Repetition(("a", "b"), rows, {}), Repetition(("c", "d"), dict(zip("cd", rows.values(), strict=True)), {})
    )
    for key in ("clean", "made"):
        assert (twice[key].value, twice[key].low, twice[key].high) == (once[key].value, once[key].low, once[key].high)
        assert (others[key].low or 0.0) > (once[key].low or 0.0)


def test_criteria_are_means_over_the_scenes_whose_average_is_known() -> None:
    card = {"clean": True, "stable": True}
    whole = figures_row(card, {"cwt": 9.0, "average": 8.0, "quality_pass": True})
    partial = figures_row(card, {"cwt": 2.0, "average": None, "quality_pass": None})
    assert (whole["cwt"], partial["cwt"], partial["average"]) == (9.0, None, None)


def test_an_unknown_verdict_is_counted_apart() -> None:
    found = figures_of(Repetition(("a", "b"), {"a": row(oc=None), "b": row(oc=0.0)}, {}))
    assert (found["oc"].value, found["oc"].unknown, found["oc"].text(1)) == (0.0, 1, "0.0, 1 unknown")


def test_what_nobody_rated_is_unknown_also_where_tasks_have_no_scene() -> None:
    found = figures_of(Repetition(("a", "b"), {"a": row(quality_pass=None)}, {}))
    assert (found["quality_pass"].value, found["quality_pass"].unknown) == (None, 2)


def test_figures_of_sets_are_means_over_repetitions() -> None:
    found = figures_of(*(Repetition(("a",), {"a": row()}, {"kernel": v}) for v in (-0.1, 0.3)))
    assert found["kernel"].value == pytest.approx(0.1)
    assert found["kernel"].low is not None
    assert found["kernel"].low < -1.0  # an unbiased estimate may be negative
    assert figures_of(Repetition(("a",), {"a": row()}, {}))["frechet"].value is None


def test_scenes_of_other_tasks_are_refused_and_do_not_look_like_failures() -> None:
    with pytest.raises(ValueError, match="b is no task"):
        Repetition(("a",), {"b": row()}, {})


def test_a_system_that_was_not_run_has_no_figure() -> None:
    assert all(found.value is None for found in figures_of().values())


def test_published_averages_are_those_of_their_criteria() -> None:
    for published in TABLE_1.values():
        assert math.isclose(sum(published.criteria) / 5, published.average, abs_tol=0.1), published
    assert set(TABLE_3B) == {"one_shot", "stable"}


def test_a_task_that_was_not_answered_is_unknown_and_no_zero() -> None:
    found = figures_of(Repetition(("a", "b"), {"a": row(awt=1.0)}, {}, unanswered=frozenset({"b"})))
    for key in ("made", "awt"):
        assert (found[key].value, found[key].known, found[key].unknown) == (100.0, 1, 1)
