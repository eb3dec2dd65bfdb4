"""Plain penalty descent: Adam on the poses, against the corrector's own collision losses, with a weak pull to the start.

No learning and no search: what gradients of sampled signed distances do by themselves. Heights stay.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from models.baselines.outcome import Outcome, with_poses
from models.physics_corrector.batch import SceneBatch
from models.physics_corrector.geometry import ShapeTable
from models.physics_corrector.losses import LossSettings, bounds, colliding_pairs, object_object
from stable_data.assets import AssetStore
from stable_data.scene import Scene
from stable_data.shape import Shape

_YAW_ARM = 0.1  # metres a radian, of the pull to the start


@dataclass(frozen=True, slots=True)
class PenaltyDescent:
    """Adam on x, y and yaw.

    Attributes:
        num_steps: Steps; the rate falls to 0 over them along a cosine.
        learning_rate: Metres and radians: about how far the first step goes.
        anchor_weight: Of the squared distance to the start, beside squared depths.
        bounds_weight: Of what reaches over the table's edge or into the restricted zone, beside squared depths.
        num_samples: Surface samples of a shape.
        tolerance: Deepest sampled overlap that counts as none, metres.
        losses: How collisions are measured.
    """

    num_steps: int = 300
    learning_rate: float = 2e-3
    anchor_weight: float = 1e-3
    bounds_weight: float = 1.0
    num_samples: int = 256
    tolerance: float = 5e-4
    losses: LossSettings = field(default_factory=LossSettings)

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> Outcome:
        """Descends; see :class:`~models.baselines.outcome.Method`. Converged: no sample is deeper than the tolerance."""
        table = ShapeTable(store, num_surface=self.num_samples)
        batch, begin = SceneBatch.from_scenes([scene], table), 0.0
        geometry = table.geometry()
        begin = time.perf_counter()
        start = torch.from_numpy(scene.poses())[None]
        moving = start[..., [0, 1, 3]].clone().requires_grad_()
        adam = torch.optim.Adam([moving], lr=self.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.num_steps)
        pull = self.anchor_weight * start.new_tensor([1.0, 1.0, _YAW_ARM**2])

        def poses() -> torch.Tensor:
            return torch.cat([moving[..., :2], start[..., 2:3], moving[..., 2:]], dim=-1)

        def overlap(at: torch.Tensor) -> torch.Tensor:
            pairs = colliding_pairs(at, batch, geometry, self.losses.clearance)
            return object_object(at, batch, geometry, pairs, self.losses.clearance).sum()

        for _ in range(self.num_steps):
            adam.zero_grad()
            at = poses()
            loss = overlap(at) + (pull * (moving - start[..., [0, 1, 3]]).square()).sum()
            if self.bounds_weight:
                loss = loss + self.bounds_weight * bounds(at, batch, geometry).sum()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
            schedule.step()
        with torch.no_grad():
            end, depth = poses(), float(overlap(poses()).sqrt())  # the root of the sum of squares: at least the deepest
        seconds = time.perf_counter() - begin
        reason = "" if depth <= self.tolerance else f"samples remain {1e3 * depth:.2f} mm deep, root of the sum of squares"
        return Outcome(with_poses(scene, end[0].numpy()), depth <= self.tolerance, seconds, reason)
