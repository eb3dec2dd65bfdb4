"""The parts that both trainings share: run and resume, manifest, log, checkpoints and signals."""

import json
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import torch
from tqdm import tqdm

from models.training.distributed import ProcessContext
from pipelines.execution.code_history import record_code, take_over_code, with_release
from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.errors import ConfigError
from stable_data.storage.manifest import read_manifest
from stable_data.storage.run_folder import RunFolder, absolute_uri

STATE = "checkpoint/state.pt"
"""The checkpoint in a training's folder, of a training whose processes all hold the whole network."""

_MIN_PAUSE = 20  # shortest time between checkpoints, in units of the time of saving one


@dataclass(frozen=True)
class TrainingJob(ABC):
    """A training of a network on the tables of a run; it is sent to the workers.

    Attributes:
        data: Folder of a preprocess run, or its URI.
        out: Folder of the training.
        NAME: The job's name in the manifest.
        WEIGHTS: The path of the weights in the folder of the training.
        COMPARED: Keys of the manifest, beside the settings, that must not change between a stop and a resume.
    """

    NAME: ClassVar[str]
    WEIGHTS: ClassVar[str]
    COMPARED: ClassVar[tuple[str, ...]]

    data: str
    out: Path

    @abstractmethod
    def prepare(self) -> tuple[Self, dict[str, Any], Any]:
        """Reads the data.

        Returns:
            The job with its settings resolved; what the manifest states of data and settings; and the data for :meth:`work`,
            or None if each process reads its own.

        Raises:
            ConfigError: The data cannot be used.
        """

    @abstractmethod
    def work(self, place: ProcessContext, data: Any = None) -> None:
        """Trains, or continues; the part of one process."""

    @abstractmethod
    def finish(self, folder: RunFolder, manifest: dict[str, Any]) -> str:
        """Closes the manifest and returns one line on what was done."""

    def check_start(self, workers: int) -> None:  # noqa: B027 - not every training has such limits
        """Makes quick checks before the data is read.

        Raises:
            ConfigError: The training cannot run with this number of processes.
        """

    def run(self, workers: int = 0, address: str | None = None) -> str:
        """Trains, or continues.

        Args:
            workers: Processes of Ray Train; 0 trains in this process.
            address: An existing Ray cluster; None starts a local one.

        Returns:
            One line on what was done.

        Raises:
            ConfigError: The run cannot start or continue; the checkpoint stays.
        """
        self.check_start(workers)
        folder = RunFolder(str(self.folder))
        with folder.locked():
            job, details, data = self.prepare()
            version = {"code_version": code_version(), "code_versions": [code_version()]}
            command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
            manifest = {"job": self.NAME, "status": "running", **version, "command": command, **details}
            refuse_changes(folder, manifest, ("job", "code_version", *self.COMPARED))
            folder.write_bytes("manifest.json", json_bytes(manifest))
            if workers:
                from pipelines.train.ray_train import run_on_ray  # Ray Train takes seconds to import

                del data  # each process reads its own
                run_on_ray(job.work, job.out, workers, address)
            else:
                job.work(ProcessContext(training_device()), data)
            return job.finish(folder, manifest)

    @property
    def folder(self) -> Path:
        """The training's folder, absolute.

        Raises:
            ConfigError: It is not local (``output_invalid``).
        """
        if "://" in str(self.out):
            raise ConfigError(f"--out is {self.out}, expected a local folder", "output_invalid")
        return self.out.expanduser().resolve()

    @property
    def data_uri(self) -> str:
        """The run, as an absolute path or a URI."""
        return absolute_uri(self.data)


def result_line(folder: RunFolder, steps: str, used: str, counts: Mapping[str, int], *notes: str) -> str:
    """The line that a training ends with.

    Args:
        folder: The training's folder.
        steps: The number of finished steps and of all steps.
        used: The number and name of the training items.
        counts: Counts of the data; a key ``left_out_REASON`` counts items that were not used.
        notes: Further parts of the line; empty ones are skipped.
    """
    left_out = {k.removeprefix("left_out_"): v for k, v in counts.items() if k.startswith("left_out_") and v}
    reasons = ", ".join(f"{reason} {count}" for reason, count in left_out.items())
    without = f", {sum(left_out.values())} left out ({reasons})" if left_out else ""
    return "; ".join(part for part in (f"{folder.uri}: {steps} steps on {used}{without}", *notes) if part)


class MonitoredTraining(Protocol):
    """The part of a training that a monitor uses."""

    step: int
    place: ProcessContext

    def save(self, path: Path) -> None:
        """Writes a checkpoint."""
        ...


class TrainingMonitor:
    """Progress bar, log, checkpoints and stop conditions of one process of a training. Used in a ``with`` statement.

    Only the first process has a bar and a log.

    Args:
        training: The training, already resumed.
        steps: Number of steps of the run.
        out: Its folder.
        minutes: Time limit; 0 is no limit.
        log_every: Steps between log entries; a logged loss is the mean over them.
        save_minutes: Minutes between checkpoints.
        state: Path of the checkpoint in the folder.

    Attributes:
        is_first: Whether this process writes the files.
    """

    def __init__(
        self,
        training: MonitoredTraining,
        steps: int,
        out: Path,
        minutes: float,
        log_every: int,
        save_minutes: float,
        *,
        state: str = STATE,
    ) -> None:
        self._training, self._state, self._log_every = training, out / state, log_every
        self._seconds, self._save_seconds = 60 * minutes, 60 * save_minutes
        self.is_first = training.place.rank == 0
        self._began = self._saved = time.monotonic()
        self._save_took = 0.0
        self._sums: dict[str, float] = {}
        self._stopped = threading.Event()
        self._log = _event_log(out / "logs", training.step) if self.is_first else None
        self._bar = tqdm(total=steps, initial=training.step, desc="train", unit="step", disable=not self.is_first)

    def __enter__(self) -> Self:
        """Installs signal handlers that end the run after the current step."""
        self._former_handlers = _on_signals(self._stopped)
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the signal handlers and closes bar and log."""
        for number, handler in self._former_handlers.items():
            signal.signal(number, handler)
        self._bar.close()
        if self._log is not None:
            self._log.close()

    def wants_stop(self) -> bool:
        """Whether a signal has arrived or the time limit is reached."""
        is_late = self._seconds > 0 and time.monotonic() - self._began > self._seconds
        return is_late or self._stopped.is_set()

    def wants_save(self) -> bool:
        """Whether it is time for a checkpoint; only the first process decides."""
        pause = max(self._save_seconds, _MIN_PAUSE * self._save_took)
        return self.is_first and time.monotonic() - self._saved > pause

    def count(self, losses: Mapping[str, float], **others: float) -> None:
        """Counts a step.

        Args:
            losses: Losses by name; their means over ``log_every`` steps are logged.
            others: Further figures of the step; the latest ones are logged.
        """
        self._bar.update(1)
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value / self._log_every
        if self._training.step % self._log_every == 0:
            self._bar.set_postfix({name: f"{value:.3f}" for name, value in self._sums.items()}, refresh=False)
            self.log({f"loss/{name}": value for name, value in self._sums.items()} | others)
            self._sums = {}

    def log(self, figures: Mapping[str, float]) -> None:
        """Logs figures at the current step."""
        if self._log is not None:
            for name, value in figures.items():
                self._log.add_scalar(name, value, self._training.step)

    def save(self) -> None:
        """Writes the checkpoint."""
        began = time.monotonic()
        self._training.save(self._state)
        self._saved = time.monotonic()
        self._save_took = self._saved - began


def _event_log(folder: Path, step: int) -> Any:
    """A writer of TensorBoard files; entries of an earlier process for later steps are hidden."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step + 1, flush_secs=20)


def _on_signals(stopped: threading.Event) -> dict[int, Any]:
    """Makes SIGINT and SIGTERM end the run after the current step; returns the former handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}  # in a worker of Ray, the driver handles signals

    def stop(number: int, frame: object) -> None:
        stopped.set()

    return {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}


def training_device() -> torch.device:
    """The device of a training in this process."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def refuse_changes(folder: RunFolder, manifest: dict[str, Any], compared: Sequence[str]) -> None:
    """Refuses to continue a training with other settings, data or another version.

    Args:
        folder: The training's folder.
        manifest: The manifest of this training. Changed source code of the same version is not refused but recorded, see
            :func:`pipelines.execution.code_history.record_code`.
        compared: Keys of the manifest that must not differ, beside ``settings``.

    Raises:
        ConfigError: A value differs, or the file in the folder is not a manifest.
    """
    was = read_manifest(folder)
    if was is None:
        return
    before, now = ({key: with_release(found).get(key) for key in compared} for found in (was, manifest))
    refuse_changed(folder.uri, before | was["settings"], now | manifest["settings"])
    take_over_code(was, manifest)
    if was.get("status") != "complete":
        record_code(folder.uri, manifest)


def json_bytes(document: dict[str, Any]) -> bytes:
    """A document as JSON bytes for a file."""
    return (json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode()
