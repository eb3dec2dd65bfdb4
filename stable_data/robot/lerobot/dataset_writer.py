"""Writes episodes of a run as a LeRobotDataset v3.0, one episode at a time."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from stable_data.atomic_files import temporary_path
from stable_data.errors import ConfigError, cannot_write
from stable_data.robot.episodes import Episode, EpisodeFeatures, read_episodes
from stable_data.robot.lerobot.chunked_files import CHUNK_FILES, ParquetFiles
from stable_data.robot.lerobot.frames import PICTURE, describe_features, frame_arrays, frame_schema, frame_table
from stable_data.robot.lerobot.metadata import (
    DETAILS,
    describe_dataset,
    describe_in_words,
    episode_schema,
    write_json,
    write_tasks,
)
from stable_data.robot.lerobot.statistics import (
    NAMES,
    PictureStatistics,
    Statistics,
    TotalStatistics,
    array_statistics,
    sampled_frames,
)
from stable_data.robot.lerobot.videos import VideoFiles, check_encoder
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import MAX_BYTES, RunFolder
from stable_data.storage.schemas import SCHEMAS

_EPISODES_AT_ONCE = 100  # of a row group of meta/episodes

Progress: TypeAlias = Callable[[int], None]
"""Called after every episode with the number of episodes that were written."""


@dataclass(frozen=True, slots=True)
class EpisodeSelection:
    """A selection of episodes of a run.

    Attributes:
        where: A condition on ``episodes``, see :mod:`stable_data.storage.filter_expression`; None: all.
        scene_ids: Only episodes of these scenes; of all if empty.
        limit: The number of first episodes that are used; None: all.
        with_failures: Whether failed episodes are used too.
    """

    where: str | None = None
    scene_ids: tuple[str, ...] = ()
    limit: int | None = None
    with_failures: bool = False

    def condition(self, *, success: bool | None = None) -> str | None:
        """Returns the selection without its limit as one condition.

        Args:
            success: The success of the episodes; None as :attr:`with_failures` says.
        """
        if success is None and not self.with_failures:
            success = True
        parts = [] if success is None else ["success" if success else "not success"]
        parts += [f"scene_id in {list(self.scene_ids)!r}"] if self.scene_ids else []
        parts += [f"({self.where})"] if self.where else []
        return " and ".join(parts) or None


@dataclass(frozen=True, slots=True)
class LeRobotResult:
    """The result of an export.

    Attributes:
        num_episodes: Episodes that were written.
        num_frames: Their actions.
        num_tasks: Their different instructions.
        num_failed: Failed episodes of the selection that were left out, without its limit.
    """

    num_episodes: int
    num_frames: int
    num_tasks: int
    num_failed: int


def write_lerobot(
    run: RunFolder,
    out: Path,
    choice: EpisodeSelection = EpisodeSelection(),
    progress: Progress | None = None,
    *,
    is_video: bool = False,
) -> LeRobotResult:
    """Writes episodes of a run as a LeRobotDataset v3.0, in the order of the run.

    A few episodes are in memory at a time. The dataset appears when it is complete.

    Args:
        run: The run.
        out: Local folder of the dataset, which does not exist or is empty.
        choice: Selection of the episodes.
        progress: Called after every episode.
        is_video: Whether pictures are written as videos, with losses; else as the PNG files that they are.

    Raises:
        ConfigError: The run has no episodes, the selection is not valid or empty, the folder has content or cannot be written, or
            there is no encoder of videos, or there are no pictures for them.
        EpisodeError: The episodes have different features (``episodes_mixed``), or an episode cannot be used.
    """
    if choice.where is not None:
        parse_filter(choice.where, SCHEMAS["episodes"])  # alone first, so that an error quotes the user's text only
    _check_scenes(run, choice.scene_ids)
    num_failed = 0
    if not choice.with_failures:
        num_failed = len(TableFiles(run.uri, "episodes", ["success"], where=choice.condition(success=False)))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: exists already, expected a new or empty folder; choose another one", "output_not_empty")
    episodes = _limited(read_episodes(run.uri, where=choice.condition()), choice.limit)
    aside = temporary_path(out.absolute())
    writer: LeRobotWriter | None = None
    try:
        for episode in episodes:
            if writer is None:
                if is_video and episode.features.image_size is None:
                    raise ConfigError(
                        f"{run.uri}: its episodes have no pictures, expected some for a video; leave --video out", "no_pictures"
                    )
                writer = LeRobotWriter(aside, episode.features, is_video=is_video)
            writer.add(episode)
            if progress is not None:
                progress(writer.num_episodes)
        if writer is None:
            raise _nothing_selected(run, choice, num_failed)
        writer.close()
        aside.replace(out)
        return LeRobotResult(writer.num_episodes, writer.num_frames, writer.num_tasks, num_failed)
    except OSError as error:
        raise cannot_write(str(out), error) from error
    finally:
        if writer is not None:
            writer.discard()
        shutil.rmtree(aside, ignore_errors=True)


def _nothing_selected(run: RunFolder, choice: EpisodeSelection, num_failed: int) -> ConfigError:
    what = "episode" if choice.with_failures else "successful episode"
    do = f"add --failures to export the {num_failed} failed ones" if num_failed else "change the selection"
    return ConfigError(f"{run.uri}: no {what} is selected, expected at least one; {do}", "episode_unknown")


def _limited(episodes: Iterator[Episode], limit: int | None) -> Iterator[Episode]:
    for number, episode in enumerate(episodes):
        if number == limit:
            return
        yield episode


def _check_scenes(run: RunFolder, scene_ids: Sequence[str]) -> None:
    """Refuses scenes without episodes."""
    if not scene_ids:
        return
    rows = TableFiles(run.uri, "episodes", ["scene_id"], where=f"scene_id in {list(scene_ids)!r}")
    found = {name for group in range(len(rows.groups)) for name in rows.read([group])["scene_id"].to_pylist()}
    if missing := sorted(set(scene_ids) - found):
        raise ConfigError(
            f"{run.uri}: the run has no episodes of scenes {missing[:5]}, expected others; change --scene", "scene_unknown"
        )


class LeRobotWriter:
    """A LeRobotDataset v3.0 that is being written: :meth:`add` each episode, then :meth:`close`.

    Args:
        folder: The folder, which does not exist.
        features: The features of all episodes.
        is_video: Whether pictures are written as videos.
        max_bytes: Size from which a file is followed by another one; the bytes of an episode are not divided.
        chunk_files: Maximum number of files of a folder ``chunk-…``.

    Attributes:
        num_episodes: Episodes that were added.
        num_frames: Their actions.

    Raises:
        ConfigError: Videos cannot be written, or the actions a second are no whole number (``fps_fraction``).
    """

    def __init__(
        self,
        folder: Path,
        features: EpisodeFeatures,
        *,
        is_video: bool = False,
        max_bytes: int = MAX_BYTES,
        chunk_files: int = CHUNK_FILES,
    ) -> None:
        if features.fps != int(features.fps):
            raise ConfigError(
                f"fps is {features.fps}, expected a whole number of actions a second, as LeRobot has; select episodes with another fps",
                "fps_fraction",
            )
        size = features.image_size if is_video else None
        if size is not None:
            check_encoder(size)
        self._folder, self._features, self._fps, self._chunk_files = folder, features, int(features.fps), chunk_files
        self._described = describe_features(features, is_video=size is not None)
        self._frames = ParquetFiles(folder / "data", frame_schema(self._described), max_bytes, chunk_files)
        self._rows = ParquetFiles(folder / "meta" / "episodes", episode_schema(self._described), max_bytes, chunk_files)
        self._videos = {
            name: VideoFiles(folder / "videos" / name, self._fps, size, max_bytes, chunk_files)
            for name, feature in self._described.items()
            if size is not None and feature["dtype"] == "video"
        }
        self._waiting: list[dict[str, Any]] = []  # rows of meta/episodes
        self._tasks: dict[str, int] = {}
        self._total = TotalStatistics()
        self.num_episodes = self.num_frames = 0

    @property
    def num_tasks(self) -> int:
        """Different instructions of the episodes."""
        return len(self._tasks)

    def add(self, episode: Episode) -> None:
        """Writes an episode.

        Raises:
            EpisodeError: It has other features (``episodes_mixed``), or a picture cannot be decoded (``episode_invalid``).
            OSError: The folder cannot be written.
        """
        self._features.check_same(episode.features, episode.episode_id)
        task = self._tasks.setdefault(episode.instruction, len(self._tasks))
        arrays = frame_arrays(episode, self.num_episodes, self.num_frames, task)
        found = {name: array_statistics(values) for name, values in arrays.items()}
        found |= {PICTURE + camera: self._look(episode, camera) for camera in episode.pictures}
        table = frame_table(episode, arrays, self._frames.schema)
        chunk, file = self._frames.write(table)
        row: dict[str, Any] = {
            "episode_index": self.num_episodes,
            "tasks": [episode.instruction],
            "length": episode.num_steps,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.num_frames,
            "dataset_to_index": self.num_frames + episode.num_steps,
        }
        for name, video in self._videos.items():
            row |= {f"videos/{name}/{key}": value for key, value in video.end_episode().items()}
        row |= {f"stats/{name}/{key}": found[name][key].tolist() for name in self._described for key in NAMES}
        row |= {name: getattr(episode, name) for name in DETAILS}
        self._total.add({name: found[name] for name in self._described})
        self._waiting.append(row)
        self.num_episodes += 1
        self.num_frames += episode.num_steps
        if len(self._waiting) == _EPISODES_AT_ONCE:
            self._write_rows()

    def close(self) -> None:
        """Ends the files, and writes those about all episodes.

        Raises:
            ConfigError: A video could not be encoded.
            OSError: The folder cannot be written.
        """
        self._write_rows()
        self._frames.close()
        self._rows.close()
        for video in self._videos.values():
            video.close()
        meta, counts = self._folder / "meta", (self.num_episodes, self.num_frames, self.num_tasks)
        info = describe_dataset(self._described, self._features.robot, self._fps, counts, self._chunk_files)
        write_json(meta / "info.json", info)
        write_json(meta / "stats.json", self._total.as_json())
        write_tasks(meta / "tasks.parquet", self._tasks)
        (self._folder / "README.md").write_text(describe_in_words(self.num_episodes, self.num_frames), "utf-8")

    def discard(self) -> None:
        """Gives the dataset up: ends open files and the programs that write them."""
        for video in self._videos.values():
            video.discard()
        for files in (self._frames, self._rows):
            with suppress(OSError):
                files.close()

    def _look(self, episode: Episode, camera: str) -> Statistics:
        """Returns the statistics of the pictures of a camera, and writes them to its video if there is one."""
        sampled, found = set(sampled_frames(episode.num_steps)), PictureStatistics()
        video = self._videos.get(PICTURE + camera)
        for k in range(episode.num_steps):
            if video is None and k not in sampled:
                continue
            picture = episode.decoded_picture(camera, k)
            if k in sampled:
                found.add(picture)
            if video is not None:
                video.add(picture)
        return found.statistics()

    def _write_rows(self) -> None:
        """Writes the rows of the episodes that wait; each names its own file, so that place and size are found first."""
        if not self._waiting:
            return
        place = {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        schema = self._rows.schema
        table = pa.Table.from_pylist([row | place for row in self._waiting], schema)
        chunk, file = self._rows.start(table.nbytes)
        for name, value in zip(place, (chunk, file), strict=True):
            values = pa.array(np.full(table.num_rows, value, np.int64))
            table = table.set_column(schema.get_field_index(name), schema.field(name), values)
        self._rows.write(table)
        self._waiting.clear()
