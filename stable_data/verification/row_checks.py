"""Checks rows of ``episodes``, ``ratings`` and ``views``, which stand by themselves."""

from collections.abc import Callable, Iterator, Mapping, Sequence

from stable_data.errors import StableDataError
from stable_data.rating.rating import rating_of_row
from stable_data.robot.episodes import episode_from_row
from stable_data.storage.schemas import Row
from stable_data.verification.findings import Findings
from stable_data.verification.images import image_fault
from stable_data.verification.scene_checks import is_close
from stable_data.verification.shard_files import ShardFile

_PNG = "image/png"


class OwnCheck:
    """Checks rows of a table by themselves.

    Args:
        table: The table.
        findings: Where damage is noted.
    """

    def __init__(self, table: str, findings: Findings) -> None:
        self._faults, self._findings = FAULTS[table], findings

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            try:
                faults = list(self._faults(row))
            except (StableDataError, AssertionError, ValueError, TypeError, KeyError) as error:
                faults = [str(error) or type(error).__name__]
            for what in faults:
                self._findings.damage(file.name, what, number)


def _episode_faults(row: Row) -> Iterator[str]:
    episode = episode_from_row(row)
    if row["num_steps"] != episode.num_steps:
        yield f"{episode.episode_id}: num_steps is {row['num_steps']}, expected {episode.num_steps}"
    height, width = episode.image_size or (0, 0)
    for camera, files in episode.pictures.items():
        for number, content in enumerate(files):
            if fault := image_fault(content, _PNG, (width, height)):
                yield f"{episode.episode_id}: picture {number} of camera {camera} {fault}"


def _rating_faults(row: Row) -> Iterator[str]:
    rating = rating_of_row(row)
    for name in ("average", "quality_pass"):
        if not is_close(row[name], getattr(rating, name)):
            yield f"{rating.scene_id}: {name} is {row[name]}, expected {getattr(rating, name)} by its scores"


def _view_faults(row: Row) -> Iterator[str]:
    names = [view["view"] for view in row["views"]]
    if not names or len(set(names)) < len(names) or len({len(view["features"]) for view in row["views"]}) > 1:
        yield f"{row['scene_id']}: views are {names}, expected each once, with as many features"
    for view in row["views"]:
        if fault := image_fault(view["picture"], _PNG, None):
            yield f"{row['scene_id']}: the picture {view['view']} {fault}"


FAULTS: Mapping[str, Callable[[Row], Iterator[str]]] = {
    "episodes": _episode_faults,
    "ratings": _rating_faults,
    "views": _view_faults,
}
"""Name of a table -> what is wrong with a row of it."""
