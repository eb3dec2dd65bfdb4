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
    Detections,
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


FORK = LabelledBox("images/a.png", "fork", (0.1, 0.2, 0.3, 0.4), (640, 480))
ASKED = [FORK, LabelledBox("images/b.png", "table_knife", (0.5, 0.5, 0.75, 1.0), (640, 480))]
RIGHT = {"image": "images/a.png", "category": "fork", "box": [0.1, 0.2, 0.3, 0.4]}


def read(folder: Path, said: Any, known: list[LabelledBox] = ASKED) -> Detections:
    return read_detections(write(folder / "boxes.json", said), known)


@pytest.mark.parametrize(
    "changed",
    [
        {"box": [64, 96, 192, 192]},
        {"box": "[0.1, 0.2, 0.3, 0.4]"},
        {"box": "Handle 1 is at [.1, 2e-1, 0.3, 0.4]."},
        {"box": "<box>(64,96),(192,192)</box>"},
        {"image": "a.png"},
        {"image": "C:\\pictures\\a.png"},
        {"category": "Fork "},
    ],
    ids=str,
)
def test_boxes_in_other_words_are_those_of_the_labels(changed: dict[str, Any], tmp_path: Path) -> None:
    found = read(tmp_path, [RIGHT | changed])
    [box] = found.boxes
    assert (box.image, box.category, found.warnings) == ("images/a.png", "fork", ())
    assert box.box == pytest.approx(FORK.box)


@pytest.mark.parametrize("name", ["Table Knife", "TABLE_KNIFE", "table-knife"])
def test_categories_are_compared_without_case_and_by_words(name: str, tmp_path: Path) -> None:
    [box] = read(tmp_path, [{"image": "b.png", "category": name, "box": [0, 0, 1, 1]}]).boxes
    assert box.category == "table_knife"


@pytest.mark.parametrize(
    "item",
    [
        {"image_id": 2, "category_id": 2},
        {"image_id": "b.png", "category": "table knife"},
        {"image_id": "images/b.png", "category_id": 2},
    ],
    ids=str,
)
def test_results_of_coco_have_left_top_width_and_height(item: dict[str, Any], tmp_path: Path) -> None:
    [box] = read(tmp_path, [item | {"bbox": [320, 240, 160, 240], "score": 0.25}]).boxes
    assert (box.image, box.category, box.score) == ("images/b.png", "table_knife", 0.25)
    assert box.box == pytest.approx(ASKED[1].box)


def test_a_number_beyond_those_of_the_labels_is_an_error(tmp_path: Path) -> None:
    """A detector that counts from 0 would else be scored with the boxes of the next pictures."""
    for wrong in ({"image_id": 0}, {"image_id": 3}, {"category_id": 0}, {"category_id": 3}, {"image_id": 10**400}):
        item = {"image_id": 1, "category_id": 1, "bbox": [0, 0, 9, 9]}
        with pytest.raises(ConfigError, match="expected 1 to 2") as error:
            read(tmp_path, [item, item | wrong])
        assert error.value.code == "file_invalid"


def test_pixels_of_pictures_without_a_size_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no width and height") as error:
        read(tmp_path, [RIGHT | {"box": [64, 96, 192, 192]}], [LabelledBox("images/a.png", "fork", FORK.box)])
    assert error.value.code == "file_invalid"


def test_a_share_a_little_beyond_the_picture_is_no_pixel(tmp_path: Path) -> None:
    found = read(tmp_path, [RIGHT | {"box": [0.5, -0.01, 1.02, 0.9]}])
    assert (found.boxes[0].box, found.warnings) == ((0.5, -0.01, 1.02, 0.9), ())


def test_what_is_left_out_is_counted_and_named(tmp_path: Path) -> None:
    others = [
        *({"image": f"{name}.png", "category": "fork", "box": [0, 0, 1, 1]} for name in "wxyzz"),
        RIGHT | {"category": "spoon"},
        RIGHT | {"category": "table_knife"},
        RIGHT | {"box": "I cannot see one"},
        RIGHT | {"box": [0, 0, 1000, 1000]},
    ]
    found = read(tmp_path, [RIGHT, *others])
    assert [box.image for box in found.boxes] == ["images/a.png"] * 2
    picture, category, unasked, answers, beyond = found.warnings
    assert picture == "boxes left out, because no label has their picture: 5 ('w.png', 'x.png', 'y.png', ...)"
    assert category == "boxes left out, because no label has their category: 1 ('spoon')"
    assert unasked.endswith("category in their picture: 1")
    assert answers == "answers that are no box: 1"
    assert beyond.startswith("boxes that reach far beyond their picture: 1;")


@pytest.mark.parametrize(
    "said",
    [
        [],
        [RIGHT | {"image": "c.png"}],
        [RIGHT | {"category": "spoon"}],
        [RIGHT | {"category": "table_knife"}],
        [RIGHT | {"box": "no"}],
    ],
    ids=str,
)
def test_a_file_without_a_box_of_the_labels_has_no_score(said: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read(tmp_path, said)
    assert error.value.code == "boxes_unmatched"


def test_a_name_without_folder_that_is_not_unique_names_no_picture(tmp_path: Path) -> None:
    twice = [*ASKED, LabelledBox("more/a.png", "fork", UNIT, (640, 480))]
    other = {"image": "b.png", "category": "table_knife", "box": [0, 0, 1, 1]}
    for said, known in (([other, RIGHT | {"image": "a.png"}], twice), ([RIGHT, RIGHT | {"image": "other/a.png"}], ASKED)):
        found = read(tmp_path, said, known)
        assert len(found.boxes) == 1
        assert "no label has their picture: 1" in found.warnings[0]


def test_the_command_tells_what_it_leaves_out_and_gives_no_score_for_nothing(tmp_path: Path) -> None:
    known = str(
        write(tmp_path / "labels.json", [asked("images/a.png", "fork", "[0.1, 0.2, 0.3, 0.4]") | {"width": 640, "height": 480}])
    )
    one, none = RIGHT | {"box": [64, 96, 192, 192], "image": "a.png", "category": "Fork"}, RIGHT | {"image": "b.png"}
    done = CliRunner().invoke(app, ["score-boxes", known, str(write(tmp_path / "boxes.json", [one, none]))])
    assert done.exit_code == 0, done.output
    assert ["fork", "1", "1", "1.00", "1.00", "1.00", "1.00"] in [line.split() for line in done.output.splitlines()]
    assert "warning: boxes left out, because no label has their picture: 1 ('b.png')" in done.output
    done = CliRunner().invoke(app, ["score-boxes", known, str(write(tmp_path / "boxes.json", [none]))])
    assert (done.exit_code, "0.00" in done.output) == (2, False)
    assert "no box is of a labelled category in its picture" in done.output


def test_sizes_and_boxes_of_labels(tmp_path: Path) -> None:
    item = asked("a", "fork", "[64, 96, 192, 192]")
    [label] = read_labels(write(tmp_path / "labels.json", [item | {"width": 640, "height": 480}]))
    assert (label.box, label.size) == ((0.1, 0.2, 0.3, 0.4), (640, 480))
    for size in ({}, {"width": 640}, {"width": 0, "height": 480}, {"width": "640", "height": 480}):
        with pytest.raises(ConfigError) as error:
            read_labels(write(tmp_path / "labels.json", [item | size]))
        assert error.value.code == "file_invalid"


def test_an_answer_that_is_no_box_is_a_miss(tmp_path: Path) -> None:
    values: tuple[Any, ...] = (
        [],
        [1, 2, 3],
        None,
        "I cannot see one",
        "[0.3, 0.2, 0.1, 0.4]",
        "[1e999, 0, 1e999, 1]",
        [0, 0, 10**400, 1],
    )
    found = read(tmp_path, [RIGHT, *(RIGHT | {"box": value} for value in values)])
    assert (len(found.boxes), found.warnings) == (1, ("answers that are no box: 7",))


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
        [{"image_id": True, "category": "fork", "bbox": [0, 0, 1, 1]}],
        [{"image_id": "a", "category_id": True, "bbox": [0, 0, 1, 1]}],
        [{"image_id": "a", "category": "fork", "bbox": [0, 0, -1, 1]}],
    ],
)
def test_files_of_another_form_are_refused(content: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read(tmp_path, content, labels(1))
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
        read_detections(tmp_path / "boxes.json", labels(1))
    assert caught.value.code == "file_invalid"
    assert len(str(caught.value)) < 500


def test_a_long_question_is_read_to_a_limited_length(tmp_path: Path) -> None:
    item = {"image": "a", "question": "handle of a " * 200_000, "box": [0, 0, 1, 1]}
    with soon(2.0), pytest.raises(ConfigError, match="no label has their category") as caught:
        read(tmp_path, [item], [LabelledBox("a", "fork", UNIT)])
    assert len(str(caught.value)) < 1000


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
