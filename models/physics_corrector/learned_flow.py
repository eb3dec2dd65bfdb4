"""The learned flow with its weights: it moves the objects of scenes, which ``certify`` then proves or repairs."""

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
_MAX_CACHED_CODES = 20_000  # point features of shapes that are kept in memory: 5 MB
_DIGITS = 6  # decimals of a shape whose largest side is 1: the same mesh at another scale is the same key


class LearnedFlow:
    """A trained flow; a :data:`~models.physics_corrector.corrector.Flow`.

    Args:
        checkpoint: The network and its settings.
        encoder: Encodes the point features of objects; None for a network that reads none.
        steps: Steps of the solver; 0 as its settings say.

    Raises:
        ConfigError: The network reads features, and there is no encoder, or the network was trained with another one, or it
            reads a number of features other than 64.
    """

    def __init__(self, checkpoint: Checkpoint, encoder: PointEncoder | None = None, steps: int = 0) -> None:
        self._checkpoint, self._steps = checkpoint, steps
        self._encoder = encoder if checkpoint.settings.network.num_features else None
        self._codes: dict[bytes, npt.NDArray[np.float32]] = {}
        if wanted := checkpoint.settings.network.num_features:
            if wanted != FEATURE_CHANNELS:
                raise ConfigError(
                    f"the corrector reads {wanted} point features an object, expected {FEATURE_CHANNELS} or none; train it anew",
                    "checkpoint_mismatch",
                )
            trained_on = checkpoint.notes.get("encoder_fingerprint", "")
            found = "none" if encoder is None else encoder.fingerprint()
            if found != trained_on:
                raise ConfigError(
                    f"the corrector was trained on the features of encoder {trained_on or 'unknown'}, found {found}; "
                    "give the encoder that belongs to it",
                    "encoder_mismatch",
                )

    @torch.no_grad()
    def __call__(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
        """Moves the objects of scenes; fixed objects keep their poses bit by bit, and so does a scene without finite new poses.

        Args:
            scenes: Positions at the centres of the boxes, with supports where they are known.
            shapes: The geometry of their objects, in their order.
            fixed: The instances of each that must stay.
        """
        moved: list[Scene] = []
        for start in range(0, len(scenes), _BATCH):
            part = slice(start, start + _BATCH)
            moved += self._moved(scenes[part], shapes[part], fixed[part])
        return moved

    def _moved(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
        arrays = {name: torch.from_numpy(value) for name, value in pad_scenes(scenes, shapes, fixed).items()}
        features = None if self._encoder is None else self._features(shapes, arrays["mask"].shape[1])
        condition = Condition(**arrays, features=features)
        if not condition.mask.any():
            return list(scenes)
        network, flow = self._checkpoint.network, self._checkpoint.flow
        poses = flow.sample(network, condition, steps=self._steps or None).double().numpy()
        found = []
        for b, (scene, stays) in enumerate(zip(scenes, fixed, strict=True)):
            own = poses[b, : len(scene.objects)]
            if not np.isfinite(own).all():  # coordinates beyond 32 bits: `certify` begins at the scene itself
                found.append(scene)
                continue
            start = scene.poses()
            still = np.array([o.instance in stays for o in scene.objects], np.bool_)
            found.append(scene.with_poses(np.where(still[:, None], start, own)) if len(own) else scene)
        return found

    def _features(self, shapes: Sequence[Sequence[Shape]], num_slots: int) -> Tensor:
        """Point features of the objects, (B, N, 64) float32."""
        features = np.zeros((len(shapes), num_slots, self._checkpoint.settings.network.num_features), np.float32)
        for b, own in enumerate(shapes):
            for n, shape in enumerate(own):
                features[b, n] = self._code(shape)
        return torch.from_numpy(features)

    def _code(self, shape: Shape) -> npt.NDArray[np.float32]:
        """The point feature of a shape, encoded once for all scales.

        Shapes are encoded one by one: in a batch the last bits would depend on the other shapes of the batch.
        """
        assert self._encoder is not None
        alike = shape
        if self._encoder.preprocessing.normalise != "centre":  # then the feature does not depend on the scale
            alike = Shape(np.round(shape.vertices / shape.size.max(), _DIGITS), shape.faces)
        key = hashlib.sha256(alike.vertices.tobytes() + alike.faces.tobytes()).digest()
        if key not in self._codes:
            if len(self._codes) >= _MAX_CACHED_CODES:
                self._codes.pop(next(iter(self._codes)))
            cloud = PointCloud.of_shape(alike, self._encoder.preprocessing.num_points)
            self._codes[key] = self._encoder.codes([cloud])[0]
        return self._codes[key]


def load_flow(weights: str = AUTO, steps: int = 0) -> LearnedFlow | None:
    """The flow of some weights.

    Args:
        weights: ``auto``, ``none``, or a file; the encoder lies beside it or is the one in the repository.
        steps: Steps of the solver; 0 as its settings say.

    Returns:
        The flow; None for ``none``.

    Raises:
        ConfigError: The weights cannot be used, or not together.
    """
    if weights == NONE:
        return None
    path = CORRECTOR if weights == AUTO else Path(weights)
    checkpoint = load_corrector(path)
    needs_encoder = checkpoint.settings.network.num_features > 0
    return LearnedFlow(checkpoint, load_encoder(_encoder_beside(path)) if needs_encoder else None, steps)


def weights_fingerprint(weights: str) -> str:
    """Hash of the content of the files that :func:`load_flow` reads."""
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
