"""The corrector's loss step, against ``grid_sample`` with one grid a pair.

``python -m benchmarks.corrector_losses RUN DATASET [--batch N] [--device cuda] [--json FILE]``, where RUN was preprocessed from
DATASET. The scenes are perturbed until objects collide and float. One step is L_obj-obj and L_sup of a batch with their
gradients. Both sides read the same grids, resampled to 32 nodes an axis, because ``grid_sample`` needs grids of one shape:

- one grid a pair: for every ordered pair of a scene the grid is copied, all samples are read with gradients, and minima taken;
- the same for the pairs of the broad phase;
- ours on these grids, and on the original, finer grids.
"""

import argparse
import ctypes
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from models.physics_corrector.geometry.broad_phase import ObjectPairs, near_pairs
from models.physics_corrector.geometry.closest_point import ClosestPointQueries
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from models.physics_corrector.geometry.shape_tensors import ShapeCollector, ShapeTensors, grids_from_rows
from models.physics_corrector.training.losses import (
    LossSettings,
    colliding_pairs,
    object_object_loss,
    support_candidates,
    support_loss,
)
from stable_data.assets.store import AssetStore
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.torch_dataset import TableDataset

NUM_NODES = 32
_SHAKEN = (0.02, 0.02, 0.005, 0.3)  # standard deviations of x, y, z in metres and of yaw in radians


@dataclass(frozen=True, slots=True)
class LossFigure:
    """The figures of one way of computing a step.

    Attributes:
        name: The way.
        num_scenes: Scenes in the batch.
        num_objects: Objects in the batch.
        num_pairs: Unordered pairs whose grids are read for collision.
        seconds: Time of a step, median.
        mebibytes: Peak memory of a step, without the memory used before.
        speedup: Speed relative to one grid a pair.
        memory_ratio: Memory of one grid a pair, divided by this.
    """

    name: str
    num_scenes: int
    num_objects: int
    num_pairs: int
    seconds: float
    mebibytes: float
    speedup: float
    memory_ratio: float


def copied_distance(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, queries: ClosestPointQueries, samples: Tensor
) -> Tensor:
    """Computes D_host at all samples of the guests by ``grid_sample``, with a copy of the grid for every query, (E, P), metres.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes, all grids with the same number of nodes along each axis.
        queries: E pairs of host and guest.
        samples: Samples of every shape, (K, P, 3), metres, yaw frame.
    """
    guest, host = poses[queries.scene, queries.guest], poses[queries.scene, queries.host]
    shape = batch.shape_index[queries.scene, queries.host]
    points = samples[batch.shape_index[queries.scene, queries.guest]].to(poses.dtype)
    world = torch.einsum("eij,epj->epi", _rotation_about_z(guest[:, 3]), points) + guest[:, None, :3]
    local = torch.einsum("eij,epj->epi", _rotation_about_z(-host[:, 3]), world - host[:, None, :3])
    affine = geometry.unit_from_yaw[shape].to(poses.dtype)
    places = torch.einsum("eij,epj->epi", affine[..., :3], local) + affine[:, None, :, 3]
    grid_index = geometry.grid_index[shape]
    low, high = (corner[:, None].to(poses.dtype) for corner in geometry.atlas.box(grid_index))
    inside = places.clamp(low, high)
    cubes = geometry.atlas.values.view(len(geometry.atlas), *geometry.atlas.shape[0].tolist())
    copies = cubes[grid_index, None].to(poses.dtype)
    where = (2 * (inside - low) / (high - low) - 1).flip(-1)[:, :, None, None]  # grid_sample expects z, y, x
    read = torch.nn.functional.grid_sample(copies, where, align_corners=True)[:, 0, :, 0, 0]
    distance: Tensor = geometry.metres_per_unit[shape, None] * (read + torch.linalg.vector_norm(places - inside, dim=-1))
    return distance


def copied_losses(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, pairs: ObjectPairs, settings: LossSettings
) -> Tensor:
    """Computes the weighted sum of L_obj-obj and L_sup, (B,), square metres, from :func:`copied_distance`."""
    ways = pairs.both_ways()
    queries = ClosestPointQueries(ways.scene, ways.first, ways.second)
    deepest = copied_distance(poses, batch, geometry, queries, geometry.surface).amin(dim=1).view(2, -1).amin(dim=0)
    collision = poses.new_zeros(len(poses)).index_add(0, pairs.scene, (-deepest).clamp_min(0).square())
    queries = support_candidates(poses.detach(), batch, settings.support_reach)
    nearest = copied_distance(poses, batch, geometry, queries, geometry.bottom).abs().amin(dim=1)
    gap = (poses[..., 2, None] + geometry.bottom[batch.shape_index][..., 2]).abs().amin(dim=2)
    slot = queries.scene * gap.shape[1] + queries.guest
    gap = gap.flatten().scatter_reduce(0, slot, nearest, "amin").view_as(gap)
    excess = torch.where(batch.is_movable, (gap - settings.contact_tolerance).clamp_min(0), 0)
    return settings.sdf_weight * collision + settings.support_weight * excess.square().sum(dim=1)


def our_losses(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, settings: LossSettings) -> Tensor:
    """Computes the same sum by the library."""
    collision = object_object_loss(poses, batch, geometry, colliding_pairs(poses, batch, geometry))
    return settings.sdf_weight * collision + settings.support_weight * support_loss(poses, batch, geometry, settings)


def all_pairs(poses: Tensor, batch: LayoutBatch) -> ObjectPairs:
    """Returns every pair of every scene."""
    return near_pairs(poses, torch.full_like(batch.sizes, 1e3), batch.mask)


def with_cubes(geometry: ShapeTensors, num_nodes: int = NUM_NODES) -> ShapeTensors:
    """Returns the same shapes on grids of the same number of nodes along each axis."""
    atlas = geometry.atlas
    low, high = atlas.box(torch.arange(len(atlas)))
    spacing = (high - low).amax(dim=1) / (num_nodes - 1)
    axis = torch.arange(num_nodes, dtype=torch.float32)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    values = [
        atlas.sample(torch.full((len(nodes),), g), low[g] + spacing[g] * nodes).to(torch.float16) for g in range(len(atlas))
    ]
    shape = torch.full((len(atlas), 3), num_nodes)
    cubes = SdfAtlas(torch.cat(values), torch.arange(len(atlas)) * num_nodes**3, shape, low, spacing)
    return replace(geometry, atlas=cubes)


def read_batch(run: str, dataset: MesaTaskDataset, num_scenes: int) -> tuple[LayoutBatch, ShapeTensors]:
    """Returns scenes of a run, spread evenly over it and perturbed; repeated if the run has fewer."""
    scenes = TableDataset(run)
    chosen = [scenes[k * len(scenes) // num_scenes] for k in range(num_scenes)]
    used = {o.asset_id for scene in chosen for o in scene.objects}
    names, rows = TableDataset(run, "sdf", columns=["asset_id"]), TableDataset(run, "sdf")
    grids = grids_from_rows(rows[k] for k in range(len(rows)) if names[k]["asset_id"] in used)
    shapes = ShapeCollector(AssetStore(dataset), grids=grids)
    batch = LayoutBatch.from_scenes(chosen, shapes)
    noise = torch.randn(batch.poses.shape, generator=torch.Generator().manual_seed(0)) * torch.tensor(_SHAKEN)
    return replace(batch, poses=batch.poses + noise * batch.mask[..., None]), shapes.geometry()


def measure(step: Callable[[Tensor], Tensor], poses: Tensor, repeats: int) -> tuple[float, float]:
    """Measures the median seconds of a step with its gradients, and its peak memory in mebibytes."""
    seconds = []
    is_cuda = poses.is_cuda
    before = _reset_peak(is_cuda)
    for _ in range(1 + repeats):
        moving = poses.clone().requires_grad_()
        start = time.perf_counter() if is_cuda else time.process_time()
        step(moving).sum().backward()  # type: ignore[no-untyped-call]
        if is_cuda:
            torch.cuda.synchronize()
        seconds.append((time.perf_counter() if is_cuda else time.process_time()) - start)
    return statistics.median(seconds[1:]), (_peak(is_cuda) - before) / 2**20


def run(batch: LayoutBatch, geometry: ShapeTensors, repeats: int) -> list[LossFigure]:
    """Measures every way of computing a step, the reference first."""
    settings, cubes = LossSettings(), with_cubes(geometry).to(batch.mask.device)
    geometry = geometry.to(batch.mask.device)
    every, near = all_pairs(batch.poses, batch), colliding_pairs(batch.poses, batch, geometry)
    ways: list[tuple[str, int, Callable[[Tensor], Tensor]]] = [
        ("one grid a pair", len(every), lambda p: copied_losses(p, batch, cubes, every, settings)),
        (
            "one grid a pair, near pairs",
            len(near),
            lambda p: copied_losses(p, batch, cubes, colliding_pairs(p, batch, cubes), settings),
        ),
        ("ours", len(near), lambda p: our_losses(p, batch, cubes, settings)),
        ("ours, grids as they are", len(near), lambda p: our_losses(p, batch, geometry, settings)),
    ]
    figures: list[LossFigure] = []
    for name, num_pairs, step in ways:
        seconds, mebibytes = measure(step, batch.poses, repeats)
        first = figures[0] if figures else None
        figures.append(
            LossFigure(
                name=name,
                num_scenes=len(batch),
                num_objects=int(batch.mask.sum()),
                num_pairs=num_pairs,
                seconds=seconds,
                mebibytes=mebibytes,
                speedup=first.seconds / seconds if first else 1.0,
                memory_ratio=first.mebibytes / max(mebibytes, 1e-3) if first else 1.0,
            )
        )
    return figures


def _rotation_about_z(yaw: Tensor) -> Tensor:
    """Returns rotations about z, (E, 3, 3)."""
    c, s, zero, one = yaw.cos(), yaw.sin(), torch.zeros_like(yaw), torch.ones_like(yaw)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).view(-1, 3, 3)


def _reset_peak(is_cuda: bool) -> int:
    """Resets the peak of memory, and returns the number of bytes in use."""
    if is_cuda:
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    ctypes.CDLL(None).malloc_trim(0)  # else a step could use memory that was freed before, and the peak would not show it
    Path("/proc/self/clear_refs").write_text("5")
    return _peak(is_cuda)


def _peak(is_cuda: bool) -> int:
    """Returns the largest number of bytes in use since the peak was reset."""
    if is_cuda:
        return torch.cuda.max_memory_allocated()
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder")
    parser.add_argument("dataset", type=Path, help="the folder from which it was preprocessed")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--batch", type=int, default=16, help="scenes of a step")
    parser.add_argument("--repeats", type=int, default=5, help="steps that are timed")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    batch, geometry = read_batch(arguments.run, MesaTaskDataset(arguments.dataset), arguments.batch)
    figures = run(batch.to(arguments.device), geometry, arguments.repeats)
    print(f"{arguments.batch} scenes, {figures[0].num_objects} objects, {arguments.device}")
    print(f"{'loss step':30} {'pairs':>7} {'ms':>10} {'MiB':>9} {'faster':>8} {'smaller':>8}")
    for f in figures:
        times = f"{1e3 * f.seconds:10.1f} {f.mebibytes:9.1f} {f.speedup:7.1f}x {f.memory_ratio:7.1f}x"
        print(f"{f.name:30} {f.num_pairs:7} {times}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(f) for f in figures], indent=1) + "\n")


if __name__ == "__main__":
    main()
