"""Where one object is deepest in another, or nearest to its surface: a search over samples, then one differentiable distance.

The paper's distances are minima over samples, and the gradient of a minimum is that of the sample it is taken at. So all
samples are looked at without a graph, those outside the other's grid not even read, and only the one that counts is evaluated
again with
gradients: memory does not grow with the number of samples.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeTensors

_SAMPLES_AT_ONCE = 1 << 21
"""How many samples are looked at together: what the search holds in memory at most, some 100 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPointQueries:
    """Samples of one object asked in another object of the same scene, E times.

    Attributes:
        scene: (E,) int64.
        guest: Place of the object that is sampled, (E,) int64.
        host: Place of the object whose distance is asked, (E,) int64.
    """

    scene: Tensor
    guest: Tensor
    host: Tensor

    def __len__(self) -> int:
        """Number of queries."""
        return len(self.scene)

    def take(self, queries: Tensor | slice) -> "ClosestPointQueries":
        """Some of the queries, by index, mask or slice."""
        return ClosestPointQueries(self.scene[queries], self.guest[queries], self.host[queries])


def posed_distance(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, queries: ClosestPointQueries, points: Tensor
) -> Tensor:
    """D_host at points of the guests, differentiable with respect to the poses.

    Args:
        poses: (B, N, 4) float32 or float64, metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        queries: Which objects, E of them.
        points: One point each, (E, 3), metres, yaw frame of the guest.

    Returns:
        Distances, (E,), metres, negative inside.
    """
    turn, offset = _in_host(poses, queries)
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
    """The sample of each guest with the smallest distance to its host; the first of several.

    Args:
        poses: (B, N, 4) float32 or float64, metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        queries: Which objects, E of them.
        samples: Of every shape, (K, P, 3) float32, metres, yaw frame.
        limit: Distances from this on do not count, (E,), metres, not negative.
        is_unsigned: Distance to the surface, |D|, instead of D.

    Returns:
        The sample, (E,) int64, and its distance, (E,), metres: inf where none is below the limit.
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
    host = batch.shape_index[queries.scene, queries.host]
    grid_index, factor = geometry.grid_index[host], geometry.metres_per_unit[host].to(poses.dtype)
    low, high = (corner.to(poses.dtype) for corner in geometry.atlas.box(grid_index))
    slack = (limit / factor)[:, None]
    # In the unit frame, a row of coordinates an axis: what lies outside the grid by the limit is at least that far away.
    places = _places(poses, batch, geometry, queries, samples)  # 3 x (E, P)
    is_near = torch.ones_like(places[0], dtype=torch.bool)
    for axis, place in enumerate(places):
        is_near &= (place >= low[:, axis, None] - slack) & (place <= high[:, axis, None] + slack)
    query, sample = is_near.nonzero(as_tuple=True)
    read = geometry.atlas.sample(grid_index[query], torch.stack([place[query, sample] for place in places], dim=1))
    distance = factor[query] * (read.abs() if is_unsigned else read)
    counts = distance < limit[query]
    query, sample, distance = query[counts], sample[counts], distance[counts]
    smallest = torch.full_like(limit, torch.inf).scatter_reduce(0, query, distance, "amin")
    is_smallest = distance == smallest[query]
    first = torch.full_like(host, samples.shape[1] - 1).scatter_reduce(0, query[is_smallest], sample[is_smallest], "amin")
    return first, smallest


def _places(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, queries: ClosestPointQueries, samples: Tensor
) -> list[Tensor]:
    """Samples of the guests in the unit frame of their hosts' grids, x, y and z, (E, P) each."""
    turn, offset = _in_host(poses, queries)
    c, s = turn.cos(), turn.sin()
    affine = geometry.unit_from_yaw[batch.shape_index[queries.scene, queries.host]].to(poses.dtype)
    x, y, z = samples[batch.shape_index[queries.scene, queries.guest]].to(poses.dtype).unbind(2)
    places = []
    for row in affine.unbind(1):
        along_x, along_y = row[:, 0] * c + row[:, 1] * s, row[:, 1] * c - row[:, 0] * s
        start = (row[:, :3] * offset).sum(dim=1) + row[:, 3]
        # No matrix product: on some devices its arithmetic is shorter than float32.
        place = torch.addcmul(start[:, None], x, along_x[:, None])
        places.append(place.addcmul_(y, along_y[:, None]).addcmul_(z, row[:, 2, None]))
    return places


def _in_host(poses: Tensor, queries: ClosestPointQueries) -> tuple[Tensor, Tensor]:
    """Pose of the guest in the host's yaw frame: yaw (E,) and position (E, 3)."""
    guest, host = poses[queries.scene, queries.guest], poses[queries.scene, queries.host]
    x, y, z = (guest[:, :3] - host[:, :3]).unbind(1)
    c, s = host[:, 3].cos(), host[:, 3].sin()
    return guest[:, 3] - host[:, 3], torch.stack([c * x + s * y, c * y - s * x, z], dim=1)
