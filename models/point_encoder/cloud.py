"""The input of the encoder: an object's surface points in the yaw frame, normalised and voxelised."""

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
    """Surface points of an object at its scale and tilt, yaw frame, box centred at the origin.

    Attributes:
        points: (P, 3) float32, metres.
        normals: Outward unit normals, (P, 3) float32.
        size: Size of the object's box, (3,) float32, metres; the box of the points may be slightly smaller.
    """

    points: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    size: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        """Checks the arrays.

        Raises:
            MeshError: Shapes differ, there is no point, a number is not finite, or the size is 0 (``cloud_invalid``).
        """
        shapes = (self.points.shape, self.normals.shape, self.size.shape)
        if len(self.points) == 0 or shapes != ((len(self.points), 3), (len(self.points), 3), (3,)):
            message = f"cloud has points, normals and size of shapes {shapes}, expected (P, 3), (P, 3) and (3,)"
            raise MeshError(message, "cloud_invalid")
        is_finite = all(np.isfinite(values).all() for values in (self.points, self.normals, self.size))
        if not (is_finite and self.size.max() > 0):
            message = f"cloud has size {self.size.tolist()}, expected finite points and a positive extent; check the mesh"
            raise MeshError(message, "cloud_invalid")

    @classmethod
    def of_shape(cls, shape: Shape, num_points: int) -> "PointCloud":
        """Samples a cloud; the same shape always gives the same cloud.

        Args:
            shape: The geometry, metres, yaw frame.
            num_points: Number of evenly distributed points; an encoder's ``preprocessing.num_points``.

        Raises:
            MeshError: The shape has no surface.
        """
        points, normals = surface_points(Mesh(shape.vertices, shape.faces), num_points)
        return cls(points, normals, shape.size.astype(np.float32))


@dataclass(frozen=True, slots=True)
class Preprocessing:
    """The preprocessing of clouds with which a network was trained; it is stored with the weights.

    Attributes:
        num_points: Points of a cloud.
        normalise: ``extent``: the box's largest side spans [-1, 1]; ``sphere``: the mean at the origin, the farthest point at
            distance 1; ``centre``: metres, box centred. The first two remove the size of a cloud: it remains in the log extents.
        grid_size: Edge length of a voxel, after normalisation.
        channels: Features of a voxel, in order. Colour is zero, because meshes are used without it.
    """

    num_points: int = 1024
    normalise: str = "extent"
    grid_size: float = 1 / 8
    channels: tuple[str, ...] = ("coord", "normal")

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ConfigError: A value is unknown or not positive (``encoder_config``).
        """
        unknown = sorted(set(self.channels) - set(CHANNELS))
        if self.normalise not in NORMALISATIONS or unknown or not self.channels:
            found = f"normalise {self.normalise!r}, channels {self.channels}"
            raise ConfigError(f"preprocessing: {found}, expected of {NORMALISATIONS}, {CHANNELS}", "encoder_config")
        if not (self.num_points > 0 and np.isfinite(self.grid_size) and self.grid_size > 0):
            message = f"preprocessing: {self.num_points} points, voxels of {self.grid_size}, expected both positive"
            raise ConfigError(message, "encoder_config")

    @property
    def num_channels(self) -> int:
        """Number of features of a voxel."""
        return 3 * len(self.channels)


SCANNET = Preprocessing(8192, "centre", 0.02, ("colour", "normal"))
"""Preprocessing of the published first-generation weights for indoor segmentation. A 10 cm object has few such voxels."""

MODELNET = Preprocessing(8192, "sphere", 0.01, ("coord", "normal"))
"""Preprocessing of the published first-generation recipe for single objects."""

SONATA = Preprocessing(8192, "centre", 0.02, ("coord", "colour", "normal"))
"""Preprocessing of Sonata and Concerto."""

PUBLISHED = {"scannet": SCANNET, "modelnet": MODELNET, "sonata": SONATA}
"""Preprocessing of published weights, by training data or model."""


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Occupied voxels of a batch of clouds, with distinct coordinates in each cloud.

    Attributes:
        coords: (V, 3) int64, from 0 in each cloud.
        batch: Cloud of each voxel, (V,) int64.
        features: Means over the points of each voxel, (V, C) float32.
    """

    coords: Tensor
    batch: Tensor
    features: Tensor


def voxelise(clouds: Sequence[PointCloud], preprocessing: Preprocessing, device: torch.device | str = "cpu") -> Voxels:
    """Converts clouds to the network's input.

    Points of one voxel are averaged in double precision, so that the result does not depend on their order. The centre of a
    voxel, not its corner, is at the normalised origin: faces of the box are then inside voxels, not on a voxel boundary, where
    rounding errors would decide.

    Args:
        clouds: At least one cloud.
        preprocessing: The preprocessing of the weights.
        device: The device of the result.

    Raises:
        MeshError: A cloud has 65536 or more voxels along an axis (``cloud_too_large``).
    """
    positions = [_normalise(cloud, preprocessing.normalise) for cloud in clouds]
    of = {"coord": positions, "colour": [np.zeros_like(p) for p in positions], "normal": [cloud.normals for cloud in clouds]}
    features = np.concatenate([np.concatenate(of[channel]) for channel in preprocessing.channels], axis=1)
    batch = torch.arange(len(clouds)).repeat_interleave(torch.tensor([len(p) for p in positions]))
    coords = torch.from_numpy(np.floor(np.concatenate(positions) / np.float32(preprocessing.grid_size) + np.float32(0.5)))
    lowest = coords.new_zeros(len(clouds), 3).scatter_reduce(
        0, batch[:, None].expand(-1, 3), coords, "amin", include_self=False
    )
    coords -= lowest[batch]
    if not coords.max() < 2**16:
        message = f"a cloud is {int(coords.max())} voxels long, expected less than 65536; check that its size is in metres"
        raise MeshError(message, "cloud_too_large")
    x, y, z = coords.long().unbind(1)
    key = (batch << 48) | (x << 32) | (y << 16) | z  # unique() of one number per voxel is faster than of rows
    found, voxel, count = torch.unique(key, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(found), features.shape[1], dtype=torch.float64).index_add_(
        0, voxel, torch.from_numpy(features).double()
    )
    means = (sums / count[:, None]).float()
    unique_coords = torch.stack([found >> 32, found >> 16, found], dim=1) & 0xFFFF
    return Voxels(unique_coords.to(device), (found >> 48).to(device), means.to(device))


def _normalise(cloud: PointCloud, how: str) -> npt.NDArray[np.float32]:
    points, unit = cloud.points, 1.0
    if how == "sphere":
        points = points - points.mean(axis=0, dtype=np.float64).astype(np.float32)
        unit = max(float(np.linalg.norm(points, axis=1).max()), 1e-12)
    elif how == "extent":
        unit = float(cloud.size.max()) / 2
    return np.asarray(points / np.float32(unit), np.float32)
