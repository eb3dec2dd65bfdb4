"""Trains the Physics Corrector: in this process, or in the processes of Ray Train, with the same loop (:mod:`pipelines.train.layouts`)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from models.physics_corrector.flow.checkpoint import save_corrector
from models.physics_corrector.flow.flow_matching import Mover
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.settings import CorrectorTrainingSettings
from models.physics_corrector.training.trainer import CorrectorTrainer
from models.training.distributed import ProcessContext
from pipelines.train.layouts import LayoutTrainingJob


@dataclass(frozen=True)
class CorrectorTrainingJob(LayoutTrainingJob[CorrectorTrainingSettings, CorrectorTrainer]):
    """The training of the Physics Corrector."""

    NAME = "train_corrector"
    WEIGHTS = "weights/physics_corrector.safetensors"

    def _trainer(self, data: TrainingSet, place: ProcessContext) -> CorrectorTrainer:
        return CorrectorTrainer(data, self.settings, place)

    def _mover(self, training: CorrectorTrainer) -> Mover:
        return training.flow.mover(training.velocity(training.averaged()))

    def _write_weights(self, path: Path, training: CorrectorTrainer, notes: Mapping[str, str]) -> None:
        save_corrector(path, self.settings.corrector, training.average, notes)
