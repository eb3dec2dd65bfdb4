"""The learned flow with its weights: moves the objects of scenes before ``certify`` proves or repairs the result."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS as CORRECTOR
from models.physics_corrector.flow.checkpoint import Checkpoint, load_corrector
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.expected_error import UNKNOWN_ERROR, ExpectedError
from models.physics_corrector.learned_mover import LearnedMover
from models.physics_corrector.scene_reading import Encoders, SceneReader, encoder_beside, moved_scenes
from models.point_encoder import PointEncoder
from stable_data.assets.text_embeddings import TextEncoder
from stable_data.cache_folder import user_cache
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene

AUTO, NONE = "auto", "none"
"""Values of the setting ``weights``: the weights of the repository, and no flow."""

_BATCH = 64  # scenes in one batch of the network


class LearnedFlow(LearnedMover):
    """A trained flow.

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
        self._checkpoint, self._steps = checkpoint, steps
        encoders = Encoders(encoder, text_encoder)
        reader = SceneReader(checkpoint.settings.network, checkpoint.notes, encoders, error, device, codes)
        super().__init__("flow", reader, _BATCH)
        checkpoint.network.to(device)

    def _moved(
        self, condition: Condition, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]
    ) -> list[Scene | None]:
        """See the base class."""
        poses = self._checkpoint.flow.sample(self._checkpoint.network, condition, steps=self._steps or None)
        return moved_scenes(scenes, fixed, poses)


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
    encoders = Encoders.beside(path, checkpoint.settings.network)
    return LearnedFlow(checkpoint, encoders.points, encoders.texts, steps, error, device, user_cache("point_codes"))


def weights_fingerprint(weights: str) -> str:
    """Hashes the content of the files that :func:`load_flow` reads; ``none`` for no flow.

    Raises:
        ConfigError: The file does not exist.
    """
    if weights == NONE:
        return NONE
    path = CORRECTOR if weights == AUTO else Path(weights)
    digest = hashlib.sha256()
    for file in (path, encoder_beside(path)):
        if file.is_file():
            digest.update(file.read_bytes())
        elif file == path:
            raise ConfigError(f"{path}: no such file, expected the weights of a corrector", "checkpoint_invalid")
    return digest.hexdigest()[:16]
