"""Trains a policy on demonstrations in this process.

OUT/weights/policy.safetensors               the weights, with what the policy observes and commands
OUT/checkpoint/state.pt                      the checkpoint from which a stopped run continues
OUT/curve.csv, OUT/report/index.html         losses, and errors in held-out scenes
OUT/logs/events.out.tfevents.*               the same, for TensorBoard
OUT/manifest.json                            settings and fingerprint of the demonstrations
"""

import csv
import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from models.policy.pictures import seen_features
from models.policy.task_frame import check_clonable
from models.policy.training import PolicyTrainer, PolicyTrainingSettings, split_episodes
from models.policy.weights import FILE, PolicyWeights, load_policy, save_policy
from models.training.distributed import ProcessContext
from pipelines.reports.html import page, table, tiles
from pipelines.train.run import STATE, TrainingJob, TrainingMonitor, json_bytes, result_line
from stable_data.code_version import code_version
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.robot.episodes import Episode, read_episodes
from stable_data.storage.run_folder import RunFolder, absolute_uri

COLUMNS = ("step", "loss", "move_mm", "turn_deg", "opening_mm", "key_mm", "key_deg")
"""Columns of the curve."""

_Demonstrations = tuple[list[Episode], list[Episode]]


@dataclass(frozen=True)
class PolicyTrainingJob(TrainingJob):
    """The training of a policy; ``data`` is a run with the table ``episodes``.

    Attributes:
        also: Further runs.
        where: A condition on ``episodes``; empty: all of them.
        settings: The settings that shape the weights.
        minutes: Time after which it stops and saves its checkpoint; 0 is no limit.
        log_every: Steps between log entries.
        note_every: Steps between rows of the curve.
        save_minutes: Minutes between checkpoints.
    """

    NAME = "train_policy"
    WEIGHTS = FILE
    COMPARED = ("episodes", "where")

    also: tuple[str, ...] = ()
    where: str = ""
    settings: PolicyTrainingSettings = field(default_factory=PolicyTrainingSettings)
    minutes: float = 0.0
    log_every: int = 50
    note_every: int = 250
    save_minutes: float = 1.0

    def check_start(self, workers: int) -> None:
        """Refuses several processes; see the base class."""
        if workers:
            raise ConfigError(f"workers is {workers}, expected 0: a policy is trained in one process", "config_invalid")

    def prepare(self) -> tuple["PolicyTrainingJob", dict[str, Any], _Demonstrations]:
        """Reads the demonstrations; see the base class."""
        runs = [absolute_uri(run) for run in (self.data, *self.also)]
        episodes = list(read_episodes(runs, where=self.where or None, with_pictures=bool(self.settings.network.cameras)))
        train, held, left_out = split_episodes(episodes, self.settings)
        for episode in (*train, *held):
            train[0].features.check_same(episode.features, episode.episode_id)
        check_clonable(train[0].features, self.settings.network.cameras)
        details = {
            "data": runs,
            "where": self.where,
            "episodes": content_id(sorted(_identity(e, self.settings.network.cameras) for e in (*train, *held))),
            "settings": asdict(self.settings),
            "num_episodes": len(train),
            "num_scenes": len({e.scene_id for e in train}),
            "num_held_out": len(held),
            **left_out,
        }
        return self, details, (train, held)

    def work(self, place: ProcessContext, data: _Demonstrations | None = None) -> None:
        """Trains, or continues."""
        train, held = data or self.prepare()[2]
        settings, out = self.settings, self.folder
        about = {
            "settings": asdict(settings),
            "episodes": sorted(_identity(e, settings.network.cameras) for e in (*train, *held)),
        }
        training = PolicyTrainer(train, held, settings, about, place)
        training.resume(out / STATE)
        with TrainingMonitor(training, settings.steps, out, self.minutes, self.log_every, self.save_minutes) as monitor:
            while training.step < settings.steps and not monitor.wants_stop():
                losses = training.train_step()
                monitor.count(losses, learning_rate=settings.rate_at(training.step - 1))
                if training.step % self.note_every == 0 or training.step == settings.steps:
                    row = training.note()
                    monitor.log({f"held_out/{name}": row[name] for name in COLUMNS[2:]})
                if monitor.wants_save():
                    monitor.save()
            monitor.save()
        notes = {
            "steps": str(training.step),
            "episodes": str(len(train)),
            "task_kinds": json.dumps(sorted({e.task_kind for e in train})),
            "training": json.dumps(asdict(settings), sort_keys=True),
            "code_version": code_version(),
        }
        assets = _assets(train)
        features = seen_features(train[0].features, settings.network.cameras)
        weights = PolicyWeights(training.averaged(), settings.network, features, settings.execute, assets, notes)
        save_policy(out / self.WEIGHTS, weights)
        (out / "curve.csv").write_text(_curve_text(training.curve), "utf-8", newline="")

    def finish(self, folder: RunFolder, manifest: dict[str, Any]) -> str:
        """Closes the manifest, writes the report, and returns one line on what was done."""
        weights = load_policy(Path(folder.root) / self.WEIGHTS)
        step = int(weights.notes["steps"])
        is_done = step >= self.settings.steps
        closed = manifest | {"status": "complete" if is_done else "stopped", "steps_done": step}
        closed["num_assets"] = None if weights.assets is None else len(weights.assets)
        folder.write_bytes("manifest.json", json_bytes(closed))
        curve = list(csv.DictReader(io.StringIO((Path(folder.root) / "curve.csv").read_text("utf-8"))))
        folder.write_bytes("report/index.html", _report(folder.uri, closed, curve))
        used = f"{manifest['num_episodes']} demonstrations of {manifest['num_scenes']} scenes"
        errors = f"in held-out scenes {_errors(curve[-1])}" if curve and manifest["num_held_out"] else ""
        rest = "" if is_done else "run again to continue"
        return result_line(folder, f"{step} of {self.settings.steps}", used, manifest, errors, self.WEIGHTS, rest)


def _identity(episode: Episode, cameras: Sequence[str]) -> str:
    content = hashlib.sha256()
    for picture in (picture for name in cameras for picture in episode.pictures.get(name, ())):
        content.update(picture)
    for values in (episode.states, episode.environment_states, episode.actions):
        content.update(values.tobytes())
    return f"{episode.episode_id} {episode.seed} {content.hexdigest()[:16]}"


def _assets(episodes: Sequence[Episode]) -> frozenset[str] | None:
    """The assets that the episodes act on; None if one of them does not say."""
    found = [episode.subject_assets for episode in episodes]
    if any(assets is None for assets in found):
        return None
    return frozenset(name for assets in found for name in assets or () if name)


def _curve_text(curve: Sequence[dict[str, float]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in curve:
        writer.writerow({name: "" if math.isnan(value) else f"{value:g}" for name, value in row.items()})
    return text.getvalue()


def _errors(row: dict[str, str]) -> str:
    return f"the first action is off by {row['move_mm']} mm, {row['turn_deg']} degrees, opening {row['opening_mm']} mm"


def _report(name: str, manifest: dict[str, Any], curve: Sequence[dict[str, str]]) -> bytes:
    figures = [
        (str(manifest["num_episodes"]), "demonstrations"),
        (str(manifest["num_scenes"]), "scenes"),
        (str(manifest["num_held_out"]), "demonstrations of held-out scenes"),
        (f"{manifest['steps_done']} / {manifest['settings']['steps']}", "steps"),
    ]
    left_out = [[key.removeprefix("left_out_"), str(n)] for key, n in manifest.items() if key.startswith("left_out_")]
    body = [
        f"<h1>{Path(name).name}</h1>",
        tiles(figures),
        "<h2>Training</h2>",
        '<p class="note">Loss: mean since the row before. Errors: of the first action, in held-out scenes.</p>',
        table(COLUMNS, [[row[column] for column in COLUMNS] for row in curve]),
        "<h2>Left out</h2>",
        table(["reason", "episodes"], left_out),
    ]
    return page(f"{Path(name).name}: train-policy", body)
