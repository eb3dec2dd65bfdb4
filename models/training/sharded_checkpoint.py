"""Checkpoints of a training whose tensors are sharded: each process writes its own part, and any number of processes reads them.

A checkpoint is a numbered folder of safetensors files, in the form of ``torch.distributed.checkpoint``, and a JSON file with the
plain values. The highest number counts. A folder gets its number when all of its files are on the disk, and the one before is
deleted after that, so that a process may be killed at any time.
"""

import json
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch.distributed as dist
from safetensors import SafetensorError
from torch import Tensor
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader, HuggingFaceStorageWriter
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from models.training.distributed import ProcessContext
from stable_data.config_diff import flatten_config, refuse_changed
from stable_data.errors import ConfigError, StableDataError

T = TypeVar("T")

_VALUES = "training.json"
_NEW = ".new"  # the folder that is being written
_FILE_BYTES = 2 * 1024**3  # of a process's part in one file, since a file is built in memory
_UNREADABLE = (OSError, ValueError, LookupError, AttributeError, TypeError, RuntimeError, AssertionError, SafetensorError)


def save_sharded(
    folder: Path, tensors: Mapping[str, Tensor], values: Mapping[str, Any], about: Mapping[str, Any], place: ProcessContext
) -> None:
    """Writes a checkpoint atomically; all processes call it.

    Args:
        folder: The folder of the checkpoints, which all processes see.
        tensors: Tensors by name: in several processes DTensors, of which each process writes its part.
        values: Plain values for JSON; those of the first process are written.
        about: What determines the training: settings, and fingerprints of the training data.
        place: This process.

    Raises:
        ConfigError: A process could not write its part (``checkpoint_unwritten``); the checkpoint before it stays.
    """
    new = folder / _NEW
    of_first(place, lambda: _empty_folder(new))
    writer = HuggingFaceStorageWriter(
        str(new), fqn_to_index_mapping=_files_of(tensors, place.world_size), save_distributed=True
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a single process writes a part, which is the whole
            save(dict(tensors), storage_writer=writer, no_dist=place.world_size == 1)
    except (CheckpointException, *_UNREADABLE) as error:
        raise ConfigError(
            f"{folder}: the checkpoint could not be written ({_reason(error)}); the one before it stays, if there is one",
            "checkpoint_unwritten",
        ) from error
    own = {path.name: _flush_to_disk(path) for path in new.glob(f"shard-{place.rank + 1:05}-*")}
    parts = _on_first(own, place)  # arrives when every process has its files on the disk
    if place.rank == 0:
        files = {name: size for part in parts for name, size in part.items()}
        with (new / _VALUES).open("w", encoding="utf-8") as file:
            json.dump({"about": about, "values": values, "files": files}, file)
            file.flush()
            os.fsync(file.fileno())
        _flush_to_disk(new)
        before = _numbers(folder)
        new.replace(folder / f"{max(before, default=0) + 1:06}")
        _flush_to_disk(folder)
        for number in before:
            shutil.rmtree(folder / f"{number:06}", ignore_errors=True)


def read_values(
    folder: Path, about: Mapping[str, Any], place: ProcessContext, *needed: str
) -> tuple[Path, dict[str, Any]] | None:
    """Reads the plain values of the last checkpoint; all processes call it.

    Args:
        folder: The folder of the checkpoints.
        about: What determines the training that resumes.
        place: This process; the first one reads, and tells the others.
        needed: Required keys of the values.

    Returns:
        The folder of the checkpoint, for :func:`load_tensors`, and its values; None if there is no checkpoint.

    Raises:
        ConfigError: It cannot be read (``checkpoint_invalid``) or is from another training (``config_changed``).
    """

    def read() -> tuple[Path, dict[str, Any]] | None:
        if not folder.exists():
            return None
        try:
            number = max(_numbers(folder), default=None)
            if number is None:
                return None
            last = folder / f"{number:06}"
            found = json.loads((last / _VALUES).read_text("utf-8"))
            was, values, sizes = flatten_config(found["about"]), found["values"], found["files"]
            for name, size in sizes.items():
                if (last / name).stat().st_size != size:
                    raise ValueError(f"{name} has another size than when it was written")
            for key in needed:
                _ = values[key]
        except _UNREADABLE as error:
            raise _unreadable(folder, error) from error
        refuse_changed(str(last), was, about)
        return last, values

    return of_first(place, read)


def load_tensors(checkpoint: Path, tensors: Mapping[str, Tensor], place: ProcessContext) -> None:
    """Reads tensors of a checkpoint into given ones; all processes call it.

    Args:
        checkpoint: The folder that :func:`read_values` returned.
        tensors: Tensors by name, as for :func:`save_sharded`; each process reads its part. They are written to.
        place: This process.

    Raises:
        ConfigError: They cannot be read (``checkpoint_invalid``).
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a single process reads all parts
            reader = HuggingFaceStorageReader(str(checkpoint))
            load(dict(tensors), storage_reader=reader, no_dist=place.world_size == 1)
    except (CheckpointException, *_UNREADABLE) as error:
        raise _unreadable(checkpoint, error) from error


def of_first(place: ProcessContext, make: Callable[[], T]) -> T:
    """Returns what the first process makes to all processes, an error of this project included; all processes call it."""
    if place.world_size == 1:
        return make()
    found: list[Any] = [None]
    if place.rank == 0:
        try:
            found = [make()]
        except StableDataError as error:
            found = [error]
    dist.broadcast_object_list(found, src=0, device=place.device)
    if isinstance(found[0], StableDataError):
        raise found[0]
    made: T = found[0]
    return made


def _on_first(value: T, place: ProcessContext) -> list[T]:
    """The values of all processes on the first one, and nothing on the others."""
    if place.world_size == 1:
        return [value]
    found: list[Any] | None = [None] * place.world_size if place.rank == 0 else None
    dist.gather_object(value, found)
    return found or []


def _empty_folder(folder: Path) -> None:
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(f"{folder}: the checkpoint could not be written ({error})", "checkpoint_unwritten") from error


def _files_of(tensors: Mapping[str, Tensor], world_size: int) -> dict[str, int]:
    """The number of each tensor's file among those of a process, from 1 on; it is the same in all processes."""
    files: dict[str, int] = {}
    file, room = 1, _FILE_BYTES
    for name, value in tensors.items():
        size = value.numel() * value.element_size() // world_size
        if size > room and room < _FILE_BYTES:
            file, room = file + 1, _FILE_BYTES
        room -= size
        files[name] = file
    return files


def _numbers(folder: Path) -> list[int]:
    """The numbers of the checkpoints in a folder.

    Raises:
        ValueError: The folder has something else.
    """
    found = [path.name for path in folder.iterdir() if not path.name.startswith(".")]
    if other := [name for name in found if not name.isdecimal()]:
        raise ValueError(f"it has {other[0]}, which is not a checkpoint")
    return [int(name) for name in found]


def _flush_to_disk(path: Path) -> int:
    """Makes a file or the names in a folder outlast a power cut; returns the size."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
        return os.fstat(handle).st_size
    finally:
        os.close(handle)


def _unreadable(folder: Path, error: BaseException) -> ConfigError:
    return ConfigError(
        f"{folder}: cannot be read as a checkpoint ({_reason(error)}); remove it to start again", "checkpoint_invalid"
    )


def _reason(error: BaseException) -> str:
    """One line on an error; torch wraps those of all processes into one."""
    if isinstance(error, CheckpointException) and error.failures:
        error = next(iter(error.failures.values()))[0]
    return f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"
