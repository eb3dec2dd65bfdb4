"""What the trainings share: how they are run and resumed, their manifest, log and checkpoints, and how they are stopped."""

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
from pipelines.execution.resume import read_manifest
from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder

STATE = "checkpoint/state.pt"
"""The checkpoint in a training's folder."""

_COSTLY = 20  # a checkpoint is kept no more often than this many times what keeping it takes


@dataclass(frozen=True)
class TrainingJob(ABC):
    """A training of a network on the tables of a run; it is sent to the workers.

    Attributes:
        data: Folder of a preprocess run, or its URI.
        out: Folder of the training.
        NAME: The job's name in the manifest.
        WEIGHTS: Where the weights are, in the folder of the training.
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

    def check_workers(self, workers: int) -> None:  # noqa: B027 - not every training has such limits
        """Refuses what cannot be trained by a number of processes, before anything takes long.

        Raises:
            ConfigError: It cannot.
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
        self.check_workers(workers)
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
                run_on_ray(job, workers, address)
            else:
                job.work(ProcessContext(training_device()), data)
            return job.finish(folder, manifest)

    def result_line(self, folder: RunFolder, steps: str, used: str, counts: Mapping[str, int], *notes: str) -> str:
        """The line that a training ends with.

        Args:
            folder: The training's folder.
            steps: How many steps of how many were done.
            used: What it was trained on.
            counts: Counts of the data; keys ``left_out_*`` name what was left out.
            notes: Further parts of the line; empty ones are skipped.
        """
        left_out = {k.removeprefix("left_out_"): v for k, v in counts.items() if k.startswith("left_out_") and v}
        reasons = ", ".join(f"{reason} {count}" for reason, count in left_out.items())
        without = f", {sum(left_out.values())} left out ({reasons})" if left_out else ""
        return "; ".join(part for part in (f"{folder.uri}: {steps} steps on {used}{without}", *notes) if part)

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
        return self.data if "://" in self.data else str(Path(self.data).expanduser().resolve())


class MonitoredTraining(Protocol):
    """A training as a monitor sees it."""

    step: int
    place: ProcessContext

    def save(self, path: Path) -> None:
        """Writes a checkpoint."""
        ...


class TrainingMonitor:
    """Progress bar, log, checkpoints and the end of one process's part of a training. Used in a ``with`` statement.

    Bar and log are the first process's.

    Args:
        training: The training, resumed.
        steps: Length of the run.
        out: Its folder.
        minutes: After which it is to stop; 0 is no limit.
        log_every: Steps between the losses that are logged, each a mean over them.
        save_minutes: Between checkpoints.

    Attributes:
        is_first: Whether this process writes the files.
    """

    def __init__(
        self, training: MonitoredTraining, steps: int, out: Path, minutes: float, log_every: int, save_minutes: float
    ) -> None:
        self._training, self._out, self._log_every = training, out, log_every
        self._seconds, self._save_seconds = 60 * minutes, 60 * save_minutes
        self.is_first = training.place.rank == 0
        self._began = self._saved = time.monotonic()
        self._save_took = 0.0
        self._sums: dict[str, float] = {}
        self._stopped = threading.Event()
        self._log = _event_log(out / "logs", training.step) if self.is_first else None
        self._bar = tqdm(total=steps, initial=training.step, desc="train", unit="step", disable=not self.is_first)

    def __enter__(self) -> Self:
        """Takes signals over, so that they end the run after its step."""
        self._former_handlers = _on_signals(self._stopped)
        return self

    def __exit__(self, *_: object) -> None:
        """Gives the signals back and closes bar and log."""
        for number, handler in self._former_handlers.items():
            signal.signal(number, handler)
        self._bar.close()
        if self._log is not None:
            self._log.close()

    def wants_stop(self) -> bool:
        """Whether a signal came or the time is over."""
        is_late = self._seconds > 0 and time.monotonic() - self._began > self._seconds
        return is_late or self._stopped.is_set()

    def wants_save(self) -> bool:
        """Whether it is time for a checkpoint; only the first process decides."""
        pause = max(self._save_seconds, _COSTLY * self._save_took)
        return self.is_first and time.monotonic() - self._saved > pause

    def count(self, losses: Mapping[str, float], **others: float) -> None:
        """Counts a step.

        Args:
            losses: By name; their means over some steps are logged.
            others: Figures of the step; the last ones are logged.
        """
        self._bar.update(1)
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value / self._log_every
        if self._training.step % self._log_every == 0:
            self._bar.set_postfix({name: f"{value:.3f}" for name, value in self._sums.items()}, refresh=False)
            self.log({f"loss/{name}": value for name, value in self._sums.items()} | others)
            self._sums = {}

    def log(self, figures: Mapping[str, float]) -> None:
        """Logs figures of the training as it is."""
        if self._log is not None:
            for name, value in figures.items():
                self._log.add_scalar(name, value, self._training.step)

    def save(self) -> None:
        """Writes the checkpoint."""
        began = time.monotonic()
        self._training.save(self._out / STATE)
        self._saved = time.monotonic()
        self._save_took = self._saved - began


def _event_log(folder: Path, step: int) -> Any:
    """A writer of TensorBoard's files; what an earlier process logged of later steps is hidden."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step + 1, flush_secs=20)


def _on_signals(stopped: threading.Event) -> dict[int, Any]:
    """Lets an interrupt or termination end the run after its step; gives the former handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}  # a worker of Ray: its driver passes the end on

    def stop(number: int, frame: object) -> None:
        stopped.set()

    return {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}


def training_device() -> torch.device:
    """The device of a training in this process."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def refuse_changes(folder: RunFolder, manifest: dict[str, Any], compared: Sequence[str]) -> None:
    """Refuses to go on with a training of other settings, data or version.

    Args:
        folder: The training's folder.
        manifest: Of the training that is to start. Other sources of the same version are not refused, but said, and put into
            its ``code_versions``, see :func:`pipelines.execution.code_history.record_code`.
        compared: Keys of it that must be as they were, beside ``settings``.

    Raises:
        ConfigError: Something differs, or the manifest there is none.
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
    """A document as the text of a file."""
    return (json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode()
