"""Results of a long measurement, kept as they come: it can be stopped and continued, and several processes can share it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.correction import Result
from benchmarks.layouts import StartLayout
from stable_data.config_diff import refuse_changed
from stable_data.errors import ConfigError

_SETTINGS = "settings.json"


@dataclass(frozen=True, slots=True)
class MeasuredLayout:
    """The figures of one method on one layout, a part of :class:`benchmarks.correction.Result`, whose names these are."""

    method: str
    layout: str
    bucket: str
    num_objects: int
    clean: bool | None
    num_dropped: int
    num_collisions: int
    num_floating: int
    num_outside: int
    oc: float
    oc_sdf: float | None
    move_mean_mm: float
    move_category_mm: float
    emd_mm: float | None
    emd_category_mm: float | None
    converged: bool
    failed: bool
    seconds: float
    reason: str

    @classmethod
    def of(cls, result: Result) -> "MeasuredLayout":
        """Takes the figures of a result."""
        return cls(**{name: getattr(result, name) for name in cls.__slots__})


@dataclass(frozen=True, slots=True)
class Share:
    """The part of the scenes that a process measures.

    Attributes:
        number: Its number, from 1.
        count: Number of processes.
    """

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> "Share":
        """Reads ``K/N``.

        Raises:
            ConfigError: It has another form, or K is not of 1 to N (``usage``).
        """
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise ConfigError(f"--share is {text!r}, expected K/N with K of 1 to N, such as 1/2", "usage")
        return cls(int(number), int(count))

    def of_layouts(self, layouts: Sequence[StartLayout]) -> list[StartLayout]:
        """Returns the layouts of this share; all layouts of a scene are in one."""
        scenes = [(one.target or one.start).scene_id for one in layouts]
        places = {scene_id: place for place, scene_id in enumerate(dict.fromkeys(scenes))}
        return [one for one, scene_id in zip(layouts, scenes, strict=True) if places[scene_id] % self.count == self.number - 1]


class ResultLog:
    """Results, kept in a folder: a file of lines for each share. Without a folder they are in memory alone.

    Args:
        folder: The folder.
        settings: What shapes the results, as values of JSON.
        share: The share of this process.

    Raises:
        ConfigError: The folder has results of other settings (``config_changed``), or a file in it is damaged (``log_invalid``).
    """

    def __init__(self, folder: Path | None, settings: Mapping[str, Any], share: Share) -> None:
        self.share = share
        self._known = dict[tuple[str, str, str], MeasuredLayout]()
        self._file = None if folder is None else folder / f"results-{share.number}-of-{share.count}.jsonl"
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        file, now = folder / _SETTINGS, json.loads(json.dumps(dict(settings)))
        if not file.exists():
            file.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n", "utf-8")
        refuse_changed(str(folder), json.loads(file.read_text("utf-8")), now)
        for path in sorted(folder.glob("results-*.jsonl")):
            self._read(path)

    def _read(self, path: Path) -> None:
        *lines, rest = path.read_bytes().split(b"\n")
        for number, line in enumerate(lines, 1):
            try:
                self._note(MeasuredLayout(**json.loads(line)))
            except (ValueError, TypeError) as error:
                raise ConfigError(f"{path}: line {number} is no result ({error}); delete the file", "log_invalid") from error
        if rest and path == self._file:  # a stop has cut off the last line
            path.write_bytes(b"".join(line + b"\n" for line in lines))

    def _note(self, result: MeasuredLayout) -> None:
        self._known[result.method, result.layout, result.bucket] = result

    def known(self, method: str, layout: StartLayout) -> MeasuredLayout | None:
        """Returns the result of a method on a layout; None if it was not measured yet."""
        return self._known.get((method, layout.start.scene_id, layout.bucket))

    def add(self, result: Result) -> None:
        """Keeps a result."""
        measured = MeasuredLayout.of(result)
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(asdict(measured)) + "\n")
        self._note(measured)
