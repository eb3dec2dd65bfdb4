"""The learned flow with its weights: moves the objects of scenes before ``certify`` proves or repairs the result."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS as CORRECTOR
from models.physics_corrector.flow.checkpoint import Checkpoint, load_corrector
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.geometry.scene_batch import pad_scenes
from models.point_encoder import FEATURE_CHANNELS, PointCloud, PointEncoder
from models.point_encoder import load as load_encoder
from models.point_encoder.checkpoint import DEFAULT_WEIGHTS as ENCODER
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene

AUTO, NONE = "auto", "none"
"""Values of the setting ``weights``: the weights of the repository, and no flow."""

_BATCH = 64  # scenes in one batch of the network
_MAX_CACHED_CODES = 20_000  # point features of shapes in memory: 5 MB
_DIGITS = 6  # decimals of a shape whose largest side is 1: one mesh at two scales has one key in spite of rounding errors


class LearnedFlow:
    """A trained flow; a :data:`~models.physics_corrector.corrector.Flow`.

    Args:
        checkpoint: The network and its settings.
        encoder: Computes the point features of objects; None for a network without features.
        steps: Solver steps; 0 uses those of the settings.

    Raises:
        ConfigError: The network reads features, but not 64 (``checkpoint_mismatch``), or the encoder is missing or not the one of
            its training (``encoder_mismatch``).
    """

    def __init__(self, checkpoint: Checkpoint, encoder: PointEncoder | None = None, steps: int = 0) -> None:
        self._checkpoint, self._steps = checkpoint, steps
        self._encoder = encoder if checkpoint.settings.network.num_features else None
        self._codes: dict[bytes, npt.NDArray[np.float32]] = {}
        if num_features := checkpoint.settings.network.num_features:
            if num_features != FEATURE_CHANNELS:
                raise ConfigError(
                    f"the corrector reads {num_features} point features per object, expected {FEATURE_CHANNELS} or none; "
                    "train it again",
                    "checkpoint_mismatch",
                )
            trained_on = checkpoint.notes.get("encoder_fingerprint", "")
            found = "none" if encoder is None else encoder.fingerprint()
            if found != trained_on:
                raise ConfigError(
                    f"the corrector was trained on the features of encoder {trained_on or 'unknown'}, found {found}; "
                    "use the encoder of its training",
                    "encoder_mismatch",
                )

    @torch.no_grad()
    def __call__(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
        """Moves the objects of scenes; fixed objects, and scenes whose new poses are not finite, are unchanged bit by bit.

        Args:
            scenes: The scenes, positions at the centres of the boxes, with known supports.
            shapes: The geometry of the objects of each scene, in their order.
            fixed: The instances of each scene that must not move.
        """
        moved: list[Scene] = []
        for start in range(0, len(scenes), _BATCH):
            part = slice(start, start + _BATCH)
            moved += self._move_batch(scenes[part], shapes[part], fixed[part])
        return moved

    def _move_batch(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
        arrays = {name: torch.from_numpy(value) for name, value in pad_scenes(scenes, shapes, fixed).items()}
        features = None if self._encoder is None else self._features(shapes, arrays["mask"].shape[1])
        condition = Condition(**arrays, features=features)
        if not condition.mask.any():
            return list(scenes)
        network, flow = self._checkpoint.network, self._checkpoint.flow
        poses = flow.sample(network, condition, steps=self._steps or None).double().numpy()
        moved = []
        for b, (scene, fixed_instances) in enumerate(zip(scenes, fixed, strict=True)):
            own = poses[b, : len(scene.objects)]
            if not np.isfinite(own).all():  # coordinates that overflow float32: `certify` starts at the input scene
                moved.append(scene)
                continue
            # The fixed poses of the network's output were rounded to float32.
            is_fixed = np.array([o.instance in fixed_instances for o in scene.objects], np.bool_)
            moved.append(scene.with_poses(np.where(is_fixed[:, None], scene.poses(), own)) if len(own) else scene)
        return moved

    def _features(self, shapes: Sequence[Sequence[Shape]], num_slots: int) -> Tensor:
        """Computes the point features of the objects, (B, N, 64) float32."""
        features = np.zeros((len(shapes), num_slots, self._checkpoint.settings.network.num_features), np.float32)
        for b, own in enumerate(shapes):
            for n, shape in enumerate(own):
                features[b, n] = self._code(shape)
        return torch.from_numpy(features)

    def _code(self, shape: Shape) -> npt.NDArray[np.float32]:
        """Returns the point feature of a shape, computed once for all scales.

        Shapes are encoded one by one: in a batch the last bits would depend on the other shapes of the batch.
        """
        assert self._encoder is not None
        unit_shape = shape
        if self._encoder.preprocessing.normalise != "centre":  # all other rules make the feature independent of the scale
            unit_shape = Shape(np.round(shape.vertices / shape.size.max(), _DIGITS), shape.faces)
        key = hashlib.sha256(unit_shape.vertices.tobytes() + unit_shape.faces.tobytes()).digest()
        if key not in self._codes:
            if len(self._codes) >= _MAX_CACHED_CODES:
                self._codes.pop(next(iter(self._codes)))  # the oldest
            cloud = PointCloud.of_shape(unit_shape, self._encoder.preprocessing.num_points)
            self._codes[key] = self._encoder.codes([cloud])[0]
        return self._codes[key]


def load_flow(weights: str = AUTO, steps: int = 0) -> LearnedFlow | None:
    """Loads the flow.

    Args:
        weights: ``auto``, ``none``, or a file. The encoder is the one beside the file, else the one of the repository.
        steps: Solver steps; 0 uses those of the settings.

    Returns:
        The flow; None for ``none``.

    Raises:
        ConfigError: The weights cannot be read, or corrector and encoder do not match.
    """
    if weights == NONE:
        return None
    path = CORRECTOR if weights == AUTO else Path(weights)
    checkpoint = load_corrector(path)
    needs_encoder = checkpoint.settings.network.num_features > 0
    return LearnedFlow(checkpoint, load_encoder(_encoder_beside(path)) if needs_encoder else None, steps)


def weights_fingerprint(weights: str) -> str:
    """Hashes the content of the files that :func:`load_flow` reads; ``none`` for no flow.

    Raises:
        ConfigError: The file does not exist.
    """
    if weights == NONE:
        return NONE
    path = CORRECTOR if weights == AUTO else Path(weights)
    digest = hashlib.sha256()
    for file in (path, _encoder_beside(path)):
        if file.is_file():
            digest.update(file.read_bytes())
        elif file == path:
            raise ConfigError(f"{path}: no such file, expected the weights of a corrector", "checkpoint_invalid")
    return digest.hexdigest()[:16]


def _encoder_beside(path: Path) -> Path:
    beside = path.with_name(ENCODER.name)
    return beside if beside.is_file() else ENCODER
