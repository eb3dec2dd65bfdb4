"""Plain penalty descent: Adam on the poses, with sampled signed distances of the meshes and a weak pull to the start.

    Σ_{i≠j} Σ_q∈Q_i max(0, −D_j(q))² + anchor · |p − p⁰|² + excess over the table edge

Without learning and search: the result of gradients alone. Every sample counts, not only the deepest one as in the corrector's
losses: the gradient at the deepest sample of a flat object points up, and heights are fixed here.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.baselines.outcome import BaselineResult
from models.physics_corrector.geometry.closest_point import ClosestPointQueries, posed_distance
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeCollector, ShapeTensors
from models.physics_corrector.training.losses import bounds_loss, colliding_pairs
from stable_data.assets.store import AssetStore
from stable_data.geometry.shape import Shape
from stable_data.rotations import YAW_ARM
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True)
class PenaltyDescent:
    """Adam on x, y and yaw.

    Attributes:
        num_steps: Number of steps; the learning rate falls to 0 along a cosine.
        learning_rate: About the length of the first step, metres and radians.
        anchor_weight: Weight of the squared distance to the start; squared depths have weight 1.
        bounds_weight: Weight of the excess over the table edge or into the restricted zone.
        num_samples: Surface samples of a shape.
        tolerance: Deepest sampled overlap that counts as none, metres.
    """

    num_steps: int = 300
    learning_rate: float = 2e-3
    anchor_weight: float = 1e-3
    bounds_weight: float = 1.0
    num_samples: int = 256
    tolerance: float = 5e-4

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Optimises the poses; see :class:`~models.baselines.outcome.Baseline`. Converged: no sample is deeper than the tolerance."""
        table = ShapeCollector(store, num_surface=self.num_samples)
        batch = LayoutBatch.from_scenes([scene], table)
        geometry = table.geometry()
        begin = time.process_time()
        end = self._optimise(torch.from_numpy(scene.poses())[None], batch, geometry)
        depth = float(depths(end, batch, geometry).amax())
        seconds = time.process_time() - begin
        reason = "" if depth <= self.tolerance else f"a sample remains {1e3 * depth:.2f} mm deep"
        return BaselineResult(scene.with_poses(end[0].numpy()), not reason, seconds, reason)

    def _optimise(self, start: Tensor, batch: LayoutBatch, geometry: ShapeTensors) -> Tensor:
        """Returns the poses (1, N, 4) after all steps."""
        origin, height = start[..., [0, 1, 3]], start[..., 2:3]
        moving = origin.clone().requires_grad_()
        adam = torch.optim.Adam([moving], lr=self.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.num_steps)
        pull = self.anchor_weight * start.new_tensor([1.0, 1.0, YAW_ARM**2])
        for _ in range(self.num_steps):
            adam.zero_grad()
            poses = torch.cat([moving[..., :2], height, moving[..., 2:]], dim=-1)
            loss = depths(poses, batch, geometry).square().sum() + (pull * (moving - origin).square()).sum()
            if self.bounds_weight:
                loss = loss + self.bounds_weight * bounds_loss(poses, batch, geometry).sum()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
            schedule.step()
        end = moving.detach()
        return torch.cat([end[..., :2], height, end[..., 2:]], dim=-1)


def depths(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors) -> Tensor:
    """Computes the depth of samples of near objects in each other, (1 + M,), metres, 0 outside; the first entry is 0.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
    """
    ways = colliding_pairs(poses.detach(), batch, geometry).both_ways()
    num_samples = geometry.surface.shape[1]
    each = torch.arange(len(ways)).repeat_interleave(num_samples)
    points = geometry.surface[batch.shape_index[ways.scene, ways.first]].reshape(-1, 3)
    queries = ClosestPointQueries(ways.scene, ways.first, ways.second).take(each)
    depth = (-posed_distance(poses, batch, geometry, queries, points)).clamp_min(0)
    return torch.cat([poses.new_zeros(1), depth])
