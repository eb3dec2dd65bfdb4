"""Trains a rearranger with the data and the loop of the corrector's training (:mod:`pipelines.train.layouts`)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from models.physics_corrector.flow.flow_matching import Mover
from models.physics_corrector.training.dataset import TrainingSet
from models.rearrangement.training import RearrangerTrainer, RearrangerTrainingSettings
from models.rearrangement.weights import save_rearranger
from models.training.distributed import ProcessContext
from pipelines.train.layouts import LayoutMonitoring, LayoutTrainingJob

_SELDOM = LayoutMonitoring(card_every=5000, card_scenes=16, final_scenes=64, exact_scenes=16)


@dataclass(frozen=True)
class RearrangerTrainingJob(LayoutTrainingJob[RearrangerTrainingSettings, RearrangerTrainer]):
    """The training of a rearranger. A sample takes hundreds of evaluations of the network, so that cards are few and small."""

    NAME = "train_rearranger"
    WEIGHTS = "weights/rearranger.safetensors"
    FAST_ROWS = ("jitter",)
    FINAL_ROWS = ("small", "jitter")

    watch: LayoutMonitoring = _SELDOM

    def _trainer(self, data: TrainingSet, place: ProcessContext) -> RearrangerTrainer:
        return RearrangerTrainer(data, self.settings, place)

    def _mover(self, training: RearrangerTrainer) -> Mover:
        return training.mover()

    def _write_weights(self, path: Path, training: RearrangerTrainer, notes: Mapping[str, str]) -> None:
        save_rearranger(path, self.settings.rearranger, training.average, notes)
