"""Statistics of categories and words from the split train: sizes, share of supporting objects, words of instructions.

The training measures them once and stores them in the folder of the model as ``categories.json``.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.text.reply_json import layout_names
from stable_data.errors import ConfigError
from stable_data.json_text import are_finite, number, numbers, read_json
from stable_data.scene import SceneObject, Stage, Vec3
from stable_data.storage.row_groups import TableFiles, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row

FILE = "categories.json"
"""File name of the statistics in the folder of a model."""

VERSION = 1

LEVELS = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
"""Levels of the size quantiles."""

_MAX_WORDS = 64  # description words that are stored for a category

Quantiles: TypeAlias = tuple[Vec3, ...]


@dataclass(frozen=True, slots=True)
class Category:
    """Statistics of a category.

    Attributes:
        count: Number of measured objects.
        extents: Quantiles, at :data:`LEVELS`, of the shortest, middle and longest side of the box, metres.
        sizes: Quantiles, at :data:`LEVELS`, of width, depth and height, metres.
        carrying: Share of the objects that support another object.
        words: Counts of the most frequent words in its descriptions.
    """

    count: int
    extents: Quantiles
    sizes: Quantiles
    carrying: float
    words: Mapping[str, int]

    @property
    def usual_size(self) -> Vec3:
        """The median width, depth and height, metres."""
        return self.sizes[LEVELS.index(0.5)]

    @property
    def smallest_size(self) -> Vec3:
        """The 1 % quantiles of width, depth and height, metres."""
        return self.sizes[1]

    @property
    def largest_size(self) -> Vec3:
        """The 99 % quantiles of width, depth and height, metres."""
        return self.sizes[-2]

    @property
    def least(self) -> Vec3:
        """The 1 % quantiles of the sides, shortest side first, metres."""
        return self.extents[1]

    @property
    def most(self) -> Vec3:
        """The 99 % quantiles of the sides, shortest side first, metres."""
        return self.extents[-2]


@dataclass(frozen=True)
class CategoryStatistics:
    """Statistics of all categories.

    Attributes:
        categories: Statistics by category name, as layouts write it.
        words: Count of each word in the instructions.
        tables: Number of scenes of each kind of table.
    """

    categories: Mapping[str, Category]
    words: Mapping[str, int]
    tables: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of_names(cls, categories: Iterable[str]) -> "CategoryStatistics":
        """Returns statistics that contain only category names, so that no size is judged."""
        nothing = Category(0, (), (), 0.0, {})
        return cls(dict.fromkeys(categories, nothing), {})

    def most_frequent(self, categories: Iterable[str]) -> str:
        """Returns the category with the most measured objects; the first of equally frequent ones.

        Args:
            categories: At least one; unknown ones have no objects.
        """
        return max(categories, key=lambda c: self.categories[c].count if c in self.categories else 0)

    # --- files ---

    def save(self, folder: Path) -> None:
        """Writes the statistics into the folder of a model.

        Args:
            folder: The folder; created if it is missing.

        Raises:
            ConfigError: The file cannot be written.
        """
        content = {"version": VERSION, "levels": LEVELS, **asdict(self)}
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        RunFolder(str(folder)).write_bytes(FILE, text.encode())

    @classmethod
    def load(cls, folder: Path) -> "CategoryStatistics":
        """Reads the statistics from the folder of a model.

        Args:
            folder: The folder.

        Raises:
            ConfigError: The file cannot be read (``statistics_missing``), or its content is not valid
                (``statistics_invalid``).
        """
        path = folder / FILE
        try:
            data = read_json(path)
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be read ({error.strerror or error}), expected the statistics of categories; "
                "create them by training the reasoner",
                "statistics_missing",
            ) from error
        except ValueError as error:
            raise ConfigError(
                f"{path}: not a JSON file ({error}); create the statistics again", "statistics_invalid"
            ) from error
        if not isinstance(data, dict) or (data.get("version"), data.get("levels")) != (VERSION, list(LEVELS)):
            raise ConfigError(f"{path}: expected statistics of version {VERSION}; create them again", "statistics_invalid")
        try:
            categories = {name: _category(entry) for name, entry in data["categories"].items()}
            return cls(categories, dict(data["words"]), dict(data["tables"]))
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"{path}: {error!r}; create the statistics again", "statistics_invalid") from error

    # --- measuring ---

    @classmethod
    def of_run(cls, uri: str) -> "CategoryStatistics":
        """Computes the statistics of the split train of a preprocess run.

        Args:
            uri: The run folder, with the table ``samples``.

        Raises:
            ConfigError: The table cannot be read, or has no rows of the split train (``split_empty``).
        """
        files = TableFiles(uri, "samples", None, "train")
        if not len(files):
            raise ConfigError(f"{uri}: table samples has no rows of the split train, expected some", "split_empty")
        seen: set[str] = set()
        return cls.of_rows(row for group in range(len(files.groups)) for row in _rows(files, group, seen))

    @classmethod
    def of_rows(cls, rows: Iterable[Row]) -> "CategoryStatistics":
        """Computes the statistics of rows of ``samples``; rows of the stage ``important`` are not used."""
        counts = _RowCounts()
        for row in rows:
            counts.add(row)
        return counts.statistics()


def _rows(files: TableFiles, group: int, seen: set[str]) -> list[Row]:
    """The rows of a row group that are counted: all first stages, and one last stage of each scene."""
    table = files.read([group])
    stages = zip(table["scene_id"].to_pylist(), table["stage"].to_pylist(), strict=True)
    chosen = []
    for k, (scene_id, stage) in enumerate(stages):
        if stage == Stage.TASK or (stage == Stage.SECONDARY and scene_id not in seen):
            chosen.append(k)
        if stage == Stage.SECONDARY:
            seen.add(scene_id)
    return rows_from_table(table.take(chosen))


def _category(entry: Mapping[str, Any]) -> Category:
    extents, sizes = (tuple(_vec3(v) for v in entry[key]) for key in ("extents", "sizes"))
    if len(extents) != len(LEVELS) or len(sizes) != len(LEVELS):
        raise ValueError(f"{len(extents)} quantiles, expected {len(LEVELS)}")
    count, carrying = entry["count"], number(entry["carrying"])
    if type(count) is not int or carrying is None or not 0 <= carrying <= 1:
        raise ValueError(
            f"count {count!r:.80} and share {entry['carrying']!r:.80}, expected a number of objects and a share of them"
        )
    return Category(count, extents, sizes, carrying, dict(entry["words"]))


def _vec3(values: object) -> Vec3:
    found = numbers(values, 3)
    if found is None or not are_finite(found):
        raise ValueError(f"{values!r:.80}, expected three numbers")
    return found[0], found[1], found[2]


@lru_cache(maxsize=16384)
def _as_written(category: str) -> str:
    """A category as it appears in the instances of layouts."""
    item = SceneObject("item", category, (0.0, 0.0, 0.0), 0.0, (1.0, 1.0, 1.0))
    return layout_names([item])["item"].rpartition("_")[0]


class _RowCounts:
    """Counts over rows of ``samples``."""

    def __init__(self) -> None:
        self._scenes: set[str] = set()
        self._sizes: dict[str, list[list[float]]] = {}
        self._carrying: Counter[str] = Counter()
        self._described: dict[str, Counter[str]] = {}
        self._words: Counter[str] = Counter()
        self._tables: Counter[str] = Counter()

    def add(self, row: Row) -> None:
        """Counts the instruction of a first stage, or the whole layout of a last stage."""
        if row["stage"] == Stage.TASK:
            self._words.update(filter(str.isalnum, split_words(row["task"]["task"])))
        elif row["stage"] == Stage.SECONDARY and row["scene_id"] not in self._scenes:
            self._scenes.add(row["scene_id"])  # other tasks of the scene have the same layout
            self._tables[row["table_type"]] += 1
            self._add_layout([*row["objects_in"], *row["objects_out"]])

    def _add_layout(self, objects: list[Row]) -> None:
        carriers = {o["support"] for o in objects}
        for o in objects:
            category = _as_written(o["category"])
            self._sizes.setdefault(category, []).append(o["size"])
            self._carrying[category] += o["instance"] in carriers
            self._described.setdefault(category, Counter()).update(filter(str.isalnum, split_words(o["description"])))

    def statistics(self) -> CategoryStatistics:
        categories = {name: self._category(name) for name in sorted(self._sizes)}
        return CategoryStatistics(categories, dict(self._words), dict(self._tables))

    def _category(self, name: str) -> Category:
        sizes = np.array(self._sizes[name], np.float64)
        extents, sides = (
            tuple(_vec3(row) for row in np.quantile(values, LEVELS, axis=0).round(5).tolist())
            for values in (np.sort(sizes, axis=1), sizes)
        )
        words = dict(self._described[name].most_common(_MAX_WORDS))
        return Category(len(sizes), extents, sides, round(self._carrying[name] / len(sizes), 4), words)
