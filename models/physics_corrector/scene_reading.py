"""Scenes as a network of the corrector reads them: padded tensors with features of shapes and words, and what else it is told."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.flow.category_texts import category_texts
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.expected_error import UNKNOWN_ERROR, ExpectedError
from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.physics_corrector.geometry.scene_batch import pad_scenes
from models.physics_corrector.packing.packing_problem import AXES
from models.point_encoder import FEATURE_CHANNELS, PointEncoder
from models.point_encoder import load as load_encoder
from models.point_encoder.checkpoint import DEFAULT_WEIGHTS as ENCODER
from models.point_encoder.shape_codes import ShapeCodes
from models.text_encoder import load_default as load_text_encoder
from models.torch_threads import one_thread
from stable_data.assets.text_embeddings import TextEncoder
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene

ENCODER_FILE = ENCODER.name
"""The name of the encoder's file beside the weights of a network."""

_MAX_CACHED_TEXTS = 20_000  # text features of categories in memory: 31 MB


@dataclass(frozen=True, slots=True, eq=False)
class Encoders:
    """The encoders of what a network reads.

    Attributes:
        points: Computes the point features of objects; None for a network without features.
        texts: Computes the text features of categories; None for a network without them.
    """

    points: PointEncoder | None = None
    texts: TextEncoder | None = None

    @classmethod
    def beside(cls, weights: Path, network: VelocityNetworkSettings) -> "Encoders":
        """Loads the encoders that a network needs: that of points beside its weights, else the one of the repository.

        Raises:
            ConfigError: An encoder cannot be read.
        """
        points = load_encoder(encoder_beside(weights)) if network.num_features else None
        return cls(points, load_text_encoder() if network.num_texts else None)

    def check(self, network: VelocityNetworkSettings, notes: Mapping[str, str]) -> None:
        """Refuses encoders that are not those of a network's training.

        Args:
            network: The shape of the network.
            notes: The notes of its file, with ``encoder_fingerprint`` and ``text_encoder_fingerprint``.

        Raises:
            ConfigError: The network reads features, but not 64 (``checkpoint_mismatch``), or an encoder is missing or another one
                (``encoder_mismatch``).
        """
        if network.num_features:
            if network.num_features != FEATURE_CHANNELS:
                raise ConfigError(
                    f"the network reads {network.num_features} point features per object, expected {FEATURE_CHANNELS} or none; "
                    "train it again",
                    "checkpoint_mismatch",
                )
            _check_encoder(notes, "encoder", "none" if self.points is None else self.points.fingerprint())
        if network.num_texts:
            _check_encoder(notes, "text_encoder", "none" if self.texts is None else self.texts.fingerprint)


NO_ENCODERS = Encoders()
"""For a network that reads boxes alone."""


def encoder_beside(weights: Path) -> Path:
    """Returns the file of the point encoder beside weights, else the one of the repository."""
    beside = weights.with_name(ENCODER_FILE)
    return beside if beside.is_file() else ENCODER


def _check_encoder(notes: Mapping[str, str], name: str, found: str) -> None:
    trained_on = notes.get(f"{name}_fingerprint", "")
    if found != trained_on:
        raise ConfigError(
            f"the network was trained on the features of {name.replace('_', ' ')} {trained_on or 'unknown'}, found {found}; "
            "use the encoder of its training",
            "encoder_mismatch",
        )


class SceneReader:
    """Makes the condition of a network from scenes.

    Args:
        network: The shape of the network.
        notes: The notes of its file.
        encoders: The encoders of its training.
        error: Expected errors of the layouts; a network that does not read them ignores these.
        device: Device of the condition and of the encoders.
        codes: Folder that keeps the point features; None keeps them in memory alone.

    Raises:
        ConfigError: The encoders do not fit, see :meth:`Encoders.check`.
    """

    def __init__(
        self,
        network: VelocityNetworkSettings,
        notes: Mapping[str, str],
        encoders: Encoders,
        error: ExpectedError = UNKNOWN_ERROR,
        device: str = "cpu",
        codes: Path | None = None,
    ) -> None:
        encoders.check(network, notes)
        self._network, self._error, self._device = network, error, device
        self._text_encoder = encoders.texts if network.num_texts else None
        self._texts: dict[str, npt.NDArray[np.float32]] = {}
        has_points = encoders.points is not None and network.num_features
        self._codes = ShapeCodes(encoders.points.to(device), codes) if encoders.points is not None and has_points else None

    @one_thread()
    def condition(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> Condition:
        """Returns scenes as the network reads them, on the device.

        Args:
            scenes: The scenes, positions at the centres of the boxes, with known supports.
            shapes: The geometry of the objects of each scene, in their order.
            fixed: The instances of each scene that must not move.
        """
        arrays = {name: torch.from_numpy(value) for name, value in pad_scenes(scenes, shapes, fixed).items()}
        num_slots = arrays["mask"].shape[1]
        features = None if self._codes is None else self._features(shapes, num_slots)
        return Condition(**arrays, features=features, **self._told(scenes, num_slots)).to(self._device)

    def _told(self, scenes: Sequence[Scene], num_slots: int) -> dict[str, Tensor]:
        """What the network reads besides shapes and poses: ``texts``, ``table_text``, ``error`` and ``order``."""
        settings, told = self._network, dict[str, Tensor]()
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


def moved_scenes(scenes: Sequence[Scene], fixed: Sequence[Fixed], poses: Tensor) -> list[Scene | None]:
    """Returns scenes at new poses; fixed objects are unchanged bit by bit.

    Args:
        scenes: The scenes.
        fixed: The instances of each scene that must not move.
        poses: New poses of their objects, (B, N, 4).

    Returns:
        The scenes; None where the new poses are not finite, as for coordinates that overflow float32.
    """
    moved, found = list[Scene | None](), poses.double().cpu().numpy()
    for b, (scene, fixed_instances) in enumerate(zip(scenes, fixed, strict=True)):
        own = found[b, : len(scene.objects)]
        if not np.isfinite(own).all():
            moved.append(None)
            continue
        # The fixed poses of the network's output were rounded to float32.
        is_fixed = np.array([o.instance in fixed_instances for o in scene.objects], np.bool_)
        moved.append(scene.with_poses(np.where(is_fixed[:, None], scene.poses(), own)) if len(own) else scene)
    return moved


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
