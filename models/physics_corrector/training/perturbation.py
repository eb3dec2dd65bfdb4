"""Makes coarse layouts from clean ones, with the kinds of errors that a reasoner makes, for training and validation.

Scenes with a proposal keep it: it is their coarse layout.

All draws are from one generator, on whole batches. The scale of the errors is drawn per scene (LEGO-Net's Gaussian of
Gaussians), so that a scene has small or large errors throughout. In some scenes objects move with their support, in others they
do not. Poses of fixed objects and padding are unchanged, bit by bit.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import torch
from torch import Tensor

from models.physics_corrector.flow.expected_error import PROPOSAL_ERROR
from models.physics_corrector.flow.pose_coordinates import wrap_angle
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.assignment import assign
from models.settings import NonNegative, Settings, Share
from stable_data.errors import ConfigError
from stable_data.rotations import YAW_ARM

Kind: TypeAlias = Literal["small", "jitter", "swap", "pile", "height", "edge"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Kinds of errors of a coarse layout; all but ``small`` include the large jitter."""

_DEGREE = math.pi / 180  # radians


@dataclass(frozen=True, slots=True)
class PerturbationSettings(Settings):
    """Settings of the errors that are added to clean layouts."""

    small: NonNegative = 0.3
    """Share of scenes with small errors alone, like those of a good reasoner. The six shares are weights; any sum is valid."""

    jitter: NonNegative = 0.3
    """Share of scenes in which every object is displaced."""

    swap: NonNegative = 0.1
    """Share of scenes in which two objects exchange their positions."""

    pile: NonNegative = 0.1
    """Share of scenes in which some objects are at one point."""

    height: NonNegative = 0.1
    """Share of scenes in which some objects are too low or too high."""

    edge: NonNegative = 0.1
    """Share of scenes in which some objects extend over the table's edge or are beside the table."""

    small_xy: NonNegative = 0.004
    """Metres; scale of the small errors along x and y. Along z it is a quarter of this."""

    small_yaw: NonNegative = 4 * _DEGREE
    """Radians; scale of the small errors of yaw."""

    xy_low: NonNegative = 0.02
    """Metres; lower bound of the scale of the large errors along x and y, which is drawn for each scene."""

    xy_high: NonNegative = 0.08
    """Metres; upper bound of the scale of the large errors along x and y."""

    z_high: NonNegative = 0.02
    """Metres; upper bound of the scale of the large errors along z, whose lower bound is 0."""

    yaw_low: NonNegative = 15 * _DEGREE
    """Radians; lower bound of the scale of the large errors of yaw."""

    yaw_high: NonNegative = 45 * _DEGREE
    """Radians; upper bound of the scale of the large errors of yaw."""

    height_low: NonNegative = 0.03
    """Metres; largest distance by which ``height`` lowers an object."""

    height_high: NonNegative = 0.05
    """Metres; largest distance by which ``height`` raises an object."""

    picked: Share = 0.3
    """Approximate share of a scene's objects that ``pile``, ``height`` and ``edge`` displace."""

    together: Share = 0.7
    """Share of scenes in which an object's errors also move the objects that it supports."""

    carried: NonNegative = 0.25
    """Scale of the additional errors of such supported objects, as a share of the scene's scale."""

    def check(self) -> None:
        """Refuses shares that are all 0; see the base class."""
        if sum(self.shares()) <= 0:
            raise ConfigError(f"perturbation: {', '.join(KINDS)} are 0, expected at least one positive", "config_invalid")

    def shares(self) -> list[float]:
        """The weights of KINDS, in their order."""
        return [getattr(self, kind) for kind in KINDS]


@dataclass(frozen=True, slots=True, eq=False)
class Perturbation:
    """Coarse layouts of clean scenes.

    Attributes:
        poses: Coarse poses, (B, N, 4) float32, metres and radians, world frame.
        kinds: The kind of each scene as an index of KINDS, (B,) int64; of no meaning for proposals.
        error: Standard deviations of the errors of all objects along x and along y in metres, and of yaw in radians, (B, 2)
            float32; the errors that a kind adds to some objects are not counted. For proposals ``PROPOSAL_ERROR``.
    """

    poses: Tensor
    kinds: Tensor
    error: Tensor


def perturb(
    batch: LayoutBatch, settings: PerturbationSettings, generator: torch.Generator, kind: Kind | None = None
) -> Perturbation:
    """Draws coarse poses for clean scenes.

    Args:
        batch: Scenes with clean poses.
        settings: Settings of the errors.
        generator: Random generator on the batch's device.
        kind: One kind for all scenes; None draws one for each.

    Returns:
        The coarse poses with their kinds and errors.
    """
    draw = _Draw(generator, batch.poses.device)
    num_scenes = len(batch)
    if kind is None:
        weights = torch.tensor(settings.shares(), device=batch.poses.device)
        kinds = torch.multinomial(weights, num_scenes, replacement=True, generator=generator)
    else:
        kinds = torch.full((num_scenes,), KINDS.index(kind), device=batch.poses.device)
    sigma = _sigma(kinds, settings, draw)  # (B, 4)
    is_together = draw.uniform(num_scenes) < settings.together
    is_root = (batch.parent < 0) | ~_is_placed(batch)  # on the table, or on an object outside the prefix
    carried = torch.where(is_together[:, None] & ~is_root, settings.carried, 1.0)
    noise = draw.normal(*batch.poses.shape) * sigma[:, None] * carried[..., None]
    moved = batch.poses + noise + _structured(batch, kinds, is_root, settings, draw)
    coarse, error = _with_carried(batch, moved, is_together), sigma[:, [0, 3]]
    if batch.coarse is not None:
        is_proposed = batch.is_proposed
        coarse = torch.where(is_proposed[:, None, None], batch.coarse, coarse)
        error = torch.where(is_proposed[:, None], error.new_tensor([PROPOSAL_ERROR.position, PROPOSAL_ERROR.yaw]), error)
    return Perturbation(coarse, kinds, error)


def reassign_targets(coarse: Tensor, batch: LayoutBatch) -> Tensor:
    """Computes the targets of a coarse layout: the clean poses, with interchangeable objects assigned to the nearest ones.

    Movable objects are interchangeable if they have one shape and one parent and support nothing. The assignment of a group has
    the least total cost √(|Δp|² + (0.1 m/rad Δr)²).

    Args:
        coarse: Coarse poses, (B, N, 4), metres and radians.
        batch: The scenes with their clean poses.

    Returns:
        Target poses, (B, N, 4): the clean poses of each scene, permuted.
    """
    slots = torch.arange(batch.mask.shape[1], device=coarse.device)
    carries = ((batch.parent[:, :, None] == slots) & batch.mask[:, :, None]).any(1)
    is_free = batch.is_movable & ~carries
    alike = (batch.shape_index[:, :, None] == batch.shape_index[:, None]) & (batch.parent[:, :, None] == batch.parent[:, None])
    alike &= is_free[:, :, None] & is_free[:, None]
    # The groups with more than one member, each by its first one; their members come first in `order`.
    is_first = alike.long().argmax(2) == slots
    scene, first = (is_first & (alike.sum(2) > 1)).nonzero(as_tuple=True)
    if not len(scene):
        return batch.poses
    members = alike[scene, first]
    count = members.sum(1)
    order = torch.argsort(~members, dim=1, stable=True)[:, : int(count.max())]
    is_member = torch.arange(order.shape[1], device=coarse.device) < count[:, None]
    offset = batch.poses[scene[:, None], order][:, None] - coarse[scene[:, None], order][:, :, None]  # target j − coarse i
    cost = (offset[..., :3].square().sum(-1) + (YAW_ARM * wrap_angle(offset[..., 3])).square()).sqrt()
    is_alone = torch.eye(order.shape[1], dtype=torch.bool, device=coarse.device)
    both = is_member[:, :, None] & is_member[:, None]
    cost = torch.where(both, cost, torch.where(is_alone, 0.0, cost.amax() * order.shape[1] + 1))  # padding keeps its place
    chosen = order.gather(1, assign(cost))
    assigned = slots.repeat(len(coarse), 1)
    assigned[scene[:, None].expand_as(order)[is_member], order[is_member]] = chosen[is_member]
    return batch.poses.gather(1, assigned[..., None].expand_as(batch.poses))


@dataclass(frozen=True, slots=True)
class _Draw:
    """Random draws on one device from one generator."""

    generator: torch.Generator
    device: torch.device

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.device)


def _is_placed(batch: LayoutBatch) -> Tensor:
    """Whether an object's parent is an object of the batch's mask, (B, N) bool."""
    return batch.mask & (batch.parent >= 0) & batch.mask.gather(1, batch.parent.clamp_min(0))


def _sigma(kinds: Tensor, settings: PerturbationSettings, draw: _Draw) -> Tensor:
    """Draws standard deviations of x, y, z and yaw of each scene, (B, 4): scales times |N(0, 1)|."""
    share, factor = draw.uniform(len(kinds), 3), draw.normal(len(kinds), 2).abs()
    xy = settings.xy_low + share[:, 0] * (settings.xy_high - settings.xy_low)
    yaw = settings.yaw_low + share[:, 2] * (settings.yaw_high - settings.yaw_low)
    large = torch.stack([xy, xy, share[:, 1] * settings.z_high, yaw], 1)
    small = large.new_tensor([settings.small_xy, settings.small_xy, settings.small_xy / 4, settings.small_yaw])
    scale = torch.where((kinds == KINDS.index("small"))[:, None], small, large)
    return scale * factor[:, [0, 0, 0, 1]]  # yaw has its own: things can be far away and face the right way


def _structured(batch: LayoutBatch, kinds: Tensor, is_root: Tensor, settings: PerturbationSettings, draw: _Draw) -> Tensor:
    """Draws the offsets that each scene's kind adds to the jitter, (B, N, 4)."""
    # All kinds draw for every scene, so that the number of draws does not depend on the kinds.
    num_scenes, num_slots = batch.mask.shape
    rank, lot = draw.uniform(num_scenes, num_slots), draw.uniform(num_scenes, num_slots)
    near, side = draw.normal(num_scenes, num_slots, 2), draw.uniform(num_scenes, num_slots, 3)
    may = batch.is_movable & is_root
    order = torch.where(may, rank, 2.0).argsort(1)
    first, second = order[:, :1], order[:, 1:2] if num_slots > 1 else order[:, :1]
    is_pair = (may.sum(1) > 1)[:, None]
    xy, offset = batch.poses[..., :2], torch.zeros_like(batch.poses)

    def at(index: Tensor) -> Tensor:
        return xy.gather(1, index[..., None].expand(-1, -1, 2))

    def of(name: Kind) -> Tensor:
        return (kinds == KINDS.index(name))[:, None]

    slots = torch.arange(num_slots, device=order.device)
    across = at(second) - at(first)
    sign = (slots == first).float() - (slots == second).float()
    is_first = slots == first
    is_picked = may & ((lot < settings.picked) | is_first)  # at least one object
    is_over = may & ((lot < settings.picked / 2) | is_first)
    spread = settings.xy_low / 2 * near
    height = -settings.height_low + side[..., 0] * (settings.height_low + settings.height_high)
    swapped = torch.where(is_pair[..., None], sign[..., None] * across, 0.0)
    piled = torch.where(is_picked[..., None] & is_pair[..., None], at(first) + spread - xy, 0.0)
    beside = torch.where(is_over[..., None], _over_edge(batch, side), 0.0)
    added: tuple[tuple[Kind, Tensor], ...] = (("swap", swapped), ("pile", piled), ("edge", beside))
    for name, way in added:
        offset[..., :2] += torch.where(of(name)[..., None], way, 0.0)
    is_off = batch.is_movable & ((lot < settings.picked) | is_first)
    offset[..., 2] += torch.where(of("height") & is_off, height, 0.0)
    return offset


def _over_edge(batch: LayoutBatch, side: Tensor) -> Tensor:
    """Returns the offset of each object over the nearer edge along x or y, (B, N, 2): up to its own length beyond the edge."""
    xy, table = batch.poses[..., :2], batch.table[:, None]
    # Puts the centre between a quarter of the box's diagonal inside the edge and three quarters outside.
    reach = torch.linalg.vector_norm(batch.sizes[..., :2], dim=-1, keepdim=True) * (side[..., 1:2] - 0.25)
    target = torch.where(xy < table / 2, -reach, table + reach)
    is_x = (side[..., 2] < 0.5)[..., None]
    way = target - xy
    return way * torch.cat([is_x, ~is_x], -1)


def _with_carried(batch: LayoutBatch, moved: Tensor, is_together: Tensor) -> Tensor:
    """Returns coarse poses in which supported objects follow their support, yaw included, in the scenes of ``is_together``."""
    has_parent = _is_placed(batch)
    index = batch.parent.clamp_min(0)[..., None].expand_as(moved)
    clean = batch.poses
    parent = clean.gather(1, index)
    extra = moved - clean  # noise and the offset of the scene's kind
    is_movable = batch.is_movable[..., None]
    follows = (has_parent & is_together[:, None])[..., None]
    coarse = torch.where(is_movable, moved, clean)
    # Each pass moves one more level of a stack.
    for _ in range(_depth(batch, has_parent)):
        carrier = coarse.gather(1, index)
        turn = carrier[..., 3] - parent[..., 3]
        c, s = turn.cos(), turn.sin()
        x, y, z = (clean - parent)[..., :3].unbind(-1)
        followed = torch.stack([c * x - s * y, s * x + c * y, z, clean[..., 3] - parent[..., 3]], -1) + carrier + extra
        coarse = torch.where(is_movable & follows, followed, coarse)
    coarse = torch.cat([coarse[..., :3], wrap_angle(coarse[..., 3:])], -1)
    return torch.where(is_movable, coarse, clean)


def _depth(batch: LayoutBatch, has_parent: Tensor) -> int:
    """The largest number of objects below an object in its support chain."""
    depth, index = torch.zeros_like(batch.parent), batch.parent.clamp_min(0)
    for level in range(batch.mask.shape[1]):
        deeper = torch.where(has_parent, depth.gather(1, index) + 1, 0)
        if torch.equal(deeper, depth):
            return level
        depth = deeper
    return batch.mask.shape[1]
