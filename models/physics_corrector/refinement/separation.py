"""Separates bodies along the table by small pushes (position-based dynamics): contacts, directional relations, table and zone."""

import math

import torch
from torch import Tensor

from models.physics_corrector.refinement.contacts import Contacts, find_contacts, pairs_of_bodies
from models.physics_corrector.refinement.problem import RefinementProblem
from stable_data.metrics.audit import BOUNDS_SLACK

# Tuned on: the proposals of generated scenes, see docs/refinement.md. Lengths in metres.
_MARGIN = 0.03  # pairs of bodies nearer than this are looked at
_PAIRS_EVERY = 6  # iterations after which near pairs are found again
_SHALLOW = 2e-3  # contacts deeper than this are parted by their outlines, because the nearest surface may be the far side
_LEAST_ASIDE = 0.35  # least horizontal part of a normal that says in which direction to part
_NUM_DIRECTIONS = 24  # directions in which outlines are parted
_ORDERS_UNTIL = 0.7  # share of the iterations in which directional relations push
_ORDER_MARGIN = 1.5e-3  # by how much a directional relation shall hold
_OVERHANG = 0.5 * BOUNDS_SLACK  # how far an outline may reach over an edge

_angles = torch.arange(_NUM_DIRECTIONS) * (2 * math.pi / _NUM_DIRECTIONS)
_DIRECTIONS = torch.stack([_angles.cos(), _angles.sin()])


def separate_bodies(poses: Tensor, problem: RefinementProblem, clearance: float, iterations: int) -> Tensor:
    """Separates the bodies of all scenes; what a body carries moves with it, heights and yaws do not change.

    Args:
        poses: (B, N, 4), metres and radians.
        problem: The scenes.
        clearance: Wanted distance of bodies, metres.
        iterations: Largest number of iterations; ends when all scenes are separated.

    Returns:
        The new poses; bodies that do not touch others and are on the table keep theirs.
    """
    num_scenes, num_slots = problem.layout.mask.shape
    poses = poses.clone()
    flat = poses.view(num_scenes * num_slots, 4)
    outlines = posed_outlines(poses, problem)
    pairs = pairs_of_bodies(poses, problem, _MARGIN)
    for number in range(iterations):
        if number and number % _PAIRS_EVERY == 0:
            pairs = pairs_of_bodies(poses, problem, _MARGIN)
        back = shift_onto_table(poses, problem, outlines)
        flat[:, :2] += back[problem.forest.root]
        contacts = find_contacts(poses, problem, pairs, clearance / 2)
        pushes = [_contact_pushes(contacts, flat, problem, outlines, clearance)]
        if number < _ORDERS_UNTIL * iterations:
            pushes.append(_order_pushes(flat, problem))
        first, second, push = (torch.cat(parts) for parts in zip(*pushes, strict=True))
        if not len(first) and not bool((back != 0).any()):
            break
        flat[:, :2] += _combined(first, second, push, problem.mobility)[problem.forest.root]
        if number % _PAIRS_EVERY != _PAIRS_EVERY - 1:  # scenes at rest are looked at again when near pairs are found again
            is_moving = torch.zeros(num_scenes, dtype=torch.bool, device=poses.device)
            is_moving[first // num_slots] = True
            is_moving |= (back != 0).any(dim=1).view(num_scenes, num_slots).any(dim=1)
            pairs = pairs.take(is_moving[pairs.scene])
    flat[:, :2] += shift_onto_table(poses, problem, outlines)[problem.forest.root]
    return poses


def posed_outlines(poses: Tensor, problem: RefinementProblem) -> Tensor:
    """Returns the corners of the outlines, turned by the yaws, relative to the centres of the boxes, (B, N, 32, 2), metres."""
    x, y = problem.shapes.outline[problem.layout.shape_index].unbind(-1)
    c, s = poses[..., 3, None].cos(), poses[..., 3, None].sin()
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


def shift_onto_table(poses: Tensor, problem: RefinementProblem, outlines: Tensor) -> Tensor:
    """Returns the shift that brings each body onto the table and out of the restricted zone, (M, 2), metres, at its root.

    A body wider than the table is centred. A fixed body stays.
    """
    layout, root = problem.layout, problem.forest.root
    num_slots = layout.mask.shape[1]
    is_object = layout.mask[..., None]
    low = torch.where(is_object, poses[..., :2] + outlines.amin(dim=2), torch.inf).reshape(-1, 2)
    high = torch.where(is_object, poses[..., :2] + outlines.amax(dim=2), -torch.inf).reshape(-1, 2)
    of_body = root[:, None].expand(-1, 2)
    low = torch.full_like(low, torch.inf).scatter_reduce(0, of_body, low, "amin")
    high = torch.full_like(high, -torch.inf).scatter_reduce(0, of_body, high, "amax")
    table = layout.table[:, None].expand(-1, num_slots, -1).reshape(-1, 2)
    moves = (problem.mobility > 0) & torch.isfinite(low[:, 0])
    up, down = (-_OVERHANG - low).clamp_min(0), (high - table - _OVERHANG).clamp_min(0)
    shift = torch.where((up > 0) & (down > 0), (table - low - high) / 2, up - down)
    shift = torch.where(moves[:, None], shift, 0)
    has_zone = layout.has_zone[:, None].expand(-1, num_slots).reshape(-1) & moves
    if bool(has_zone.any()):
        zone = layout.zone[:, None].expand(-1, num_slots, -1).reshape(-1, 4)
        shift = shift + torch.where(has_zone[:, None], _out_of_zone(low + shift, high + shift, zone, table), 0)
    return shift


def _out_of_zone(low: Tensor, high: Tensor, zone: Tensor, table: Tensor) -> Tensor:
    """Returns the shortest shift along an axis that takes boxes (M, 2) out of zones (M, 4) and leaves them on the table, (M, 2)."""
    least, most = zone[:, 0::2], zone[:, 1::2]
    is_inside = ((low < most - _OVERHANG) & (high > least + _OVERHANG)).all(dim=1)
    ways = torch.cat([least - high + _OVERHANG, most - low - _OVERHANG], dim=1)  # -x, -y, +x, +y
    stays = torch.cat([low + ways[:, :2] >= -BOUNDS_SLACK, high + ways[:, 2:] <= table + BOUNDS_SLACK], dim=1)
    best = torch.where(stays, ways.abs(), torch.inf).argmin(dim=1)
    length = ways.gather(1, best[:, None])[:, 0]
    along_x = best % 2 == 0
    shift = torch.stack([torch.where(along_x, length, 0), torch.where(along_x, 0, length)], dim=1)
    return torch.where((is_inside & stays.any(dim=1))[:, None], shift, 0)


def parting(
    contacts: Contacts, flat: Tensor, outlines: Tensor, clearance: float, is_sideways: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns in which direction along the table the guest of each contact leaves its host, (E, 2), and how far, (E,) metres.

    A shallow contact is parted along its normal, a deep one where the outlines overlap least.

    Args:
        contacts: The contacts.
        flat: Poses, (M, 4).
        outlines: Turned outlines, (M, 32, 2).
        clearance: Wanted distance, metres.
        is_sideways: Contacts that are parted along their normals in any case, (E,) bool.
    """
    depth, aside = clearance - contacts.distance, contacts.normal[:, :2].norm(dim=1)
    along_normal = contacts.normal[:, :2] / aside.clamp_min(1e-9)[:, None]
    directions = _DIRECTIONS.to(flat)
    guest, host = (outlines[which] @ directions for which in (contacts.guest, contacts.host))
    apart = (flat[contacts.guest, :2] - flat[contacts.host, :2]) @ directions
    overlap, best = (host.amax(dim=1) - guest.amin(dim=1) - apart).min(dim=1)
    overlap = overlap.clamp_min(0)
    # A step of a part of the overlap: where shapes are hollow or round, they part earlier than their outlines.
    along_outline = torch.minimum(torch.maximum(1.5 * depth, overlap / 4), overlap + clearance)
    by_outline = (contacts.distance < -_SHALLOW) | (aside < _LEAST_ASIDE)
    if is_sideways is not None:
        by_outline &= ~is_sideways
    direction = torch.where(by_outline[:, None], directions.T[best], along_normal)
    return direction, torch.where(by_outline, along_outline, depth / aside.clamp_min(_LEAST_ASIDE))


def _contact_pushes(
    contacts: Contacts, flat: Tensor, problem: RefinementProblem, outlines: Tensor, clearance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the bodies of each contact, two (E,), and how far the first shall move away from the second, (E, 2) metres."""
    direction, amount = parting(contacts, flat, outlines.flatten(0, 1), clearance)
    root = problem.forest.root
    return root[contacts.guest], root[contacts.host], direction * amount[:, None]


def _order_pushes(flat: Tensor, problem: RefinementProblem) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the same for the directional relations that do not hold."""
    orders = problem.orders
    apart = flat[orders.subject, :2] - flat[orders.target, :2]
    along = orders.sign * apart.gather(1, orders.axis[:, None])[:, 0]
    across = apart.gather(1, 1 - orders.axis[:, None])[:, 0]
    missing = across.abs() + _ORDER_MARGIN - along
    first, second = problem.forest.root[orders.subject], problem.forest.root[orders.target]
    broken = (missing > 0) & ((problem.mobility[first] > 0) | (problem.mobility[second] > 0))
    axis, sign, across = orders.axis[broken], orders.sign[broken], across[broken]
    inwards = -torch.where(across >= 0, 1.0, -1.0)
    along_x = axis == 0
    direction = torch.stack([torch.where(along_x, sign, inwards), torch.where(along_x, inwards, sign)], dim=1)
    return first[broken], second[broken], direction * (missing[broken] / 2)[:, None]  # two unit steps close it by twice that


def _combined(first: Tensor, second: Tensor, push: Tensor, mobility: Tensor) -> Tensor:
    """Combines pushes to one step of each body, (M, 2), metres; the two bodies of a push share it by their mobility."""
    share = (mobility[first] / (mobility[first] + mobility[second]))[:, None]
    return combined_steps(torch.cat([first, second]), torch.cat([share * push, (share - 1) * push]), len(mobility))


def combined_steps(mover: Tensor, step: Tensor, num_movers: int) -> Tensor:
    """Combines steps to one of each mover, (M, 2), metres.

    The sum of the steps of a mover is scaled to the length of the longest, because pushes of several contacts with one neighbour
    are much the same.

    Args:
        mover: What each step moves, (E,) int64.
        step: The steps, (E, 2), metres.
        num_movers: M.
    """
    length, none = step.norm(dim=1), step.new_zeros(num_movers)
    total, lengths = step.new_zeros(num_movers, 2).index_add(0, mover, step), none.index_add(0, mover, length)
    longest = none.scatter_reduce(0, mover, length, "amax")
    return total * (longest / lengths.clamp_min(1e-9))[:, None]
