"""Trains networks that move objects, on the clean scenes of runs: what the trainings of corrector and rearrangers share.

OUT/weights/NAME.safetensors                the averaged weights, with the settings of their training
OUT/weights/point_encoder.safetensors       the encoder of its point features, if it reads any
OUT/checkpoint/state.pt                     the checkpoint from which a stopped run continues
OUT/logs/events.out.tfevents.*              losses and validation cards, for TensorBoard
OUT/card.json                               the validation card of the weights
OUT/manifest.json                           settings, data and encoder
OUT/cache/                                  data computed from the run's tables; may be deleted
"""

import json
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from models.physics_corrector.flow.flow_matching import Mover
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.physics_corrector.flow.velocity_network import VelocityNetwork
from models.physics_corrector.learned_flow import NONE
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.layout_settings import LayoutTrainingSettings
from models.physics_corrector.training.layout_trainer import LayoutTrainer, train
from models.physics_corrector.training.sources import TrainingScenes
from models.physics_corrector.training.validation import (
    PROPOSED,
    ROWS,
    Card,
    ValidationScenes,
    scalar_figures,
    validation_card,
)
from models.text_encoder import load_default as load_text_encoder
from models.training.distributed import ProcessContext
from models.training.weights_file import read_notes
from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.features import AUTO
from pipelines.train.point_encoder import encoder_of_features, save_beside
from pipelines.train.run import STATE, TrainingJob, TrainingMonitor, json_bytes, result_line
from stable_data.code_version import code_version
from stable_data.content_id import content_id
from stable_data.storage.run_folder import RunFolder, absolute_uri

C = TypeVar("C", bound=LayoutTrainingSettings)
T = TypeVar("T", bound=LayoutTrainer)


@dataclass(frozen=True, slots=True)
class LayoutMonitoring:
    """Logging and validation of a training; these settings do not shape the weights.

    Attributes:
        log_every: Steps between log entries; a logged loss is the mean over them.
        card_every: Steps between validation cards.
        card_scenes: Held-out scenes of these cards, which have no exact figures.
        final_scenes: Held-out scenes of the final card.
        exact_scenes: Scenes of the final card that are also judged exactly.
        save_minutes: Minutes between checkpoints.
    """

    log_every: int = 20
    card_every: int = 1000
    card_scenes: int = 32
    final_scenes: int = 128
    exact_scenes: int = 32
    save_minutes: float = 5.0


@dataclass(frozen=True)
class LayoutTrainingJob(TrainingJob, Generic[C, T]):
    """A training on the clean scenes of runs.

    Attributes:
        data: Folder of a preprocess run, or its URI.
        also: Further ones.
        proposals: Folders of generate runs, or their URIs, with proposals on assets of these runs.
        settings: The settings that shape the weights.
        watch: Logging and validation.
        minutes: Time after which it stops and saves its checkpoint; 0 is no limit.
        encoder: The encoder of the run's features, as in ``preprocess.features``; ``auto`` finds it.
        repairers: The workers that repair targets.
        FAST_ROWS: Rows of the validation cards during the training.
        FINAL_ROWS: Rows of the last one.
    """

    COMPARED = ("data_fingerprint", "encoder_fingerprint", "text_encoder_fingerprint")
    FAST_ROWS: ClassVar[tuple[str, ...]] = ("small", "jitter", "pile")
    FINAL_ROWS: ClassVar[tuple[str, ...]] = ROWS

    settings: C
    watch: LayoutMonitoring = LayoutMonitoring()
    minutes: float = 0.0
    encoder: str = AUTO
    also: tuple[str, ...] = ()
    proposals: tuple[str, ...] = ()
    repairers: WorkerPool = field(default_factory=WorkerPool)

    @abstractmethod
    def _trainer(self, data: TrainingSet, place: ProcessContext) -> T:
        """Begins the training."""

    @abstractmethod
    def _mover(self, training: T) -> Mover:
        """Returns what moves objects by the averaged weights, as at inference."""

    @abstractmethod
    def _write_weights(self, path: Path, training: T, notes: Mapping[str, str]) -> None:
        """Writes the averaged weights with notes."""

    def source(self) -> TrainingScenes:
        """The source of the training scenes, in which targets are repaired if the settings want it."""
        uris = self._uris()
        if self.settings.targets == "repair":
            uris = tuple(str(self._repaired(uri)) for uri in uris)
        return self._source(uris)

    def _uris(self) -> tuple[str, ...]:
        return tuple(map(absolute_uri, (self.data, *self.also)))

    def _source(self, uris: tuple[str, ...]) -> TrainingScenes:
        proposals = tuple(map(absolute_uri, self.proposals))
        return TrainingScenes(
            uris, self.folder / "cache", self.settings.num_surface, self.settings.num_bottom, proposals=proposals
        )

    def _repaired(self, uri: str) -> Path:
        """The folder of the corrected scenes of a run."""
        return self.folder / "cache" / f"repaired-{content_id(uri)}"

    def _repair_targets(self) -> None:
        """Corrects the scenes of all runs, or the missing ones; those that are clean stay as they are."""
        if self.settings.targets != "repair":
            return
        raw = self._source(self._uris())  # refuses what cannot be used before anything takes time
        raw.fingerprint(), raw.store()
        for uri in self._uris():
            # Without a flow: targets must not depend on earlier weights.
            settings = CorrectSettings(weights=NONE, judge_raw=False, num_pictures=0)
            correct(uri, str(self._repaired(uri)), settings, self.repairers, report=False)

    def _num_not_repaired(self) -> int:
        """Number of scenes that could not be made clean."""
        return self._source(self._uris()).num_scenes() - self.source().num_scenes()

    def _data(self) -> TrainingSet:
        """Reads the scenes with what the network reads of them."""
        settings = self.settings
        return self.source().load(settings.features, load_text_encoder() if settings.network.num_texts else None)

    def describe(self) -> dict[str, Any]:
        """Describes what a run would do, for ``--dry-run``; no table is read whole."""
        source = self._source(self._uris())
        # What is read of repaired scenes is not known before the repair.
        known = {"data_fingerprint": source.fingerprint()} if self.settings.targets == "clean" else {}
        network = VelocityNetwork(self.settings.resolved(1).network, PoseCoordinates())
        return {
            "settings": asdict(self.settings),
            **known,
            "num_scenes": source.num_scenes(),
            "num_parameters": sum(p.numel() for p in network.parameters()),
        }

    def prepare(self) -> tuple[Self, dict[str, Any], TrainingSet]:
        """Reads the scenes; see the base class."""
        self._repair_targets()
        data = self._data()
        if data.encoder:
            save_beside(encoder_of_features(self.data_uri, data.encoder, self.encoder), self.folder / self.WEIGHTS)
        job = replace(self, settings=self.settings.resolved(len(data.of_split(0))), out=self.folder)
        details = {
            "data_fingerprint": data.fingerprint,
            "encoder_fingerprint": data.encoder,
            "text_encoder_fingerprint": data.text_encoder,
            "targets": {**data.counts, "left_out_not_repaired": self._num_not_repaired()},
            "num_train": len(data.of_split(0)),
            "num_validation": len(data.of_split(1)),
            "num_proposals": len(data.proposals_of_split(0)),
            "settings": asdict(job.settings),
        }
        return job, details, data

    def work(self, place: ProcessContext, data: TrainingSet | None = None) -> None:
        """Trains, or continues; the part of one process."""
        source = self.source()
        data = self._data() if data is None else data
        training = self._trainer(data, place)
        training.resume(self.out / STATE)
        watch, settings = self.watch, self.settings
        with TrainingMonitor(training, settings.steps, self.out, self.minutes, watch.log_every, watch.save_minutes) as monitor:

            def after(_: T, figures: dict[str, float]) -> None:
                monitor.count(figures, learning_rate=settings.learning_rate_at(training.step - 1))
                if monitor.is_first and training.step % watch.card_every == 0 and training.step < settings.steps:
                    monitor.log(_scalars(self._card(training, data, source, watch.card_scenes, 0, self.FAST_ROWS)))
                if monitor.wants_save():
                    monitor.save()

            is_done = train(training, wants_stop=monitor.wants_stop, after=after)
            if not monitor.is_first:
                return
            monitor.save()
            self._save_weights(training, data)
            if is_done:
                card = self._card(training, data, source, watch.final_scenes, watch.exact_scenes, self.FINAL_ROWS)
                monitor.log(_scalars(card))
                document = {"steps": training.step, "seed": self.settings.seed, "rows": card}
                RunFolder(str(self.out)).write_bytes("card.json", json_bytes(document))

    def _save_weights(self, training: T, data: TrainingSet) -> None:
        notes = {
            "steps": str(training.step),
            "seed": str(self.settings.seed),
            "data_fingerprint": data.fingerprint,
            "encoder_fingerprint": data.encoder,
            "text_encoder_fingerprint": data.text_encoder,
            "features": self.settings.features,
            "training": json.dumps(asdict(self.settings), sort_keys=True),
            "code_version": code_version(),
        }
        self._write_weights(self.out / self.WEIGHTS, training, notes)

    def _card(
        self, training: T, data: TrainingSet, source: TrainingScenes, num_scenes: int, num_exact: int, rows: tuple[str, ...]
    ) -> Card:
        """The validation card of the averaged weights; empty if no scene is held out."""
        places = data.of_split(1)
        places = (places if len(places) else data.of_split(2))[:num_scenes]
        if not len(places):
            return {}
        scenes = source.scenes([data.scene_ids[n] for n in places[:num_exact].tolist()]) if num_exact else []
        held_out = ValidationScenes(training.data, places, scenes, source.store() if scenes else None)
        move, perturbation = self._mover(training), self.settings.perturbation
        card = validation_card(move, held_out, perturbation, 0, rows)
        if len(proposals := data.proposals_of_split(1)[:num_scenes]):
            card |= validation_card(move, ValidationScenes(training.data, proposals), perturbation, 0, (PROPOSED,))
        return card

    def finish(self, folder: RunFolder, manifest: dict[str, Any]) -> str:
        """Closes the manifest and returns one line on what was done."""
        step = int(read_notes(Path(folder.root) / self.WEIGHTS)["steps"])
        is_done = step >= self.settings.steps
        closed = manifest | {"status": "complete" if is_done else "stopped", "steps_done": step}
        folder.write_bytes("manifest.json", json_bytes(closed))
        steps, used = f"{step} of {self.settings.steps}", f"{manifest['num_train']} scenes"
        if manifest["num_proposals"]:
            used += f" and {manifest['num_proposals']} proposals"
        rest = "card.json" if is_done else "run again to continue"
        return result_line(folder, steps, used, manifest["targets"], self.WEIGHTS, rest)


def _scalars(card: Card) -> dict[str, float]:
    return {f"card/{name}": value for name, value in scalar_figures(card).items()}
