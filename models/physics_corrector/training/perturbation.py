"""Coarse layouts from clean ones: what the corrector is trained and judged on, of the kinds that a reasoner's layouts err in.

Everything is drawn from one generator and computed on whole batches. The size of the errors is drawn per scene (LEGO-Net's
gaussian of gaussians), so that a scene is either nearly right or badly wrong. What an object carries goes with it in some
scenes, and stays behind in others. Fixed objects and padding keep their pose bit for bit.
"""

import math
from dataclasses import dataclass, fields
from typing import Literal, TypeAlias, get_args

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from models.physics_corrector.flow.pose_coordinates import wrap
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from stable_data.errors import ConfigError
from stable_data.rotations import YAW_ARM

Kind: TypeAlias = Literal["small", "jitter", "swap", "pile", "height", "edge"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""What is wrong with a coarse layout; all but ``small`` have the large jitter too."""


@dataclass(frozen=True, slots=True)
class PerturbationSettings:
    """How clean layouts are made coarse.

    Attributes:
        small: Share of scenes with small errors alone, as a good reasoner's.
        jitter: Share in which every object is off.
        swap: Share in which two objects took each other's place.
        pile: Share in which some objects lie at one point.
        height: Share in which some objects are sunk or float.
        edge: Share in which some objects reach over the table's edge or lie beside it.
        small_xy: Scale of the small errors along x and y, metres; those of z are a quarter of it.
        small_yaw: The same of yaw, radians.
        xy_low: Scale of the large errors along x and y, metres: drawn per scene between this ...
        xy_high: ... and this.
        z_high: Scale of the large errors of z, drawn per scene between 0 and this, metres.
        yaw_low: Scale of the large errors of yaw, radians: drawn per scene between this ...
        yaw_high: ... and this.
        height_low: How far ``height`` lowers an object at most, metres.
        height_high: How far it raises one at most, metres.
        picked: Share of the objects of a scene that ``pile``, ``height`` and ``edge`` take, about.
        together: Share of scenes in which an object takes along what it carries.
        carried: The errors that carried objects have on top there, as a share of the scene's.
    """

    small: float = 0.3
    jitter: float = 0.3
    swap: float = 0.1
    pile: float = 0.1
    height: float = 0.1
    edge: float = 0.1
    small_xy: float = 0.004
    small_yaw: float = math.radians(4)
    xy_low: float = 0.02
    xy_high: float = 0.08
    z_high: float = 0.02
    yaw_low: float = math.radians(15)
    yaw_high: float = math.radians(45)
    height_low: float = 0.03
    height_high: float = 0.05
    picked: float = 0.3
    together: float = 0.7
    carried: float = 0.25

    def __post_init__(self) -> None:
        """Refuses what cannot be drawn."""
        wrong = [f.name for f in fields(self) if not 0 <= getattr(self, f.name) < math.inf]
        wrong += [name for name in ("picked", "together") if getattr(self, name) > 1]
        if wrong or sum(self.shares()) <= 0:
            raise ConfigError(
                f"perturbation: {wrong or 'all shares'} cannot be, expected shares and lengths ≥ 0", "config_invalid"
            )

    def shares(self) -> list[float]:
        """Weights of KINDS, in their order."""
        return [getattr(self, kind) for kind in KINDS]


def perturb(
    batch: LayoutBatch, settings: PerturbationSettings, generator: torch.Generator, kind: Kind | None = None
) -> tuple[Tensor, Tensor]:
    """Coarse poses for clean ones.

    Args:
        batch: Scenes with clean poses.
        settings: What is drawn.
        generator: Randomness, on the batch's device.
        kind: One kind for all scenes; None draws one for each.

    Returns:
        Coarse poses, (B, N, 4) float32, metres and radians, world frame; and the kind of each scene by its place in KINDS,
        (B,) int64.
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
    is_root = (batch.parent < 0) | ~_is_placed(batch)
    carried = torch.where(is_together[:, None] & ~is_root, settings.carried, 1.0)
    noise = draw.normal(*batch.poses.shape) * sigma[:, None] * carried[..., None]
    moved = batch.poses + noise + _structured(batch, kinds, is_root, settings, draw)
    return _with_carried(batch, moved, is_together), kinds


def reassign(coarse: Tensor, batch: LayoutBatch) -> Tensor:
    """Targets of a coarse layout: clean poses in which interchangeable objects took the nearest of their places.

    Interchangeable are movable objects of one shape on one parent that carry nothing themselves. The assignment of a group is
    the one of least total cost √(|Δt|² + (0.1 m/rad Δr)²).

    Args:
        coarse: Coarse poses, (B, N, 4), metres and radians.
        batch: The scenes with their clean poses.

    Returns:
        Target poses, (B, N, 4): of each scene the clean poses, permuted.
    """
    place = torch.arange(batch.mask.shape[1], device=coarse.device)
    carries = ((batch.parent[:, :, None] == place) & batch.mask[:, :, None]).any(1)
    is_free = batch.is_movable & ~carries
    alike = (batch.shape_index[:, :, None] == batch.shape_index[:, None]) & (batch.parent[:, :, None] == batch.parent[:, None])
    alike &= is_free[:, :, None] & is_free[:, None]
    scenes = (alike.sum(2) > 1).any(1).nonzero()[:, 0]
    if not len(scenes):
        return batch.poses
    offset = batch.poses[scenes, None] - coarse[scenes, :, None]  # [s, i, j] = target j − coarse i
    cost = (offset[..., :3].square().sum(-1) + (YAW_ARM * wrap(offset[..., 3])).square()).sqrt()
    costs, groups = cost.cpu().numpy(), alike[scenes].cpu().numpy()
    taken = place.cpu().numpy()[None].repeat(len(coarse), 0)
    for n, scene in enumerate(scenes.tolist()):
        for members in {tuple(np.flatnonzero(row).tolist()) for row in groups[n] if row.sum() > 1}:
            _, column = linear_sum_assignment(costs[n][np.ix_(members, members)])
            taken[scene, list(members)] = np.array(members)[column]
    index = torch.from_numpy(taken).to(coarse.device)[..., None].expand_as(batch.poses)
    return batch.poses.gather(1, index)


@dataclass(frozen=True, slots=True)
class _Draw:
    """Draws on one device from one generator."""

    generator: torch.Generator
    device: torch.device

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.device)


def _is_placed(batch: LayoutBatch) -> Tensor:
    """Whether the parent of an object is an object that is there, (B, N) bool."""
    return batch.mask & (batch.parent >= 0) & batch.mask.gather(1, batch.parent.clamp_min(0))


def _sigma(kinds: Tensor, settings: PerturbationSettings, draw: _Draw) -> Tensor:
    """Standard deviations of x, y, z and yaw of each scene, (B, 4): scales, times |N(0, 1)|."""
    share = draw.uniform(len(kinds), 3)
    xy = settings.xy_low + share[:, 0] * (settings.xy_high - settings.xy_low)
    yaw = settings.yaw_low + share[:, 2] * (settings.yaw_high - settings.yaw_low)
    large = torch.stack([xy, xy, share[:, 1] * settings.z_high, yaw], 1)
    small = large.new_tensor([settings.small_xy, settings.small_xy, settings.small_xy / 4, settings.small_yaw])
    scale = torch.where((kinds == KINDS.index("small"))[:, None], small, large)
    return scale * draw.normal(len(kinds), 1).abs()


def _structured(batch: LayoutBatch, kinds: Tensor, is_root: Tensor, settings: PerturbationSettings, draw: _Draw) -> Tensor:
    """What the kind of each scene adds to the jitter, (B, N, 4). Drawn for every scene, so that draws do not depend on kinds."""
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

    place = torch.arange(num_slots, device=order.device)
    across = at(second) - at(first)
    sign = (place == first).float() - (place == second).float()
    is_first = place == first
    is_picked = may & ((lot < settings.picked) | is_first)  # one at least
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
    """The way from each object straight over the nearer edge along x or y, (B, N, 2): up to its own length beyond it."""
    xy, table = batch.poses[..., :2], batch.table[:, None]
    reach = torch.linalg.vector_norm(batch.sizes[..., :2], dim=-1, keepdim=True) * (side[..., 1:2] - 0.25)
    target = torch.where(xy < table / 2, -reach, table + reach)
    is_x = (side[..., 2] < 0.5)[..., None]
    way = target - xy
    return way * torch.cat([is_x, ~is_x], -1)


def _with_carried(batch: LayoutBatch, moved: Tensor, is_together: Tensor) -> Tensor:
    """Coarse poses in which carried objects go with what carries them, yaw included, in the scenes where they do."""
    has_parent = _is_placed(batch)
    index = batch.parent.clamp_min(0)[..., None].expand_as(moved)
    clean = batch.poses
    parent = clean.gather(1, index)
    extra = moved - clean  # noise, and what the kind of the scene added
    is_movable = batch.is_movable[..., None]
    goes = (has_parent & is_together[:, None])[..., None]
    coarse = torch.where(is_movable, moved, clean)
    for _ in range(int(_depth(batch, has_parent))):
        carrier = coarse.gather(1, index)
        turn = carrier[..., 3] - parent[..., 3]
        c, s = turn.cos(), turn.sin()
        x, y, z = (clean - parent)[..., :3].unbind(-1)
        taken = torch.stack([c * x - s * y, s * x + c * y, z, clean[..., 3] - parent[..., 3]], -1) + carrier + extra
        coarse = torch.where(is_movable & goes, taken, coarse)
    coarse = torch.cat([coarse[..., :3], wrap(coarse[..., 3:])], -1)
    return torch.where(is_movable, coarse, clean)


def _depth(batch: LayoutBatch, has_parent: Tensor) -> int:
    """How many objects lie on each other at most, the lowest not counted."""
    depth, index = torch.zeros_like(batch.parent), batch.parent.clamp_min(0)
    for level in range(batch.mask.shape[1]):
        deeper = torch.where(has_parent, depth.gather(1, index) + 1, 0)
        if torch.equal(deeper, depth):
            return level
        depth = deeper
    return batch.mask.shape[1]
