"""The corrector's objective: L_PC = L_flow + λ_sdf (L_obj-obj + L_obj-table) + λ_sup L_sup, of the paper's Method.

The physical terms are functions of the predicted clean poses, in metres and radians, one value per scene. Fixed objects are
obstacles: they receive no gradient, and pairs of fixed objects do not count.

Choices that the paper does not specify:

* dist_sdf(i, j) reads samples of i in the grid of j. The result would depend on the order of the two objects, so both
  directions are computed and the deeper one counts.
* Lengths are squared in units of ``length_unit``, by default the centimetre, the unit of the paper's thresholds and of
  MesaTask's layouts: the values of λ depend on this unit.
* τ, the tabletop, is the half-space below z = 0; the deepest point of an object in it is the lowest point of its box.
* S_i are the tabletop and the objects whose yawed box overlaps the box of i when i is lowered by ``support_reach``, except
  objects whose bottom is higher than that of i: an object that i supports cannot support i.

An additional term, off by default, keeps footprints on the table and outside the restricted zone.
"""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from models.physics_corrector.geometry.broad_phase import ObjectPairs, near_pairs
from models.physics_corrector.geometry.closest_point import ClosestPointQueries, closest_sample, posed_distance
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import STRETCH, ShapeTensors
from models.settings import NonNegative, Positive, Settings

_BOTTOM_TOLERANCE = 5e-3  # a support's bottom may be higher than the supported object's bottom by this much, metres


@dataclass(frozen=True, slots=True)
class LossSettings(Settings):
    """Weights and tolerances of the losses; the defaults are the paper's preset."""

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
    """Weight of the loss for objects over the table's edge or in the restricted zone; not in the paper."""

    length_unit: Positive = 0.01
    """Metres; unit of the squared lengths."""

    clearance: NonNegative = 0.0
    """Metres; objects closer than this count as colliding. 0 in the paper."""

    contact_tolerance: NonNegative = 5e-4
    """Metres; ε of L_sup, the paper's threshold of floating."""

    support_reach: NonNegative = 0.1
    """Metres; largest distance from an object's bottom down to a candidate support."""


@dataclass(frozen=True, slots=True, eq=False)
class PhysicsLosses:
    """The physical terms, unweighted.

    Attributes:
        object_object: L_obj-obj, (B,).
        object_table: L_obj-table, (B,).
        support: L_sup, (B,).
        bounds: The loss of table edges and restricted zone, (B,); zeros if its weight is 0.
    """

    object_object: Tensor
    object_table: Tensor
    support: Tensor
    bounds: Tensor

    def weighted(self, settings: LossSettings) -> Tensor:
        """Returns λ_sdf (L_obj-obj + L_obj-table) + λ_sup L_sup + the weighted bounds, (B,)."""
        collision = settings.object_factor * self.object_object + settings.table_factor * self.object_table
        return settings.sdf_weight * collision + settings.support_weight * self.support + settings.bounds_weight * self.bounds


def flow_loss(velocity: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Computes L_flow: ‖v_θ − (x_1 − x_0)‖² per object, mean over the objects of all scenes.

    Args:
        velocity: v_θ, (B, N, D), in the coordinates of the flow.
        target: x_1 − x_0, (B, N, D).
        mask: The objects that count, those that may move, (B, N) bool.

    Returns:
        A scalar, float32 or float64; 0 if no object counts.
    """
    # Masked before the square: nan in the padding would otherwise reach the gradient.
    difference = torch.where(mask[..., None], velocity.to(target.dtype) - target, 0)
    return difference.square().sum() / mask.sum().clamp_min(1)


def physics_losses(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, settings: LossSettings = LossSettings()
) -> PhysicsLosses:
    """Computes all physical terms of predicted clean poses, in squares of ``length_unit``.

    Args:
        poses: x̂_1, x, y, z in metres and yaw in radians, world frame, (B, N, 4); float64 is preserved, other types become
            float32: bfloat16 would round a metre to millimetres.
        batch: The scenes; its own poses are not read.
        geometry: Their shapes.
        settings: Weights and tolerances.
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
    """Finds pairs that may be closer than a clearance: all pairs that contribute to `object_object_loss`, and few others.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        clearance: Metres.
    """
    half = batch.sizes / 2
    if len(geometry):  # without shapes there is nothing to index
        half = half + (geometry.reach[batch.shape_index] + STRETCH * clearance)[..., None]
    pairs = near_pairs(poses, half.to(poses.dtype), batch.mask)
    is_fixed = batch.is_fixed[pairs.scene, pairs.first] & batch.is_fixed[pairs.scene, pairs.second]
    return pairs.take(~is_fixed)


def object_object_loss(
    poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, pairs: ObjectPairs, clearance: float = 0.0
) -> Tensor:
    """Computes L_obj-obj: Σ_{i<j} max(0, −dist_sdf(i, j))².

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        pairs: The pairs that may contribute.
        clearance: Added to every depth, metres.

    Returns:
        (B,), square metres.
    """
    ways = pairs.both_ways()
    queries = ClosestPointQueries(ways.scene, ways.first, ways.second)
    limit = poses.new_full((len(queries),), clearance)
    sample, distance = closest_sample(poses, batch, geometry, queries, geometry.surface, limit)
    depth = (clearance - distance).clamp_min(0).reshape(2, -1)
    # Only the deeper direction is evaluated with gradients; two equally deep directions share the gradient.
    counts = ((depth > 0) & (depth == depth.amax(dim=0))).reshape(-1)
    share = 1 / counts.reshape(2, -1).sum(dim=0).clamp_min(1).repeat(2)[counts]
    queries = queries.take(counts)
    points = geometry.surface[batch.shape_index[queries.scene, queries.guest], sample[counts]]
    deepest = (clearance - posed_distance(poses, batch, geometry, queries, points)).clamp_min(0)
    return poses.new_zeros(len(poses)).index_add(0, queries.scene, share * deepest.square())


def object_table_loss(poses: Tensor, batch: LayoutBatch) -> Tensor:
    """Computes L_obj-table: Σ_i max(0, −dist_sdf(i, τ))², (B,), square metres.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
    """
    sunk = (batch.sizes[..., 2] / 2 - poses[..., 2]).clamp_min(0)
    return torch.where(batch.is_movable, sunk, 0).square().sum(dim=1)


def support_candidates(poses: Tensor, batch: LayoutBatch, reach: float) -> ClosestPointQueries:
    """Finds the objects of S_i, without the tabletop, for every object i that may move.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        reach: Largest distance from an object's bottom down to a candidate, metres.

    Returns:
        Queries with i as the guest and the candidate as the host.
    """
    half = (batch.sizes / 2).to(poses.dtype)
    raised = half + half.new_tensor([0.0, 0.0, reach / 2])
    ways = near_pairs(poses, raised, batch.mask).both_ways()
    upper, lower = (ways.scene, ways.first), (ways.scene, ways.second)
    bottom, top = poses[..., 2] - half[..., 2], poses[..., 2] + half[..., 2]
    is_below = (bottom[lower] <= bottom[upper] + _BOTTOM_TOLERANCE) & (top[lower] >= bottom[upper] - reach)
    ways = ways.take(is_below & batch.is_movable[upper])
    return ClosestPointQueries(ways.scene, ways.first, ways.second)


def support_loss(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors, settings: LossSettings = LossSettings()) -> Tensor:
    """Computes L_sup: Σ_i max(0, gap(i, z_i) − ε)², gap(i, z_i) = min_s∈S_i min_b∈B_i |D_s(b)|.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.
        settings: ε and the reach of candidate supports.

    Returns:
        (B,), square metres.
    """
    scene, slot = batch.is_movable.nonzero(as_tuple=True)
    height = geometry.bottom[batch.shape_index[scene, slot]].to(poses.dtype)[..., 2].detach()  # of bottom samples, (M, Q)
    nearest_to_table = (poses[scene, slot, 2, None].detach() + height).abs().argmin(dim=1)
    gap = (poses[scene, slot, 2] + height[torch.arange(len(scene), device=scene.device), nearest_to_table]).abs()  # |D_τ|
    # Objects in contact with the table have no loss: only the others look for supports.
    floating = gap.detach() > settings.contact_tolerance
    scene, slot, gap = scene[floating], slot[floating], gap[floating]
    queries = support_candidates(poses.detach(), batch, settings.support_reach)
    row_of_slot = torch.full_like(batch.parent, -1)
    row_of_slot[scene, slot] = torch.arange(len(scene), device=scene.device)
    row = row_of_slot[queries.scene, queries.guest]
    queries, row = queries.take(row >= 0), row[row >= 0]
    sample, distance = closest_sample(poses, batch, geometry, queries, geometry.bottom, gap.detach()[row], is_unsigned=True)
    best = torch.full_like(gap.detach(), torch.inf).scatter_reduce(0, row, distance, "amin")
    nearest = torch.where(distance == best[row], torch.arange(len(queries), device=row.device), len(queries))
    chosen = torch.full_like(scene, len(queries)).scatter_reduce(0, row, nearest, "amin")  # the first of equal candidates
    on_object = best < torch.inf
    chosen = chosen[on_object]
    queries = queries.take(chosen)
    points = geometry.bottom[batch.shape_index[queries.scene, queries.guest], sample[chosen]]
    gap = gap.masked_scatter(on_object, posed_distance(poses, batch, geometry, queries, points).abs())
    excess = (gap - settings.contact_tolerance).clamp_min(0)
    return poses.new_zeros(len(poses)).index_add(0, scene, excess.square())


def bounds_loss(poses: Tensor, batch: LayoutBatch, geometry: ShapeTensors) -> Tensor:
    """Computes the loss of objects over the table's edges or in the restricted zone.

    Args:
        poses: (B, N, 4), metres and radians.
        batch: The scenes.
        geometry: Their shapes.

    Returns:
        (B,), square metres: the sum over objects of the squared largest excess over each edge, and squared depth in the zone.
    """
    scene, slot = batch.is_movable.nonzero(as_tuple=True)
    samples = geometry.surface[batch.shape_index[scene, slot]].to(poses.dtype)
    centre, yaw = poses[scene, slot, :2, None], poses[scene, slot, 3, None]
    c, s = yaw.cos(), yaw.sin()
    x = c * samples[..., 0] - s * samples[..., 1] + centre[:, 0]  # (M, P)
    y = s * samples[..., 0] + c * samples[..., 1] + centre[:, 1]
    table, zone = batch.table[scene], batch.zone[scene]
    over = [-x.amin(1), x.amax(1) - table[:, 0], -y.amin(1), y.amax(1) - table[:, 1]]
    inside = torch.stack([x - zone[:, 0, None], zone[:, 1, None] - x, y - zone[:, 2, None], zone[:, 3, None] - y])
    entered = torch.where(batch.has_zone[scene], inside.amin(0).amax(1), 0)
    excess = torch.stack([*over, entered]).clamp_min(0).square().sum(dim=0)
    return poses.new_zeros(len(poses)).index_add(0, scene, excess)
