"""A trained rearranger: moves the objects of scenes in place of the corrector's flow."""

from collections.abc import Sequence
from pathlib import Path

import torch

from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.expected_error import UNKNOWN_ERROR, ExpectedError
from models.physics_corrector.learned_mover import LearnedMover
from models.physics_corrector.scene_reading import NO_ENCODERS, Encoders, SceneReader, moved_scenes
from models.rearrangement.scene_noise import SceneNoise
from models.rearrangement.selection import choose_sample
from models.rearrangement.weights import RearrangerWeights, load_rearranger, method_of
from stable_data.cache_folder import user_cache
from stable_data.geometry.shape import Shape
from stable_data.metrics.sampled_collision import prepare_samples
from stable_data.random_seeds import named_seed
from stable_data.scene import Scene

_ROWS = 64  # samples of scenes in one batch of the network


class Rearranger(LearnedMover):
    """A trained rearranger.

    The draws of a scene depend on the seed and the scene's id, so that a scene's result does not depend on the others.

    Args:
        weights: The network and its settings.
        encoders: The encoders of its training.
        steps: Largest number of steps; 0 uses that of the settings.
        error: Expected errors of the layouts; a network that does not read them ignores these.
        seed: Seed of the draws.
        device: Device of the network and of the encoders.
        codes: Folder that keeps the point features; None keeps them in memory alone.

    Raises:
        ConfigError: The encoders are not those of its training, see :meth:`Encoders.check`.
    """

    def __init__(
        self,
        weights: RearrangerWeights,
        encoders: Encoders = NO_ENCODERS,
        steps: int = 0,
        error: ExpectedError = UNKNOWN_ERROR,
        seed: int = 0,
        device: str = "cpu",
        codes: Path | None = None,
    ) -> None:
        settings = weights.settings.with_steps(steps) if steps else weights.settings
        self._network, self._method, self._seed = weights.network.to(device), method_of(settings), seed
        reader = SceneReader(weights.settings.network, weights.notes, encoders, error, device, codes)
        super().__init__("rearranger", reader, max(1, _ROWS // self._method.num_samples))

    def prepare(self, scene: Scene, shapes: Sequence[Shape]) -> None:
        """See the base class; and computes samples of surfaces for a choice."""
        super().prepare(scene, shapes)
        if self._method.num_samples > 1:
            prepare_samples(shapes)

    def _moved(
        self, condition: Condition, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]
    ) -> list[Scene | None]:
        """See the base class."""
        count = self._method.num_samples
        rows = condition.take(torch.arange(len(scenes), device=condition.mask.device).repeat_interleave(count))
        seeds = [named_seed(self._seed, scene.scene_id, sample) for scene in scenes for sample in range(count)]
        poses = self._method.sample(self._network, rows, SceneNoise(rows, seeds))
        poses = poses.reshape(len(scenes), count, *poses.shape[1:])
        samples = [moved_scenes(scenes, fixed, poses[:, sample]) for sample in range(count)]
        of_scene = zip(*samples, strict=True)
        return [choose_sample(start, own, found) for start, own, found in zip(scenes, shapes, of_scene, strict=True)]


def open_rearranger(
    path: Path, steps: int = 0, error: ExpectedError = UNKNOWN_ERROR, seed: int = 0, device: str = "cpu"
) -> Rearranger:
    """Loads a rearranger with the encoders of its training: that of points beside the file, else the one of the repository.

    Args:
        path: The file.
        steps: Largest number of steps; 0 uses that of the settings.
        error: Expected errors of the layouts.
        seed: Seed of the draws.
        device: Device of the network and of the encoders.

    Raises:
        ConfigError: The file is not a rearranger, or an encoder is not that of its training.
    """
    weights = load_rearranger(path)
    encoders = Encoders.beside(path, weights.settings.network)
    return Rearranger(weights, encoders, steps, error, seed, device, user_cache("point_codes"))
