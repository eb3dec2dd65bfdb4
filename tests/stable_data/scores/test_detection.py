"""Average precision: known curves, the file forms, and what is no answer."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.errors import ConfigError
from stable_data.scores.detection import (
    DetectedBox,
    LabelledBox,
    average_precision,
    overlap,
    read_detections,
    read_labels,
    score_detections,
)
from tests.bounds import soon

UNIT = (0.0, 0.0, 1.0, 1.0)
ELSEWHERE = (5.0, 5.0, 6.0, 6.0)
BOXES = st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(1, 4), st.integers(1, 4)).map(
    lambda v: (float(v[0]), float(v[1]), float(v[0] + v[2]), float(v[1] + v[3]))
)


@given(BOXES, BOXES)
def test_overlap_is_symmetric_between_0_and_1_and_1_for_equal_boxes_alone(
    one: tuple[float, float, float, float], other: tuple[float, float, float, float]
) -> None:
    found = overlap(one, other)
    assert found == overlap(other, one)
    assert 0.0 <= found <= 1.0
    assert (found == 1.0) == (one == other)


def test_overlap_of_known_boxes() -> None:
    assert overlap(UNIT, (0.5, 0.0, 1.5, 1.0)) == pytest.approx(1 / 3)
    assert overlap(UNIT, (1.0, 0.0, 2.0, 1.0)) == overlap((1, 1, 1, 1), (1, 1, 1, 1)) == 0.0


def labels(count: int) -> list[LabelledBox]:
    return [LabelledBox(f"{k}.png", "fork", UNIT) for k in range(count)]


def box(image: int, is_right: bool, score: float = 1.0) -> DetectedBox:
    return DetectedBox(f"{image}.png", "fork", UNIT if is_right else ELSEWHERE, score)


def test_all_right_is_one_and_none_is_zero() -> None:
    assert average_precision(labels(3), [box(k, True) for k in range(3)], 0.5) == 1.0
    assert average_precision(labels(3), [box(k, False) for k in range(3)], 0.5) == average_precision(labels(3), [], 0.5) == 0.0


def test_the_curve_of_scored_boxes() -> None:
    # right, wrong, right of 4 labels: precision 1 up to a recall of 1/4, then 2/3 up to 2/4.
    found = [box(0, True, 0.9), box(1, False, 0.8), box(2, True, 0.7)]
    assert average_precision(labels(4), found, 0.5) == pytest.approx(1 / 4 + 2 / 3 / 4)
    assert average_precision(labels(4), found[::-1], 0.5) == pytest.approx(1 / 4 + 2 / 3 / 4)


def test_the_order_of_boxes_of_equal_score_decides_nothing() -> None:
    found = [box(0, True), box(1, False), box(2, True), box(3, False)]
    assert average_precision(labels(4), found, 0.5) == average_precision(labels(4), found[::-1], 0.5) == pytest.approx(0.25)


def test_a_label_is_found_once() -> None:
    assert average_precision(labels(1), [box(0, True, 0.9), box(0, True, 0.8)], 0.5) == 1.0
    assert average_precision(labels(2), [box(0, True, 0.9), box(0, True, 0.8), box(1, True, 0.7)], 0.5) == pytest.approx(5 / 6)


def test_an_overlap_below_the_bound_is_wrong() -> None:
    near = [DetectedBox("0.png", "fork", (0.0, 0.0, 1.0, 0.6))]
    assert average_precision(labels(1), near, 0.5) == 1.0
    assert average_precision(labels(1), near, 0.75) == 0.0


def test_scores_are_by_category_and_the_running_precision_is_that_of_manipvqa() -> None:
    known = [*labels(2), LabelledBox("0.png", "kettle", UNIT)]
    [fork, kettle] = score_detections(known, [box(0, False), box(1, True)])
    assert (fork.category, fork.labels, fork.detections) == ("fork", 2, 2)
    assert fork.running_precision[0.5] == pytest.approx((0 + 1 / 2) / 2)
    assert (kettle.detections, kettle.precision[0.5], kettle.running_precision[0.5]) == (0, 0.0, 0.0)


def test_boxes_where_nobody_asked_for_the_category_are_left_out() -> None:
    others = [box(7, False), DetectedBox("0.png", "kettle", UNIT)]
    [fork] = score_detections(labels(1), [box(0, True, 0.5), *others])
    assert (fork.detections, fork.precision[0.5]) == (1, 1.0)


def asked(image: str, name: str, answer: str) -> dict[str, Any]:
    words = f"Please provide the bounding box coordinate of the region this sentence describes: handle of a {name}"
    return {"image": image, "conversations": [{"from": "human", "value": words}, {"from": "gpt", "value": answer}]}


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_the_command_scores_both_forms_of_answers(tmp_path: Path) -> None:
    known = write(
        tmp_path / "labels.json", [asked("a", "kettle", "[0.1, 0.2, 0.3, 0.4]"), asked("b", "table knife", "[0, 0, 1, 1]")]
    )
    found = write(
        tmp_path / "boxes.json",
        [
            {"image": "a", "question": known_question("kettle"), "format_answer": [0.1, 0.2, 0.3, 0.4]},
            {"image": "b", "category": "table_knife", "box": [0, 0, 1, 0.6], "score": 0.3},
        ],
    )
    done = CliRunner().invoke(app, ["score-boxes", str(known), str(found), "--json", str(tmp_path / "out.json")])
    assert done.exit_code == 0, done.output
    kettle, knife = json.loads((tmp_path / "out.json").read_text())
    assert (kettle["precision"], knife["precision"]) == ({"0.5": 1.0, "0.75": 1.0}, {"0.5": 1.0, "0.75": 0.0})
    assert CliRunner().invoke(app, ["score-boxes", str(known), str(found), "--category", "fork"]).exit_code == 2


def known_question(name: str) -> str:
    return str(asked("", name, "")["conversations"][0]["value"])


def test_an_answer_that_is_no_box_is_a_miss(tmp_path: Path) -> None:
    said = [{"image": "a", "category": "fork", "box": value} for value in ([], [1, 2, 3], None, "I cannot see one")]
    assert read_detections(write(tmp_path / "boxes.json", said)) == []


@pytest.mark.parametrize(
    "content",
    [
        {"image": "a"},
        ["a"],
        [{"category": "fork", "box": [0, 0, 1, 1]}],
        [{"image": "a", "box": [0, 0, 1, 1]}],
        [{"image": "a", "category": "fork", "box": [1, 0, 0, 1]}],
        [{"image": "a", "category": "fork", "box": 3}],
        [{"image": "a", "category": "fork", "bbox": [0, 0, 1, 1]}],
        [{"image": "a", "category": "fork", "box": [0, 0, 1, 1], "score": "high"}],
        [{"image": "a", "question": "Where is it?", "box": [0, 0, 1, 1]}],
    ],
)
def test_files_of_another_form_are_refused(content: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read_detections(write(tmp_path / "boxes.json", content))
    assert error.value.code == "file_invalid"


def test_labels_of_another_form_are_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text("[")
    contents = [[], [{"image": "a"}], [asked("a", "fork", "[1, 2]")]]
    for path in [
        tmp_path / "missing.json",
        tmp_path / "broken.json",
        *(write(tmp_path / f"{k}.json", c) for k, c in enumerate(contents)),
    ]:
        with pytest.raises(ConfigError):
            read_labels(path)


GOOD = {"image": "a", "category": "fork", "box": [0, 0, 1, 1]}


@pytest.mark.parametrize(
    "content",
    [
        json.dumps([GOOD | {"score": 10**400}]),
        json.dumps([GOOD | {"box": {"a": "\x1b[2J" * 10_000}}]),
        "[" * 100_000 + "]" * 100_000,
        "[" + "{}," * 5_000_000 + "{}]",
        '[{"image": "a", "category": "fork", "box": [' + "9" * 5000 + ", 0, 1, 1]}]",
    ],
)
def test_hostile_boxes_are_one_line_soon(content: str, tmp_path: Path) -> None:
    (tmp_path / "boxes.json").write_text(content)
    with soon(5.0), pytest.raises(ConfigError) as caught:
        read_detections(tmp_path / "boxes.json")
    assert caught.value.code == "file_invalid"
    assert len(str(caught.value)) < 500


def test_a_box_of_huge_numbers_is_no_box(tmp_path: Path) -> None:
    assert read_detections(write(tmp_path / "boxes.json", [GOOD | {"box": [0, 0, 10**400, 1]}])) == []


def test_a_long_question_is_read_to_a_limited_length(tmp_path: Path) -> None:
    item = {"image": "a", "question": "handle of a " * 200_000, "box": [0, 0, 1, 1]}
    with soon(2.0):
        (found,) = read_detections(write(tmp_path / "boxes.json", [item]))
    assert len(found.category) < 1000


def test_hostile_labels_are_one_line_soon(tmp_path: Path) -> None:
    for answer in ("9" * 400 + " 0 1 1", "-" * 10**6, "0" * 10**6):
        with soon(2.0), pytest.raises(ConfigError):
            read_labels(write(tmp_path / "labels.json", [asked("a", "fork", answer)]))


def test_many_categories_are_scored_in_time_that_grows_with_the_boxes() -> None:
    """For each category, all labels and boxes were once looked through."""
    labels = [LabelledBox("a", f"c{k}", UNIT) for k in range(20_000)]
    boxes = [DetectedBox("a", f"c{k}", UNIT) for k in range(20_000)]
    with soon(10.0):
        scores = score_detections(labels, boxes)
    assert {one.precision[0.5] for one in scores} == {1.0}
