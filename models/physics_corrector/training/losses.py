"""The corrector's objective: L_PC = L_flow + λ_sdf (L_obj-obj + L_obj-table) + λ_sup L_sup, of the paper's Method.

The physical terms are functions of the predicted clean poses, in metres and radians, one figure a scene. Objects that are fixed
are obstacles: no gradient reaches them, and what fixed objects do to each other does not count.

Where the paper leaves something open:

* dist_sdf(i, j) samples i and asks j. Which of a pair is i would depend on the order of the objects, so both are asked and the
  deeper answer counts.
* The lengths are squared in the unit ``length_unit``, by default the centimetre, which the paper's thresholds and MesaTask's
  layouts are in: λ means something only together with it.
* τ, the tabletop, is the half-space below z = 0, and what is deepest in it is the lowest point of the box.
* S_i are the tabletop and the objects whose yawed box lies over or around i's when i is lowered by ``support_reach``, but for
  those whose bottom is higher than i's: what i carries does not carry i.

Extras, off by default, keep footprints on the table and out of the restricted zone, and sampled poses near the coarse layout
(:mod:`~models.physics_corrector.training.movement_losses`).
"""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from models.physics_corrector.geometry.broad_phase import ObjectPairs, near_pairs
from models.physics_corrector.geometry.closest_point import ClosestPointQueries, closest_sample, posed_distance
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import STRETCH, ShapeTensors
from models.settings import NonNegative, Positive, Settings

_HIGHER = 5e-3  # a support's bottom is not higher than the bottom it carries, but for this much, metres


@dataclass(frozen=True, slots=True)
class LossSettings(Settings):
    """Weights and tolerances; the defaults are the paper's preset."""

    sdf_weight: NonNegative = 0.02
    """λ_sdf, the weight of L_obj-obj + L_obj-table."""

    support_weight: NonNegative = 0.01
    """λ_sup, the weight of L_sup."""

    flow_weight: NonNegative = 1.0
    """Weight of L_flow; 1 in the paper."""

    object_factor: NonNegative = 1.0
    """Factor of L_obj-obj; 1 in the paper, 0 in its ablation."""

    table_factor: NonNegative = 1.0
    """Factor of L_obj-table; 1 in the paper, 0 in its ablation."""

    bounds_weight: NonNegative = 0.0
    """Weight of a loss for objects over the table's edge or in the restricted zone; not in the paper."""

    move_weight: NonNegative = 0.0
    """Weight of the movement of sampled poses, per ``length_unit``; not in the paper."""

    order_weight: NonNegative = 0.0
    """Weight of the directional relations that sampled poses break; not in the paper."""

    length_unit: Positive = 0.01
    """Metres; the unit in which lengths are squared."""

    clearance: NonNegative = 0.0
    """Metres; objects closer than this count as colliding. 0 in the paper."""

    contact_tolerance: NonNegative = 5e-4
    """Metres; ε of L_sup, the paper's threshold of floating."""

    support_reach: NonNegative = 0.1
    """Metres; how far below an object a support is looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class PhysicsLosses:
    """The physical terms, unweighted.

    Attributes:
        object_object: L_obj-obj, (B,).
        object_table: L_obj-table, (B,).
        support: L_sup, (B,).
        bounds: The extra, (B,); zeros where its weight is 0.
    """

    object_object: Tensor
    object_table: Tensor
    support: Tensor
    bounds: Tensor

    def weighted(self, settings: LossSettings) -> Tensor:
        """λ_sdf (L_obj-obj + L_obj-table) + λ_sup L_sup, and the extra, (B,)."""
        collision = settings.object_factor * self.object_object + settings.table_factor * self.object_table
        return settings.sdf_weight * collision + settings.support_weight * self.support + settings.bounds_weight * self.bounds


def flow_loss(velocity: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """L_flow: ‖v_θ − (x_1 − x_0)‖² of an object, mean over the objects of all scenes.

    Args:
        velocity: v_θ, (B, N, D), in whichever coordinates the flow runs.
        target: x_1 − x_0, (B, N, D).
        mask: Objects that count, (B, N) bool: those that may move.

    Returns:
        A scalar, float32 or float64; 0 where no object counts.
    """
    # The padding is taken out before the square: nothing in it, not even nan, may reach a gradient.
    difference = torch.where(mask[..., None], velocity.to(target.dtype) - target, 0)
    return difference.square().sum() / mask.sum().clamp_min(1)


def physics_losses(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, settings: LossSettings = LossSettings()
) -> PhysicsLosses:
    """All physical terms of predicted clean poses.

    Args:
        poses: x̂_1, x, y, z in metres and yaw in radians, world frame, (B, N, 4); float64 stays, anything else becomes float32:
            bfloat16 would round a metre to millimetres.
        batch: The scenes; its own poses are not read.
        geometry: Their shapes.
        settings: Weights and tolerances.

    Returns:
        The terms, one figure a scene.
    """
    with torch.autocast(poses.device.type, enabled=False):
        poses = poses if poses.dtype == torch.float64 else poses.float()
        poses = torch.where(batch.mask[..., None], poses, 0)
        poses = torch.where(batch.is_fixed[..., None], poses.detach(), poses)
        terms = PhysicsLosses(
            object_object_loss(
                poses, batch, geometry, colliding_pairs(poses, batch, geometry, settings.clearance), settings.clearance
            ),
            object_table_loss(poses, batch),
            support_loss(poses, batch, geometry, settings),
            bounds_loss(poses, batch, geometry) if settings.bounds_weight else poses.new_zeros(len(poses)),
        )
    return PhysicsLosses(*(getattr(terms, field.name) / settings.length_unit**2 for field in fields(terms)))


def colliding_pairs(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, clearance: float = 0.0) -> ObjectPairs:
    """Pairs that may be closer than a clearance: all that can contribute to `object_object`, and few more.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        clearance: Metres.
    """
    half = batch.sizes / 2
    if len(geometry):
        half = half + (geometry.reach[batch.shape_index] + STRETCH * clearance)[..., None]
    pairs = near_pairs(poses, half.to(poses.dtype), batch.mask)
    is_fixed = batch.is_fixed[pairs.scene, pairs.first] & batch.is_fixed[pairs.scene, pairs.second]
    return pairs.take(~is_fixed)


def object_object_loss(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, pairs: ObjectPairs, clearance: float = 0.0
) -> Tensor:
    """L_obj-obj: Σ_{i<j} max(0, −dist_sdf(i, j))².

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        pairs: Those that may contribute.
        clearance: Added to every depth, metres.

    Returns:
        (B,), square metres.
    """
    ways = pairs.both_ways()
    queries = ClosestPointQueries(ways.scene, ways.first, ways.second)
    limit = poses.new_full((len(queries),), clearance)
    sample, distance = closest_sample(poses, batch, geometry, queries, geometry.surface, limit)
    depth = (clearance - distance).clamp_min(0).reshape(2, -1)
    # The deeper way alone is evaluated again; equal ones share the gradient.
    counts = ((depth > 0) & (depth == depth.amax(dim=0))).reshape(-1)
    share = 1 / counts.reshape(2, -1).sum(dim=0).clamp_min(1).repeat(2)[counts]
    queries = queries.take(counts)
    points = geometry.surface[batch.shape_index[queries.scene, queries.guest], sample[counts]]
    deepest = (clearance - posed_distance(poses, batch, geometry, queries, points)).clamp_min(0)
    return poses.new_zeros(len(poses)).index_add(0, queries.scene, share * deepest.square())


def object_table_loss(poses: Tensor, batch: LayoutBatch) -> Tensor:
    """L_obj-table: Σ_i max(0, −dist_sdf(i, τ))², (B,), square metres.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
    """
    sunk = (batch.sizes[..., 2] / 2 - poses[..., 2]).clamp_min(0)
    return torch.where(batch.is_movable, sunk, 0).square().sum(dim=1)


def support_candidates(poses: Tensor, batch: LayoutBatch, reach: float) -> ClosestPointQueries:
    """The objects of S_i, for every object i that may move; the tabletop comes on top.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        reach: How far below an object a support is looked for, metres.

    Returns:
        Each with i as the guest and the candidate as the host.
    """
    half = (batch.sizes / 2).to(poses.dtype)
    raised = half + half.new_tensor([0.0, 0.0, reach / 2])
    ways = near_pairs(poses, raised, batch.mask).both_ways()
    upper, lower = (ways.scene, ways.first), (ways.scene, ways.second)
    bottom, top = poses[..., 2] - half[..., 2], poses[..., 2] + half[..., 2]
    is_below = (bottom[lower] <= bottom[upper] + _HIGHER) & (top[lower] >= bottom[upper] - reach)
    ways = ways.take(is_below & batch.is_movable[upper])
    return ClosestPointQueries(ways.scene, ways.first, ways.second)


def support_loss(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, settings: LossSettings = LossSettings()) -> Tensor:
    """L_sup: Σ_i max(0, gap(i, z_i) − ε)², gap(i, z_i) = min_s∈S_i min_b∈B_i |D_s(b)|.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        settings: ε, and how supports are looked for.

    Returns:
        (B,), square metres.
    """
    scene, place = batch.is_movable.nonzero(as_tuple=True)
    bottom = geometry.bottom[batch.shape_index[scene, place]].to(poses.dtype)  # (M, Q, 3)
    lowest = bottom[..., 2].detach()[
        torch.arange(len(scene), device=scene.device), _nearest_to_plane(poses, scene, place, bottom)
    ]
    gap = (poses[scene, place, 2] + lowest).abs()  # |D_τ|
    floating = gap.detach() > settings.contact_tolerance
    scene, place, gap = scene[floating], place[floating], gap[floating]
    queries = support_candidates(poses.detach(), batch, settings.support_reach)
    asked_by = torch.full_like(batch.parent, -1)
    asked_by[scene, place] = torch.arange(len(scene), device=scene.device)
    asking = asked_by[queries.scene, queries.guest]
    queries, asking = queries.take(asking >= 0), asking[asking >= 0]
    sample, distance = closest_sample(poses, batch, geometry, queries, geometry.bottom, gap.detach()[asking], is_unsigned=True)
    best = torch.full_like(gap.detach(), torch.inf).scatter_reduce(0, asking, distance, "amin")
    nearest = torch.where(distance == best[asking], torch.arange(len(queries), device=asking.device), len(queries))
    chosen = torch.full_like(scene, len(queries)).scatter_reduce(0, asking, nearest, "amin")
    on_object = best < torch.inf
    chosen = chosen[on_object]
    queries = queries.take(chosen)
    points = geometry.bottom[batch.shape_index[queries.scene, queries.guest], sample[chosen]]
    gap = gap.masked_scatter(on_object, posed_distance(poses, batch, geometry, queries, points).abs())
    excess = (gap - settings.contact_tolerance).clamp_min(0)
    return poses.new_zeros(len(poses)).index_add(0, scene, excess.square())


def bounds_loss(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors) -> Tensor:
    """The extra: squared lengths by which samples reach over the table's edges or into the restricted zone, the farthest each.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.

    Returns:
        (B,), square metres: the sum over objects of the squares over each edge and of the depth in the zone.
    """
    scene, place = batch.is_movable.nonzero(as_tuple=True)
    samples = geometry.surface[batch.shape_index[scene, place]].to(poses.dtype)
    centre, yaw = poses[scene, place, :2, None], poses[scene, place, 3, None]
    c, s = yaw.cos(), yaw.sin()
    x = c * samples[..., 0] - s * samples[..., 1] + centre[:, 0]  # (M, P)
    y = s * samples[..., 0] + c * samples[..., 1] + centre[:, 1]
    table, zone = batch.table[scene], batch.zone[scene]
    over = [-x.amin(1), x.amax(1) - table[:, 0], -y.amin(1), y.amax(1) - table[:, 1]]
    inside = torch.stack([x - zone[:, 0, None], zone[:, 1, None] - x, y - zone[:, 2, None], zone[:, 3, None] - y])
    entered = torch.where(batch.has_zone[scene], inside.amin(0).amax(1), 0)
    excess = torch.stack([*over, entered]).clamp_min(0).square().sum(dim=0)
    return poses.new_zeros(len(poses)).index_add(0, scene, excess)


def _nearest_to_plane(poses: Tensor, scene: Tensor, place: Tensor, bottom: Tensor) -> Tensor:
    """The bottom sample (M,) of each object that is nearest to the tabletop's plane."""
    return (poses[scene, place, 2, None].detach() + bottom[..., 2]).abs().argmin(dim=1)
