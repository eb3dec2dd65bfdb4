"""Average precision of detected boxes, as in the paper's table of manipulability: AP at an overlap of 0.5 and 0.75.

Boxes are left, top, right and bottom. The overlap of two boxes is the area of their intersection divided by that of their union (IoU).
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from stable_data.errors import ConfigError
from stable_data.json_text import number, quote_value, read_json

Box: TypeAlias = tuple[float, float, float, float]
Size: TypeAlias = tuple[int, int]
"""Width and height of an image, pixels."""

OVERLAPS = (0.5, 0.75)
"""Overlaps at which a detected box counts as right."""

_LONGEST_ANSWER = 1000  # characters of a question or an answer that are read
_QUESTION = re.compile(r"handle of an? (?P<name>[^.?!]+)")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_IN_BRACKETS = re.compile(r"\[([^\[\]]*)\]")
_MOST_SHARE = 2.0
"""Largest coordinate of a box in shares of the picture. A detector may reach a little beyond the picture; pixels reach farther than 2."""
_MARGIN = 0.1  # share of the picture by which a detector may err at its border
_NAMED = 3  # examples of a name that is not known


@dataclass(frozen=True, slots=True)
class LabelledBox:
    """Where something is in an image.

    Attributes:
        image: Name of the image.
        category: What it is.
        box: Its box.
        size: Width and height of the image, pixels; None if they are not known.
    """

    image: str
    category: str
    box: Box
    size: Size | None = None


@dataclass(frozen=True, slots=True)
class DetectedBox:
    """Where a detector says that something is.

    Attributes:
        image: Name of the image.
        category: What it is.
        box: Its box.
        score: How sure it is; boxes with a higher score are looked at first.
    """

    image: str
    category: str
    box: Box
    score: float = 1.0


@dataclass(frozen=True, slots=True)
class Detections:
    """The boxes of a detector that belong to the labels.

    Attributes:
        boxes: The boxes, with the names of images and categories that the labels have.
        warnings: What was left out, a line for each reason.
    """

    boxes: tuple[DetectedBox, ...]
    warnings: tuple[str, ...]


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
    """Reads the questions of ``export --format manipvqa``; their boxes are shares of the picture.

    Raises:
        ConfigError: The file cannot be read or has another form (``file_invalid``).
    """
    labels = []
    for k, item in enumerate(_items(path)):
        where = f"{path}: item {k}"
        box, size = _box(_numbers_of(_turn(item, 1, where)), where), _size(item, where)
        labels.append(LabelledBox(str(item.get("image")), _category(item, where), _shares(box, size, where), size))
    if not labels:
        raise ConfigError(f"{path}: has no questions, expected some", "file_invalid")
    return labels


def read_detections(path: Path, labels: Sequence[LabelledBox]) -> Detections:
    """Reads the boxes of a detector, and finds the labelled image and category of each.

    The file has a JSON list of objects, in one of two forms:

    * ``image``; ``category``, or ``question`` as it was asked; ``box`` with left, top, right and bottom, or ``format_answer`` as ManipVQA
      writes it; and optionally ``score``. A box may be text with four numbers.
    * The results format of COCO: ``image_id``, ``category_id`` or ``category``, ``bbox`` with left, top, width and height, and ``score``.
      An ``image_id`` is a file name, or the number of the image in the order of the labels; a ``category_id`` is the number of the category
      in alphabetical order. Both count from 1.

    Coordinates are shares of the picture, or pixels if one of them is larger than 2. Names of images that are not those of the labels are
    compared without their folders, categories without case. An answer that is no box is none, so that its label is missed.

    Args:
        path: The file.
        labels: The labelled boxes.

    Raises:
        ConfigError: The file cannot be read or has another form, or boxes are in pixels of a picture whose size is not known
            (``file_invalid``); or no box is of a labelled category in its image (``boxes_unmatched``), from which no score follows.
    """
    known, kept, left = _Labels(labels), list[DetectedBox](), _LeftOut()
    stated = list(_items(path))
    names = [_stated_image(item, f"{path}: item {k}") for k, item in enumerate(stated)]
    short_names = _unique((_short_name(name), name) for name in names if isinstance(name, str))
    for k, (item, name) in enumerate(zip(stated, names, strict=True)):
        where = f"{path}: item {k}"
        box, of = _stated_box(item, where), _stated_category(item, where)
        score = item.get("score", 1.0)
        if not _is_number(score):
            raise ConfigError(f"{where} has score {quote_value(score)}, expected a number", "file_invalid")
        image, category = known.image(name, short_names, where), known.category(of, where)
        if box is None:
            left.answers += 1
        elif image is None:
            left.images[str(name)] += 1
        elif category is None:
            left.categories[str(of)] += 1
        elif (image, category) not in known.pairs:
            left.unasked += 1
        else:
            size = known.sizes.get(image)
            box = _shares(box, size, where)
            left.beyond += max(box) > 1 + _MARGIN or min(box) < -_MARGIN
            kept.append(DetectedBox(image, category, box, float(score)))
    if not kept:
        why = "; ".join(left.lines()) or "it has no boxes"
        raise ConfigError(
            f"{path}: no box is of a labelled category in its picture, expected some, because no score follows from none: {why}",
            "boxes_unmatched",
        )
    return Detections(tuple(kept), tuple(left.lines()))


class _Labels:
    """The images and categories of labels.

    Attributes:
        pairs: The images with the categories that are labelled in them.
        sizes: The sizes of the images that are known.
    """

    def __init__(self, labels: Sequence[LabelledBox]) -> None:
        self.pairs = {(label.image, label.category) for label in labels}
        self.sizes = {label.image: label.size for label in labels if label.size is not None}
        self._images = list(dict.fromkeys(label.image for label in labels))
        self._categories = sorted({label.category for label in labels})
        self._image_set, self._category_set = frozenset(self._images), frozenset(self._categories)
        self._of_short_name = _unique((_short_name(name), name) for name in self._images)
        self._of_plain_name = _unique((_plain_name(name), name) for name in self._categories)

    def image(self, name: str | int, stated: Mapping[str, str | None], where: str) -> str | None:
        """The labelled image of a name or number; None if there is none, or if its name without folder is that of several.

        Args:
            name: The name or number.
            stated: The stated names by their names without folder, None for several.
            where: The item, for errors.
        """
        if isinstance(name, int):
            return _numbered(name, self._images, "image_id", "the number of a picture in the order of the labels", where)
        short = _short_name(name)
        return name if name in self._image_set else None if stated[short] is None else self._of_short_name.get(short)

    def category(self, name: str | int, where: str) -> str | None:
        """The labelled category of a name or number; None if there is none."""
        if isinstance(name, int):
            meaning = "the number of a category in their alphabetical order"
            return _numbered(name, self._categories, "category_id", meaning, where)
        return name if name in self._category_set else self._of_plain_name.get(_plain_name(name))


class _LeftOut:
    """Counts of what is left out or odd.

    Attributes:
        answers: Answers that are no box.
        images: Boxes in images without labels, by name.
        categories: Boxes of categories without labels, by name.
        unasked: Boxes of a labelled category in a labelled image, but of one that is not labelled in it.
        beyond: Boxes that are scored, but reach far beyond their picture.
    """

    def __init__(self) -> None:
        self.answers = self.unasked = self.beyond = 0
        self.images, self.categories = Counter[str](), Counter[str]()

    def lines(self) -> Iterable[str]:
        """The counts that are not 0, as text."""
        for what, found in (("picture", self.images), ("category", self.categories)):
            if found:
                names = ", ".join(quote_value(name) for name in list(found)[:_NAMED]) + (", ..." if len(found) > _NAMED else "")
                yield f"boxes left out, because no label has their {what}: {found.total()} ({names})"
        if self.unasked:
            yield f"boxes left out, because nobody asked for their category in their picture: {self.unasked}"
        if self.answers:
            yield f"answers that are no box: {self.answers}"
        if self.beyond:
            yield f"boxes that reach far beyond their picture: {self.beyond}; expected shares of the picture, or pixels"


def _unique(pairs: Iterable[tuple[str, str]]) -> dict[str, str | None]:
    """Values by key; None for a key with several."""
    found = dict[str, str | None]()
    for key, value in pairs:
        found[key] = value if found.get(key, value) == value else None
    return found


def _short_name(image: str) -> str:
    """The name of an image without its folder."""
    return re.split(r"[/\\]", image)[-1]


def _plain_name(category: str) -> str:
    """A category in lower case, with one underscore between its words."""
    return re.sub(r"[\s_-]+", "_", category.strip().casefold())


def _numbered(number: int, names: Sequence[str], key: str, meaning: str, where: str) -> str:
    """The name with a number, counted from 1. A wrong number is an error: those of all others may be wrong by as much."""
    if not 0 < number <= len(names):
        raise ConfigError(f"{where} has {key} {quote_value(number)}, expected 1 to {len(names)}: {meaning}", "file_invalid")
    return names[number - 1]


def _stated_image(item: Mapping[str, Any], where: str) -> str | int:
    if isinstance(item.get("image"), str):
        return str(item["image"])
    found = item.get("image_id")
    if "image" not in item and isinstance(found, str | int) and not isinstance(found, bool):
        return found
    raise ConfigError(f"{where} has image {quote_value(item.get('image', found))}, expected a name", "file_invalid")


def _stated_category(item: Mapping[str, Any], where: str) -> str | int:
    found = item.get("category_id")
    if "category" not in item and isinstance(found, int) and not isinstance(found, bool):
        return found
    return _category(item, where)


def _stated_box(item: Mapping[str, Any], where: str) -> Box | None:
    """The box of an item as it is written: left, top, right and bottom; None if it is no box."""
    is_coco = "bbox" in item and "image_id" in item
    if not is_coco and not {"box", "format_answer"} & item.keys():
        expected = "bbox beside image_id, as COCO results have it" if "bbox" in item else "one of them"
        raise ConfigError(f"{where} has neither box nor format_answer, expected {expected}", "file_invalid")
    values = item["bbox"] if is_coco else item.get("box", item.get("format_answer"))
    if isinstance(values, str):
        numbers = _numbers_of(values)
        is_box = (
            len(numbers) == 4 and numbers[0] <= numbers[2] and numbers[1] <= numbers[3] and all(map(math.isfinite, numbers))
        )
        return _box(numbers, where) if is_box else None
    if not isinstance(values, list | None):
        raise ConfigError(f"{where} has box {quote_value(values)}, expected four numbers", "file_invalid")
    if values is None or len(values) != 4 or not all(map(_is_number, values)):
        return None
    left, top, right, bottom = map(float, values)
    return _box((left, top, left + right, top + bottom) if is_coco else (left, top, right, bottom), where)


def _numbers_of(text: str) -> list[float]:
    """The numbers of an answer: those in its first brackets with four, else all."""
    text = text[:_LONGEST_ANSWER]
    parts = [_NUMBER.findall(part) for part in _IN_BRACKETS.findall(text)]
    return [float(value) for value in next((part for part in parts if len(part) == 4), _NUMBER.findall(text))]


def _size(item: Mapping[str, Any], where: str) -> Size | None:
    """Width and height of the picture of a label; None if it states neither."""
    if not {"width", "height"} & item.keys():
        return None
    found = [item.get("width"), item.get("height")]
    sides = [side for side in found if isinstance(side, int) and not isinstance(side, bool) and 0 < side < 1 << 31]
    if len(sides) < 2:
        raise ConfigError(f"{where} has width and height {quote_value(found)}, expected pixels", "file_invalid")
    return sides[0], sides[1]


def _shares(box: Box, size: Size | None, where: str) -> Box:
    """A box in shares of the picture; one with a coordinate beyond what shares can be is in pixels."""
    if max(map(abs, box)) <= _MOST_SHARE:
        return box
    if size is None:
        raise ConfigError(
            f"{where} has box {quote_value(list(box))}, which is no share of the picture, and the labels have no width and height "
            "from which pixels could be converted; expected shares, or labels of a newer export",
            "file_invalid",
        )
    left, top, right, bottom = box
    return left / size[0], top / size[1], right / size[0], bottom / size[1]


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
