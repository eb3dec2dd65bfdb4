"""The sample of one object that is deepest in another object or nearest to its surface, and its differentiable distance.

The paper's distances are minima over samples, and the gradient of a minimum is that at the minimising sample. The search
therefore records no graph and skips samples outside the other object's grid. Only the minimising sample is evaluated again with
gradients: memory for gradients does not grow with the number of samples.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeTensors

_SAMPLES_AT_ONCE = 1 << 21  # bounds the memory of the search to about 100 MB


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPointQueries:
    """E queries of the distance of one object's samples to another object of the same scene.

    Attributes:
        scene: (E,) int64.
        guest: Index of the sampled object in its scene, (E,) int64.
        host: Index of the object whose signed distance is read, (E,) int64.
    """

    scene: Tensor
    guest: Tensor
    host: Tensor

    def __len__(self) -> int:
        """Number of queries."""
        return len(self.scene)

    def take(self, queries: Tensor | slice) -> "ClosestPointQueries":
        """Selects queries by index, mask or slice."""
        return ClosestPointQueries(self.scene[queries], self.guest[queries], self.host[queries])


def posed_distance(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, queries: ClosestPointQueries, points: Tensor
) -> Tensor:
    """Computes D_host at one point of each guest, differentiable with respect to the poses.

    Args:
        poses: (B, N, 4) float32 or float64, metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        queries: The pairs of objects, E of them.
        points: One point per query, (E, 3), metres, yaw frame of the guest.

    Returns:
        Distances, (E,), metres, negative inside.
    """
    turn, offset = in_host(poses, queries)
    c, s = turn.cos(), turn.sin()
    x, y, z = points.to(poses.dtype).unbind(1)
    local = torch.stack([c * x - s * y, s * x + c * y, z], dim=1) + offset
    return geometry.signed_distance(batch.shape_index[queries.scene, queries.host], local)


@torch.no_grad()
def closest_sample(
    poses: Tensor,
    batch: LayoutBatch,
    geometry: ShapeTensors,
    queries: ClosestPointQueries,
    samples: Tensor,
    limit: Tensor,
    *,
    is_unsigned: bool = False,
) -> tuple[Tensor, Tensor]:
    """Finds the sample of each guest with the smallest distance to its host; the first of equal ones.

    Args:
        poses: (B, N, 4) float32 or float64, metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        queries: The pairs of objects, E of them.
        samples: Samples of every shape, (K, P, 3) float32, metres, yaw frame.
        limit: Only smaller distances count, (E,), metres, not negative.
        is_unsigned: Whether the distance is |D| instead of D.

    Returns:
        The index of the sample, (E,) int64, and its distance, (E,), metres: inf if none is below the limit.
    """
    num_samples = samples.shape[1]
    size = max(1, _SAMPLES_AT_ONCE // max(1, num_samples))
    found = [
        _closest(poses, batch, geometry, queries.take(part), samples, limit[part], is_unsigned)
        for part in (slice(start, start + size) for start in range(0, len(queries), size))
    ]
    if not found:
        return torch.zeros_like(queries.scene), torch.zeros_like(queries.scene, dtype=poses.dtype)
    return torch.cat([sample for sample, _ in found]), torch.cat([distance for _, distance in found])


def _closest(
    poses: Tensor,
    batch: LayoutBatch,
    geometry: ShapeTensors,
    queries: ClosestPointQueries,
    samples: Tensor,
    limit: Tensor,
    is_unsigned: bool,
) -> tuple[Tensor, Tensor]:
    query, sample, distance = near_samples(poses, batch, geometry, queries, samples, limit, is_unsigned=is_unsigned)
    # Samples per query differ in number after the filter: scatter_reduce replaces a minimum over a padded matrix.
    smallest = torch.full_like(limit, torch.inf).scatter_reduce(0, query, distance, "amin")
    is_smallest = distance == smallest[query]  # "amin" of sample indices below: the first of equal samples, on any device
    first = torch.full_like(queries.scene, samples.shape[1] - 1)
    return first.scatter_reduce(0, query[is_smallest], sample[is_smallest], "amin"), smallest


@torch.no_grad()
def near_samples(
    poses: Tensor,
    batch: LayoutBatch,
    geometry: ShapeTensors,
    queries: ClosestPointQueries,
    samples: Tensor,
    limit: Tensor,
    *,
    is_unsigned: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Finds all samples of each guest that are nearer to its host than a limit; arguments as for :func:`closest_sample`.

    Returns:
        The query, the sample, (S,) int64 each, and its distance, (S,), metres.
    """
    host = batch.shape_index[queries.scene, queries.host]
    grid_index, factor = geometry.grid_index[host], geometry.metres_per_unit[host].to(poses.dtype)
    low, high = (corner.to(poses.dtype) for corner in geometry.atlas.box(grid_index))
    slack = (limit / factor)[:, None]
    # A sample that is outside the grid's box by more than the limit is farther from the surface than the limit: not read.
    axes = _samples_in_host(poses, batch, geometry, queries, samples)  # 3 x (E, P)
    is_near = torch.ones_like(axes[0], dtype=torch.bool)
    for axis, values in enumerate(axes):
        is_near &= (values >= low[:, axis, None] - slack) & (values <= high[:, axis, None] + slack)
    query, sample = is_near.nonzero(as_tuple=True)
    units = geometry.atlas.sample(grid_index[query], torch.stack([values[query, sample] for values in axes], dim=1))
    distance = factor[query] * (units.abs() if is_unsigned else units)
    counts = distance < limit[query]
    return query[counts], sample[counts], distance[counts]


def _samples_in_host(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, queries: ClosestPointQueries, samples: Tensor
) -> list[Tensor]:
    """Transforms samples of the guests to the unit frame of their hosts' grids: x, y and z, (E, P) each."""
    turn, offset = in_host(poses, queries)
    c, s = turn.cos(), turn.sin()
    affine = geometry.unit_from_yaw[batch.shape_index[queries.scene, queries.host]].to(poses.dtype)
    x, y, z = samples[batch.shape_index[queries.scene, queries.guest]].to(poses.dtype).unbind(2)
    axes = []
    for row in affine.unbind(1):
        along_x, along_y = row[:, 0] * c + row[:, 1] * s, row[:, 1] * c - row[:, 0] * s
        start = (row[:, :3] * offset).sum(dim=1) + row[:, 3]
        # No matrix product: some devices compute it with less than float32 precision (TF32).
        values = torch.addcmul(start[:, None], x, along_x[:, None])
        axes.append(values.addcmul_(y, along_y[:, None]).addcmul_(z, row[:, 2, None]))
    return axes


def in_host(poses: Tensor, queries: ClosestPointQueries) -> tuple[Tensor, Tensor]:
    """Returns the guest's pose in the host's yaw frame: yaw (E,) and position (E, 3)."""
    guest, host = poses[queries.scene, queries.guest], poses[queries.scene, queries.host]
    x, y, z = (guest[:, :3] - host[:, :3]).unbind(1)
    c, s = host[:, 3].cos(), host[:, 3].sin()
    return guest[:, 3] - host[:, 3], torch.stack([c * x + s * y, c * y - s * x, z], dim=1)
