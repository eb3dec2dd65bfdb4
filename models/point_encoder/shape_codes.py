"""Point features of shapes, computed once for each shape and kept in memory and in files that all processes of a user share."""

from collections.abc import Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch

from models.point_encoder.cloud import PointCloud
from models.point_encoder.encoder import FEATURE_CHANNELS, PointEncoder
from stable_data.assets.user_cache import ArrayFiles, array_key
from stable_data.geometry import surface_sampling
from stable_data.geometry.shape import Shape

_MOST = 20_000  # features in memory: 5 MB
_DIGITS = 6  # decimals of a shape whose largest side is 1: one mesh at two scales has one key in spite of rounding errors


class ShapeCodes:
    """Computes the point features of shapes.

    Args:
        encoder: The encoder.
        folder: Keeps the features; None keeps them in memory alone.
    """

    def __init__(self, encoder: PointEncoder, folder: Path | None = None) -> None:
        self._encoder, self._files = encoder, ArrayFiles(folder)
        # The last bits depend on the kind of device, on the processor and on the version of torch.
        machine = f"{encoder.device.type} {torch.backends.cpu.get_cpu_capability()} {torch.__version__}"
        origin = f"{encoder.fingerprint()} {machine}".encode()
        self._origin = (Path(surface_sampling.__file__).read_bytes(), origin)
        self._codes: dict[str, npt.NDArray[np.float32]] = {}
        self._keys: WeakKeyDictionary[Shape, str] = WeakKeyDictionary()

    def __call__(self, shapes: Sequence[Shape]) -> npt.NDArray[np.float32]:
        """Returns the features of shapes in metres, yaw frame, (S, 64) float32; new shapes are encoded together.

        Raises:
            MeshError: A shape has no surface.
        """
        wanted = {self._key(shape): shape for shape in shapes}
        new = {key: shape for key, shape in wanted.items() if key not in self._codes and not self._load(key)}
        if len(self._codes) + len(new) > _MOST:
            self._codes = {key: self._codes[key] for key in wanted.keys() - new.keys()}
        clouds = [PointCloud.of_shape(self._unit_shape(s), self._encoder.preprocessing.num_points) for s in new.values()]
        for key, code in zip(new, self._encoder.codes(clouds), strict=True):
            self._codes[key] = code
            self._files.write(key, {"code": code})
        codes = [self._codes[self._key(shape)] for shape in shapes]
        return np.array(codes, np.float32).reshape(-1, FEATURE_CHANNELS)

    def _load(self, key: str) -> bool:
        """Loads the feature of a key from its file; returns whether there is a usable one."""
        found = (self._files.read(key) or {}).get("code")
        if found is None or found.shape != (FEATURE_CHANNELS,) or found.dtype != np.float32 or not np.isfinite(found).all():
            return False
        self._codes[key] = found
        return True

    def _unit_shape(self, shape: Shape) -> Shape:
        """The shape that is encoded: the same for all scales, if the feature does not depend on the scale."""
        if self._encoder.preprocessing.normalise == "centre":
            return shape
        return Shape(np.round(shape.vertices / shape.size.max(), _DIGITS), shape.faces)

    def _key(self, shape: Shape) -> str:
        """A hash of the shape that is encoded, of the encoder and of the code, computed once for each shape."""
        if shape not in self._keys:
            unit = self._unit_shape(shape)
            self._keys[shape] = array_key(Path(__file__).parent, *self._origin, unit.vertices.tobytes(), unit.faces.tobytes())
        return self._keys[shape]
