"""The learned flow with its weights: moves the objects of scenes before ``certify`` proves or repairs the result."""

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.device_batches import DeviceBatches
from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.flow.category_texts import category_texts
from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS as CORRECTOR
from models.physics_corrector.flow.checkpoint import Checkpoint, load_corrector
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.expected_error import UNKNOWN_ERROR, ExpectedError
from models.physics_corrector.geometry.scene_batch import pad_scenes
from models.physics_corrector.packing.packing_problem import AXES
from models.point_encoder import FEATURE_CHANNELS, PointEncoder
from models.point_encoder import load as load_encoder
from models.point_encoder.checkpoint import DEFAULT_WEIGHTS as ENCODER
from models.point_encoder.shape_codes import ShapeCodes
from models.text_encoder import load_default as load_text_encoder
from stable_data.assets.text_embeddings import TextEncoder
from stable_data.cache_folder import user_cache
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene

ENCODER_FILE = ENCODER.name
"""The name of the encoder's file beside the weights of a corrector."""

AUTO, NONE = "auto", "none"
"""Values of the setting ``weights``: the weights of the repository, and no flow."""

_BATCH = 64  # scenes in one batch of the network
_MAX_CACHED_TEXTS = 20_000  # text features of categories in memory: 31 MB


class LearnedFlow:
    """A trained flow; a :data:`~models.physics_corrector.corrector.Flow`.

    Args:
        checkpoint: The network and its settings.
        encoder: Computes the point features of objects; None for a network without features.
        text_encoder: Computes the text features of categories; None for a network without them.
        steps: Solver steps; 0 uses those of the settings.
        error: Expected errors of the layouts; a network that does not read them ignores these.
        device: Device of the network and of the encoder.
        codes: Folder that keeps the point features; None keeps them in memory alone.

    Raises:
        ConfigError: The network reads features, but not 64 (``checkpoint_mismatch``), or an encoder is missing or not the one of
            its training (``encoder_mismatch``).
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        encoder: PointEncoder | None = None,
        text_encoder: TextEncoder | None = None,
        steps: int = 0,
        error: ExpectedError = UNKNOWN_ERROR,
        device: str = "cpu",
        codes: Path | None = None,
    ) -> None:
        self._checkpoint, self._steps, self._error = checkpoint, steps, error
        self._text_encoder = text_encoder if checkpoint.settings.network.num_texts else None
        self._texts: dict[str, npt.NDArray[np.float32]] = {}
        self._device, self._batches = device, DeviceBatches("flow", _BATCH)
        checkpoint.network.to(device)
        if num_features := checkpoint.settings.network.num_features:
            if num_features != FEATURE_CHANNELS:
                raise ConfigError(
                    f"the corrector reads {num_features} point features per object, expected {FEATURE_CHANNELS} or none; "
                    "train it again",
                    "checkpoint_mismatch",
                )
            _check_encoder(checkpoint, "encoder", "none" if encoder is None else encoder.fingerprint())
        self._codes = ShapeCodes(encoder.to(device), codes) if encoder is not None and num_features else None
        if checkpoint.settings.network.num_texts:
            _check_encoder(checkpoint, "text_encoder", "none" if text_encoder is None else text_encoder.fingerprint)

    @torch.no_grad()
    def __call__(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
        """Moves the objects of scenes; fixed objects, and scenes whose new poses are not finite, are unchanged bit by bit.

        Args:
            scenes: The scenes, positions at the centres of the boxes, with known supports.
            shapes: The geometry of the objects of each scene, in their order.
            fixed: The instances of each scene that must not move.
        """
        return self._batches.run(list(zip(scenes, shapes, fixed, strict=True)), self._move_batch)

    def _move_batch(self, layouts: Sequence[tuple[Scene, Sequence[Shape], Fixed]]) -> list[Scene]:
        scenes, shapes, fixed = [x for x, _, _ in layouts], [x for _, x, _ in layouts], [x for _, _, x in layouts]
        arrays = {name: torch.from_numpy(value) for name, value in pad_scenes(scenes, shapes, fixed).items()}
        num_slots = arrays["mask"].shape[1]
        condition = Condition(
            **arrays,
            features=None if self._codes is None else self._features(shapes, num_slots),
            **self._told(scenes, num_slots),
        )
        if not condition.mask.any():
            return list(scenes)
        network, flow = self._checkpoint.network, self._checkpoint.flow
        poses = flow.sample(network, condition.to(self._device), steps=self._steps or None).double().cpu().numpy()
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

    def _told(self, scenes: Sequence[Scene], num_slots: int) -> dict[str, Tensor]:
        """What the network reads besides shapes and poses: ``texts``, ``table_text``, ``error`` and ``order``."""
        settings, told = self._checkpoint.settings.network, dict[str, Tensor]()
        if self._text_encoder is not None:
            texts, table_text = np.zeros((len(scenes), num_slots, settings.num_texts), np.float32), []
            for b, scene in enumerate(scenes):
                *of_objects, of_table = self._text_features(category_texts(scene))
                texts[b, : len(of_objects)] = np.reshape(of_objects, (len(of_objects), settings.num_texts))
                table_text.append(of_table)
            told |= {"texts": torch.from_numpy(texts), "table_text": torch.from_numpy(np.stack(table_text))}
        if settings.reads_errors:
            error = [math.nan if value is None else value for value in (self._error.position, self._error.yaw)]
            told["error"] = torch.tensor(error).expand(len(scenes), 2)
        if settings.reads_order:
            told["order"] = torch.from_numpy(known_directions(scenes, num_slots))
        return told

    def _text_features(self, texts: Sequence[str]) -> list[npt.NDArray[np.float32]]:
        """Returns the text features of categories, each (D,)."""
        assert self._text_encoder is not None
        if new := sorted(set(texts) - self._texts.keys()):
            if len(self._texts) + len(new) > _MAX_CACHED_TEXTS:
                self._texts.clear()
                new = sorted(set(texts))
            self._texts |= dict(zip(new, self._text_encoder(new), strict=True))
        return [self._texts[text] for text in texts]

    def _features(self, shapes: Sequence[Sequence[Shape]], num_slots: int) -> Tensor:
        """Returns the point features of the objects, (B, N, 64) float32."""
        assert self._codes is not None
        found = self._codes([shape for own in shapes for shape in own])
        features = np.zeros((len(shapes), num_slots, found.shape[1]), np.float32)
        first = 0
        for b, own in enumerate(shapes):
            features[b, : len(own)] = found[first : first + len(own)]
            first += len(own)
        return torch.from_numpy(features)


def known_directions(scenes: Sequence[Scene], num_slots: int) -> npt.NDArray[np.float32]:
    """Returns the directions that the tasks of scenes state, as in ``SceneTensors.order``, (B, N, N, 2) float32."""
    order = np.zeros((len(scenes), num_slots, num_slots, 2), np.float32)
    for b, scene in enumerate(scenes):
        number = {o.instance: n for n, o in enumerate(scene.objects)}
        for relation in () if scene.task is None else scene.task.relations:
            if relation.kind in AXES and relation.subject in number and relation.target in number:
                subject, target, way = number[relation.subject], number[relation.target], np.array(AXES[relation.kind])
                order[b, target, subject], order[b, subject, target] = way, -way
    return order


def load_flow(
    weights: str = AUTO, steps: int = 0, error: ExpectedError = UNKNOWN_ERROR, device: str = "cpu"
) -> LearnedFlow | None:
    """Loads the flow.

    Args:
        weights: ``auto``, ``none``, or a file. The encoder is the one beside the file, else the one of the repository.
        steps: Solver steps; 0 uses those of the settings.
        error: Expected errors of the layouts.
        device: Device of the network and of the encoder.

    Returns:
        The flow; None for ``none``.

    Raises:
        ConfigError: The weights cannot be read, or corrector and encoder do not match.
    """
    if weights == NONE:
        return None
    path = CORRECTOR if weights == AUTO else Path(weights)
    checkpoint = load_corrector(path)
    network = checkpoint.settings.network
    encoder = load_encoder(_encoder_beside(path)) if network.num_features else None
    text_encoder = load_text_encoder() if network.num_texts else None
    return LearnedFlow(checkpoint, encoder, text_encoder, steps, error, device, user_cache("point_codes"))


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


def _check_encoder(checkpoint: Checkpoint, name: str, found: str) -> None:
    """Refuses an encoder that is not the one of the training of a corrector."""
    trained_on = checkpoint.notes.get(f"{name}_fingerprint", "")
    if found != trained_on:
        raise ConfigError(
            f"the corrector was trained on the features of {name.replace('_', ' ')} {trained_on or 'unknown'}, found {found}; "
            "use the encoder of its training",
            "encoder_mismatch",
        )


def _encoder_beside(path: Path) -> Path:
    beside = path.with_name(ENCODER_FILE)
    return beside if beside.is_file() else ENCODER
