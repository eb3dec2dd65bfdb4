"""What the encoder takes: an object's surface points in its yaw frame, normalised and cut into voxels as its weights expect."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import surface_points

NORMALISATIONS, CHANNELS = ("extent", "sphere", "centre"), ("coord", "colour", "normal")


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Surface points of an object at its scale and tilt, yaw frame, its box centred on the origin.

    Attributes:
        points: (P, 3) float32, metres.
        normals: Unit, outward, (P, 3) float32.
        size: The box of the object, which its points only nearly fill, (3,) float32, metres.
    """

    points: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    size: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        """Refuses what has no code."""
        shapes = (self.points.shape, self.normals.shape, self.size.shape)
        if len(self.points) == 0 or shapes != ((len(self.points), 3), (len(self.points), 3), (3,)):
            message = f"cloud has points, normals and size of shapes {shapes}, expected (P, 3), (P, 3) and (3,)"
            raise MeshError(message, "cloud_invalid")
        is_finite = all(np.isfinite(values).all() for values in (self.points, self.normals, self.size))
        if not (is_finite and self.size.max() > 0):
            message = f"cloud has size {self.size.tolist()}, expected finite points and a positive extent; is the mesh whole?"
            raise MeshError(message, "cloud_invalid")

    @classmethod
    def of_shape(cls, shape: Shape, num_points: int) -> "PointCloud":
        """The cloud of an object's geometry; always the same for the same shape.

        Args:
            shape: Metres, yaw frame.
            num_points: Points, evenly spread; an encoder's ``preprocessing.num_points``.

        Raises:
            MeshError: There is no surface.
        """
        points, normals = surface_points(Mesh(shape.vertices, shape.faces), num_points)
        return cls(points, normals, shape.size.astype(np.float32))


@dataclass(frozen=True, slots=True)
class Preprocessing:
    """How a cloud becomes what the network was trained on; part of what weights are, and recorded with them.

    Attributes:
        num_points: Points of a cloud.
        normalise: ``extent``: the box's largest side spans [-1, 1]; ``sphere``: the mean at the origin, the farthest point at
            distance 1; ``centre``: metres, box centred. All but the last make a cloud's size unknowable: read it in the log
            extents.
        grid_size: Edge of a voxel after that.
        channels: Features of a voxel, in order. Colour, which geometry has not, is zero.
    """

    num_points: int = 1024
    normalise: str = "extent"
    grid_size: float = 1 / 8
    channels: tuple[str, ...] = ("coord", "normal")

    def __post_init__(self) -> None:
        """Refuses what cannot be done."""
        unknown = sorted(set(self.channels) - set(CHANNELS))
        if self.normalise not in NORMALISATIONS or unknown or not self.channels:
            message = f"preprocessing: normalise {self.normalise!r}, channels {self.channels}, expected of {NORMALISATIONS}, {CHANNELS}"
            raise ConfigError(message, "encoder_config")
        if not (self.num_points > 0 and np.isfinite(self.grid_size) and self.grid_size > 0):
            message = f"preprocessing: {self.num_points} points, voxels of {self.grid_size}, expected both positive"
            raise ConfigError(message, "encoder_config")

    @property
    def num_channels(self) -> int:
        """Features of a voxel."""
        return 3 * len(self.channels)


SCANNET = Preprocessing(8192, "centre", 0.02, ("colour", "normal"))
"""Of the published first-generation indoor segmentation weights. A 10 cm object has few such voxels."""

MODELNET = Preprocessing(8192, "sphere", 0.01, ("coord", "normal"))
"""Of the published first-generation recipe for single objects."""

SONATA = Preprocessing(8192, "centre", 0.02, ("coord", "colour", "normal"))
"""Of Sonata and Concerto."""

PUBLISHED = {"scannet": SCANNET, "modelnet": MODELNET, "sonata": SONATA}
"""Preprocessing of published weights, by what they were trained on."""


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Occupied voxels of a batch of clouds, at most one for each place.

    Attributes:
        coords: (V, 3) int64, from 0 in each cloud.
        batch: Cloud of each, (V,) int64.
        features: (V, C) float32, means over the points of a voxel.
    """

    coords: Tensor
    batch: Tensor
    features: Tensor


def voxelise(clouds: Sequence[PointCloud], preprocessing: Preprocessing, device: torch.device | str = "cpu") -> Voxels:
    """Clouds as the network takes them.

    Points of one voxel are averaged (in double precision, so that their order does not show). A voxel's middle, not its corner,
    lies on the normalised origin: a face at the end of the box then falls inside voxels and not between them, where rounding
    would choose.

    Args:
        clouds: At least one.
        preprocessing: What the weights expect.
        device: Where to.

    Raises:
        MeshError: A cloud is too large for its voxels.
    """
    places = [_normalised(cloud, preprocessing.normalise) for cloud in clouds]
    of = {"coord": places, "colour": [np.zeros_like(p) for p in places], "normal": [cloud.normals for cloud in clouds]}
    features = np.concatenate([np.concatenate(of[channel]) for channel in preprocessing.channels], axis=1)
    batch = torch.arange(len(clouds)).repeat_interleave(torch.tensor([len(p) for p in places]))
    coords = torch.from_numpy(np.floor(np.concatenate(places) / np.float32(preprocessing.grid_size) + np.float32(0.5)))
    lowest = coords.new_zeros(len(clouds), 3).scatter_reduce(
        0, batch[:, None].expand(-1, 3), coords, "amin", include_self=False
    )
    coords -= lowest[batch]
    if not coords.max() < 2**16:
        message = f"a cloud is {int(coords.max())} voxels long, expected less than 65536; is its size in metres?"
        raise MeshError(message, "cloud_too_large")
    x, y, z = coords.long().unbind(1)
    key = (batch << 48) | (x << 32) | (y << 16) | z
    found, voxel, count = torch.unique(key, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(found), features.shape[1], dtype=torch.float64).index_add_(
        0, voxel, torch.from_numpy(features).double()
    )
    means = (sums / count[:, None]).float()
    places_found = torch.stack([found >> 32, found >> 16, found], dim=1) & 0xFFFF
    return Voxels(places_found.to(device), (found >> 48).to(device), means.to(device))


def _normalised(cloud: PointCloud, how: str) -> npt.NDArray[np.float32]:
    points, unit = cloud.points, 1.0
    if how == "sphere":
        points = points - points.mean(axis=0, dtype=np.float64).astype(np.float32)
        unit = max(float(np.linalg.norm(points, axis=1).max()), 1e-12)
    elif how == "extent":
        unit = float(cloud.size.max()) / 2
    return np.asarray(points / np.float32(unit), np.float32)
