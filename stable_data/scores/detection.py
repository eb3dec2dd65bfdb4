"""Average precision of detected boxes, as in the paper's table of manipulability: AP at an overlap of 0.5 and 0.75.

Boxes are left, top, right and bottom. The overlap of two boxes is the area of their intersection divided by that of their union (IoU).
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from stable_data.errors import ConfigError
from stable_data.json_text import number, quote_value, read_json

Box: TypeAlias = tuple[float, float, float, float]

OVERLAPS = (0.5, 0.75)
"""Overlaps at which a detected box counts as right."""

_LONGEST_ANSWER = 1000  # characters of a question or an answer that are read
_QUESTION = re.compile(r"handle of an? (?P<name>[^.?!]+)")


@dataclass(frozen=True, slots=True)
class LabelledBox:
    """Where something is in an image.

    Attributes:
        image: Name of the image.
        category: What it is.
        box: Its box.
    """

    image: str
    category: str
    box: Box


@dataclass(frozen=True, slots=True)
class DetectedBox(LabelledBox):
    """Where a detector says that something is.

    Attributes:
        score: How sure it is; boxes with a higher score are looked at first.
    """

    score: float = 1.0


@dataclass(frozen=True, slots=True)
class DetectionScore:
    """How well the boxes of a category were found.

    Attributes:
        category: The category.
        labels: Number of labelled boxes.
        detections: Number of detected ones in the same images.
        precision: Average precision by overlap.
        running_precision: By overlap, the mean over the labelled boxes, in their order, of the share of right ones so far, one detected
            box for each: what the program of ManipVQA prints.
    """

    category: str
    labels: int
    detections: int
    precision: Mapping[float, float]
    running_precision: Mapping[float, float]


def overlap(one: Box, other: Box) -> float:
    """Returns the overlap of two boxes, 0 to 1."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    common = max(0.0, width) * max(0.0, height)
    union = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (one, other)) - common
    return common / union if union > 0 else 0.0


def average_precision(labels: Sequence[LabelledBox], found: Sequence[DetectedBox], at: float) -> float:
    """Returns the area below the curve of precision over recall.

    A detected box is right if it overlaps a label of its image that no earlier box took, the one that it overlaps most. The precision
    at a recall is the largest at this recall or a higher one. Boxes of equal score are taken together, so that their order, which says
    nothing, decides nothing.

    Args:
        labels: The labelled boxes of one category, at least one.
        found: The detected boxes of this category.
        at: The overlap from which a box counts as right.
    """
    order = sorted(range(len(found)), key=lambda k: -found[k].score)
    taken, right = set[int](), np.zeros(len(found), np.bool_)
    of_image: dict[str, list[int]] = {}
    for n, label in enumerate(labels):
        of_image.setdefault(label.image, []).append(n)
    for place, k in enumerate(order):
        free = [(overlap(found[k].box, labels[n].box), -n) for n in of_image.get(found[k].image, ()) if n not in taken]
        best = max(free, default=(0.0, 0))
        if best[0] >= at:
            taken.add(-best[1])
            right[place] = True
    scores = np.array([found[k].score for k in order])
    ends = np.flatnonzero(np.diff(scores, append=-np.inf))  # the last box of each score
    hits = np.cumsum(right)[ends]
    recall, precision = hits / len(labels), hits / (ends + 1)
    highest = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(recall, prepend=0.0) * highest).sum())


def score_detections(
    labels: Sequence[LabelledBox], found: Sequence[DetectedBox], overlaps: Sequence[float] = OVERLAPS
) -> list[DetectionScore]:
    """Scores detected boxes by category, in alphabetical order.

    Args:
        labels: The labelled boxes.
        found: The detected boxes. Those of a category in an image without a label of it are left out: nobody asked for them, and
            something of the category may be there.
        overlaps: The overlaps from which a box counts as right.
    """
    scores = []
    labels_of, boxes_of = defaultdict[str, list[LabelledBox]](list), defaultdict[str, list[DetectedBox]](list)
    for label in labels:
        labels_of[label.category].append(label)
    for box in found:
        boxes_of[box.category].append(box)
    for category, own in sorted(labels_of.items()):
        asked = {label.image for label in own}
        boxes = [box for box in boxes_of[category] if box.image in asked]
        precision = {at: average_precision(own, boxes, at) for at in overlaps}
        running = {at: _running_precision(own, boxes, at) for at in overlaps}
        scores.append(DetectionScore(category, len(own), len(boxes), precision, running))
    return scores


def _running_precision(labels: Sequence[LabelledBox], found: Sequence[DetectedBox], at: float) -> float:
    first = dict[str, DetectedBox]()
    for box in found:
        first.setdefault(box.image, box)
    right = [label.image in first and overlap(label.box, first[label.image].box) > at for label in labels]
    return float((np.cumsum(right) / np.arange(1, len(labels) + 1)).mean())


def read_labels(path: Path) -> list[LabelledBox]:
    """Reads the questions of ``export --format manipvqa``.

    Raises:
        ConfigError: The file cannot be read or has another form (``file_invalid``).
    """
    labels = []
    for k, item in enumerate(_items(path)):
        where = f"{path}: item {k}"
        said = _turn(item, 1, where)
        numbers = [float(value) for value in re.findall(r"-?\d+\.?\d*", said[:_LONGEST_ANSWER])]
        labels.append(LabelledBox(str(item.get("image")), _category(item, where), _box(numbers, where)))
    if not labels:
        raise ConfigError(f"{path}: has no questions, expected some", "file_invalid")
    return labels


def read_detections(path: Path) -> list[DetectedBox]:
    """Reads the boxes of a detector.

    The file has a JSON list of objects: ``image``; ``category``, or ``question`` as it was asked; ``box``, or ``format_answer`` as ManipVQA
    writes it, four shares of the picture; and optionally ``score``. An answer that is no box is none, so that its label is missed.

    Raises:
        ConfigError: The file cannot be read or has another form (``file_invalid``).
    """
    found = []
    for k, item in enumerate(_items(path)):
        where = f"{path}: item {k}"
        if not {"box", "format_answer"} & item.keys():
            raise ConfigError(f"{where} has neither box nor format_answer, expected one of them", "file_invalid")
        values = item.get("box", item.get("format_answer"))
        if not isinstance(item.get("image"), str):
            raise ConfigError(f"{where} has image {quote_value(item.get('image'))}, expected a name", "file_invalid")
        score = item.get("score", 1.0)
        if not _is_number(score):
            raise ConfigError(f"{where} has score {quote_value(score)}, expected a number", "file_invalid")
        category = _category(item, where)
        if isinstance(values, list) and len(values) == 4 and all(map(_is_number, values)):
            found.append(DetectedBox(item["image"], category, _box(values, where), float(score)))
        elif not isinstance(values, list | str | None):
            raise ConfigError(f"{where} has box {quote_value(values)}, expected four numbers", "file_invalid")
    return found


def _items(path: Path) -> Iterable[dict[str, Any]]:
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}), expected a JSON list", "file_invalid") from error
    if not isinstance(content, list) or not all(isinstance(item, dict) for item in content):
        raise ConfigError(f"{path}: is no list of objects, expected one for each box", "file_invalid")
    return content


def _turn(item: Mapping[str, Any], number: int, where: str) -> str:
    try:
        return str(item["conversations"][number]["value"])
    except (KeyError, IndexError, TypeError) as error:
        raise ConfigError(f"{where} has no question and answer, expected two conversations", "file_invalid") from error


def _category(item: Mapping[str, Any], where: str) -> str:
    if isinstance(item.get("category"), str):
        return str(item["category"])
    asked = item.get("question") or _turn(item, 0, where)
    found = _QUESTION.search(str(asked)[:_LONGEST_ANSWER])
    if found is None:
        raise ConfigError(f"{where} has no category, and none follows from its question {quote_value(asked)}", "file_invalid")
    return found["name"].strip().replace(" ", "_")


def _is_number(value: Any) -> bool:
    found = number(value)  # infinite for an integer beyond the range of a double
    return found is not None and math.isfinite(found)


def _box(values: Sequence[float], where: str) -> Box:
    if len(values) != 4 or not (values[0] <= values[2] and values[1] <= values[3]) or not all(map(math.isfinite, values)):
        raise ConfigError(f"{where} has box {quote_value(list(values))}, expected left, top, right and bottom", "file_invalid")
    return (float(values[0]), float(values[1]), float(values[2]), float(values[3]))
