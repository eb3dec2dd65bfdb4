"""Trains the instruction reader in this process.

OUT/weights/instruction_reader.safetensors   the weights, with the settings of their training
OUT/checkpoint/state.pt                      the checkpoint from which a stopped run continues
OUT/logs/events.out.tfevents.*               losses, for TensorBoard
OUT/manifest.json                            settings and fingerprints of frames, nouns and encoder
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from models.instruction_reader.frames import FOLDER, read_frames
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.training import ReaderTrainer, ReaderTrainingSettings, split_frames
from models.instruction_reader.weights import ReaderModel, figures_note, load_reader, new_reader, save_reader
from models.training.distributed import ProcessContext
from models.training.weights_file import read_notes
from pipelines.train.run import STATE, TrainingJob, TrainingMonitor, json_bytes, result_line
from stable_data.code_version import code_version
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder


@dataclass(frozen=True)
class ReaderTrainingJob(TrainingJob):
    """The training of the instruction reader; ``data`` is a folder of frames, or empty for those of the package.

    Attributes:
        settings: The settings that shape the weights.
        minutes: Time after which it stops and saves its checkpoint; 0 is no limit.
        log_every: Steps between log entries.
        validate_every: Steps between losses of held-out frames.
        save_minutes: Minutes between checkpoints.
    """

    NAME = "train_reader"
    WEIGHTS = "weights/instruction_reader.safetensors"
    COMPARED = ("frames", "nouns", "encoder")

    settings: ReaderTrainingSettings = field(default_factory=ReaderTrainingSettings)
    minutes: float = 0.0
    log_every: int = 20
    validate_every: int = 1000
    save_minutes: float = 5.0

    def check_start(self, workers: int) -> None:
        """Refuses several processes; see the base class."""
        if workers:
            raise ConfigError(f"workers is {workers}, expected 0: a reader is trained in one process", "config_invalid")

    def prepare(self) -> tuple["ReaderTrainingJob", dict[str, Any], tuple[ReaderModel, dict[str, str]]]:
        """Reads frames and nouns; see the base class."""
        frames = self._frames()
        initial = self.settings.initial
        model = load_reader(Path(initial).expanduser(), trains=True) if initial else new_reader(self.settings.seed)
        identity = {
            "frames": content_id([asdict(frame) for frame in frames]),
            "nouns": content_id(asdict(read_nouns())),
            "encoder": model.encoder,
            "initial": content_id(model.notes.get("steps", ""), model.notes.get("frames", "")) if initial else "",
        }
        train, held = split_frames(frames)
        details = {**identity, "settings": asdict(self.settings), "num_frames": len(train), "num_held_out": len(held)}
        return self, details, (model, identity)

    def work(self, place: ProcessContext, data: tuple[ReaderModel, dict[str, str]] | None = None) -> None:
        """Trains, or continues."""
        model, identity = data or self.prepare()[2]
        frames, settings = self._frames(), self.settings
        training = ReaderTrainer(model.network, model.tokens, frames, read_nouns(), settings, identity, place)
        out = self.folder
        training.resume(out / STATE)
        with TrainingMonitor(training, settings.steps, out, self.minutes, self.log_every, self.save_minutes) as monitor:
            while training.step < settings.steps and not monitor.wants_stop():
                losses = training.train_step()
                monitor.count(losses, learning_rate=settings.rate_at(training.step - 1))
                if training.step % self.validate_every == 0:
                    monitor.log({f"held_out/{name}": value for name, value in training.validate().items()})
                if monitor.wants_save():
                    monitor.save()
            monitor.save()
            notes = {
                "steps": str(training.step),
                "settings": json.dumps(asdict(settings), sort_keys=True),
                "held_out": figures_note(training.validate()),
                "code_version": code_version(),
                "frames": identity["frames"],
                "nouns": identity["nouns"],
            }
            save_reader(out / self.WEIGHTS, model, notes)

    def _frames(self) -> list[Any]:
        return list(read_frames(Path(self.data).expanduser() if self.data else FOLDER))

    def finish(self, folder: RunFolder, manifest: dict[str, Any]) -> str:
        """Closes the manifest and returns one line on what was done."""
        notes = read_notes(Path(folder.root) / self.WEIGHTS)
        step = int(notes["steps"])
        is_done = step >= self.settings.steps
        closed = manifest | {"status": "complete" if is_done else "stopped", "steps_done": step}
        folder.write_bytes("manifest.json", json_bytes(closed))
        steps, used = f"{step} of {self.settings.steps}", f"sentences of {manifest['num_frames']} frames"
        rest = "" if is_done else "run again to continue"
        held = ", ".join(f"{name} {value:.3f}" for name, value in json.loads(notes["held_out"]).items())
        return result_line(folder, steps, used, {}, f"losses of held-out frames {held}", self.WEIGHTS, rest)
