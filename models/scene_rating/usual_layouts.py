"""How the things of a category usually stand on tables: with what, facing where, how much of the table a layout takes.

The statistics of the embedded world are in ``models/weights/scene_rating/usual_layouts.json``. ``python -m
models.scene_rating.usual_layouts FOLDER --out FILE`` measures those of a folder in the MesaTask-10K format.
"""

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import shapely
import typer

from stable_data.atomic_files import write_file_atomically
from stable_data.commands.command_line import echo, with_clear_errors
from stable_data.errors import ConfigError
from stable_data.json_text import read_json
from stable_data.mesatask import MesaTaskDataset
from stable_data.rotations import wrap_angle
from stable_data.scene import TABLE, Scene, SceneObject
from stable_data.scene_graph.relations import yawed_rectangle
from stable_data.scene_graph.support_from_boxes import carriers_of

DEFAULT = Path(__file__).resolve().parents[1] / "weights" / "scene_rating" / "usual_layouts.json"
"""The statistics of the embedded world."""

VERSION = 1

FEWEST_SCENES = 100
"""Scenes of a kind of table that are enough to say what stands together on it."""

FEWEST_OBJECTS = 20
"""Objects of a category that are enough to say how they are turned."""

UPRIGHT = math.radians(5)
"""An object that is tilted more is not counted: its yaw says nothing about its front."""

_FRONT = math.radians(45)  # largest yaw of an object that faces the front edge
_SIZES = (3, 6, 11, 16)  # fewest objects of the groups of layouts whose spread is measured apart
_RARE = 0.01  # share of the layouts that are heaped up more, or farther off the middle

Pair: TypeAlias = tuple[str, str]
"""Two categories in alphabetical order."""


@dataclass(frozen=True, slots=True)
class UsualTurn:
    """How the things of a category are turned that stand on a table.

    Attributes:
        count: Number of measured objects.
        front: Share of them that face the front edge, within 45 degrees.
        askew: 95 % quantile of the angle to the nearest multiple of 90 degrees, radians.
    """

    count: int
    front: float
    askew: float


@dataclass(frozen=True)
class UsualLayouts:
    """Statistics of layouts.

    Attributes:
        num_scenes: Number of scenes of each kind of table.
        turns: How things are turned, by category.
        together: Pairs of categories that stand on the same table, by kind of table.
        least_spread: Spread that 99 % of the layouts exceed, see :func:`spread_of`, by the fewest objects of its group.
        most_offset: Offset that 99 % of the layouts do not exceed, see :func:`offset_of`, likewise.
    """

    num_scenes: Mapping[str, int]
    turns: Mapping[str, UsualTurn]
    together: Mapping[str, frozenset[Pair]]
    least_spread: Mapping[int, float]
    most_offset: Mapping[int, float]

    @cached_property
    def _anywhere(self) -> frozenset[Pair]:
        return frozenset().union(*self.together.values())

    @cached_property
    def categories(self) -> frozenset[str]:
        """The known categories."""
        return frozenset(category for pair in self._anywhere for category in pair)

    def knows_table(self, table_type: str) -> bool:
        """Whether there are enough scenes of a kind of table; else all kinds count."""
        return self.num_scenes.get(table_type, 0) >= FEWEST_SCENES

    def company(self, category: str, others: Sequence[str], table_type: str) -> float | None:
        """Returns the share of other categories that ever stand together with one on a kind of table.

        Args:
            category: The category.
            others: The other categories of a layout.
            table_type: The kind of table; one that is not known stands for all kinds.

        Returns:
            The share of the known others; None if the category is unknown, or fewer than three of the others are known.
        """
        known = [other for other in others if other in self.categories and other != category]
        if category not in self.categories or len(known) < 3:
            return None
        pairs = self.together[table_type] if self.knows_table(table_type) else self._anywhere
        return sum(_pair(category, other) in pairs for other in known) / len(known)

    def turn(self, category: str) -> UsualTurn | None:
        """Returns how the things of a category are turned; None if too few were measured."""
        found = self.turns.get(category)
        return found if found is not None and found.count >= FEWEST_OBJECTS else None

    def limits(self, num_objects: int) -> tuple[float, float] | None:
        """Returns the least usual spread and the largest usual offset by the number of objects; None for fewer than three."""
        groups = [fewest for fewest in self.least_spread if fewest <= num_objects]
        return (self.least_spread[max(groups)], self.most_offset[max(groups)]) if groups else None

    def save(self, path: Path) -> None:
        """Writes the statistics to a file."""
        together = {table: sorted(f"{a} {b}" for a, b in pairs) for table, pairs in sorted(self.together.items())}
        turns = {name: asdict(turn) for name, turn in sorted(self.turns.items())}
        content = {"version": VERSION, "num_scenes": dict(sorted(self.num_scenes.items()))}
        limits = {"least_spread": self.least_spread, "most_offset": self.most_offset}
        content |= {name: {str(k): v for k, v in values.items()} for name, values in limits.items()}
        content |= {"turns": turns, "together": together}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(path, (json.dumps(content, indent=0, separators=(",", ":")) + "\n").encode())

    @classmethod
    def load(cls, path: Path = DEFAULT) -> "UsualLayouts":
        """Reads the statistics of a file.

        Raises:
            ConfigError: The file cannot be read (``statistics_missing``), or its content is not valid (``statistics_invalid``).
        """
        advice = "create it with: python -m models.scene_rating.usual_layouts FOLDER --out FILE"
        try:
            data: Any = read_json(path)
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be read ({error.strerror or error}), expected statistics of layouts; {advice}",
                "statistics_missing",
            ) from error
        except ValueError as error:
            raise ConfigError(f"{path}: not a JSON file ({error}); {advice}", "statistics_invalid") from error
        if not isinstance(data, dict) or data.get("version") != VERSION:
            raise ConfigError(f"{path}: expected statistics of version {VERSION}; {advice}", "statistics_invalid")
        try:
            return cls(
                {table: int(n) for table, n in data["num_scenes"].items()},
                {name: UsualTurn(int(t["count"]), float(t["front"]), float(t["askew"])) for name, t in data["turns"].items()},
                {table: frozenset(_pair(*pair.split(" ")) for pair in pairs) for table, pairs in data["together"].items()},
                *({int(n): float(v) for n, v in data[name].items()} for name in ("least_spread", "most_offset")),
            )
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"{path}: {error!r}; {advice}", "statistics_invalid") from error

    @classmethod
    def of_scenes(cls, scenes: Iterable[Scene]) -> "UsualLayouts":
        """Measures scenes; the supports of their objects must be known."""
        num_scenes: Counter[str] = Counter()
        together: defaultdict[str, set[Pair]] = defaultdict(set)
        yaws: defaultdict[str, list[float]] = defaultdict(list)
        places: defaultdict[int, list[tuple[float, float]]] = defaultdict(list)
        for scene in scenes:
            table_type = scene.table.table_type
            num_scenes[table_type] += 1
            together[table_type].update(combinations(sorted({o.category for o in scene.movable}), 2))
            for o in standing_objects(scene):
                if o.tilt_angle <= UPRIGHT:
                    yaws[o.category].append(o.yaw)
            groups = [fewest for fewest in _SIZES if fewest <= len(scene.movable)]
            if groups:
                places[max(groups)].append((spread_of(scene), offset_of(scene)))
        least, most = (
            {n: round(float(np.quantile([place[k] for place in found], share)), 4) for n, found in sorted(places.items())}
            for k, share in ((0, _RARE), (1, 1 - _RARE))
        )
        turns = {category: _usual_turn(values) for category, values in yaws.items()}
        return cls(num_scenes, turns, {table: frozenset(pairs) for table, pairs in together.items()}, least, most)


def _pair(one: str, other: str) -> Pair:
    return (one, other) if one < other else (other, one)


def _usual_turn(yaws: Sequence[float]) -> UsualTurn:
    quantile = float(np.quantile([askew(yaw) for yaw in yaws], 0.95))
    return UsualTurn(len(yaws), round(float((np.abs(wrap_angle(np.array(yaws))) <= _FRONT).mean()), 4), round(quantile, 4))


def turned_away(yaw: float) -> float:
    """Returns the angle between the facing of an object and the direction of the front edge, 0 to π."""
    return float(abs(wrap_angle(np.array(yaw))))


def askew(yaw: float) -> float:
    """Returns the angle to the nearest multiple of 90 degrees, 0 to π / 4."""
    return float(abs((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4))


def standing_objects(scene: Scene) -> list[SceneObject]:
    """The objects that stand on the table itself."""
    return [o for o in scene.movable if o.support == TABLE]


def spread_of(scene: Scene) -> float:
    """Returns the area of the convex hull around the outlines of all objects, as a share of the table's area."""
    outlines = [yawed_rectangle(o) for o in scene.movable]
    if not outlines:
        return 0.0
    x, y = scene.table.size_xy
    return float(shapely.convex_hull(shapely.multipoints(np.concatenate(outlines))).area) / (x * y)


def offset_of(scene: Scene) -> float:
    """Returns how far the mean of the objects' centres is from the middle of the table: 0 there, 1 at an edge."""
    if not scene.movable:
        return 0.0
    half = np.array(scene.table.size_xy) / 2
    middle = np.array([o.position[:2] for o in scene.movable]).mean(axis=0)
    return float((np.abs(middle - half) / half).max())


def read_scenes(folder: Path) -> Iterable[Scene]:
    """Yields the scenes of a folder in the MesaTask-10K format, with supports by boxes."""
    dataset = MesaTaskDataset(folder)
    for scene_id in dataset.scene_ids:
        scene, _ = dataset.read(scene_id)
        carriers = carriers_of(scene.objects, scene.table)
        yield Scene(scene.scene_id, scene.table, tuple(replace(o, support=carriers[o.instance]) for o in scene.objects))


def main(
    folder: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format.")],
    out: Annotated[Path, typer.Option(help="The file.")] = DEFAULT,
) -> None:
    """Measures how things stand on the tables of a folder."""
    found = UsualLayouts.of_scenes(read_scenes(folder))
    found.save(out)
    echo(f"{out}: {sum(found.num_scenes.values())} scenes, {len(found.categories)} categories, {len(found.turns)} with a turn")


if __name__ == "__main__":
    typer.run(with_clear_errors(main))
