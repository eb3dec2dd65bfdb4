"""Linear assignment problems in batches, exact, on any device: shortest augmenting paths with potentials (Hungarian method)."""

import torch
from torch import Tensor


def assign(cost: Tensor) -> Tensor:
    """Solves P square assignment problems.

    Args:
        cost: Cost of each row's columns, (P, M, M) finite.

    Returns:
        The column of each row with the least total cost, (P, M) int64.
    """
    num_problems, size = cost.shape[:2]
    device = cost.device
    each = torch.arange(num_problems, device=device)
    # Column 0 and row 0 are outside the problem: a path starts there. cost[p, i, j] belongs to row i + 1 and column j + 1.
    row_potential = cost.new_zeros(num_problems, size + 1)
    potential = cost.new_zeros(num_problems, size + 1)
    row_of = torch.zeros((num_problems, size + 1), dtype=torch.long, device=device)
    for row in range(1, size + 1):
        row_of[:, 0] = row
        at = torch.zeros(num_problems, dtype=torch.long, device=device)  # the column in which each path is
        least = cost.new_full((num_problems, size + 1), torch.inf)
        before = torch.zeros_like(row_of)
        is_used = torch.zeros_like(row_of, dtype=torch.bool)
        for _ in range(row):  # with `row` rows to assign, a path has at most this many columns
            is_open = row_of[each, at] > 0
            is_used[each, at] |= is_open
            now = row_of[each, at]
            reduced = cost[each, (now - 1).clamp_min(0)] - row_potential[each, now][:, None] - potential[:, 1:]
            is_better = (reduced < least[:, 1:]) & ~is_used[:, 1:] & is_open[:, None]
            least[:, 1:] = torch.where(is_better, reduced, least[:, 1:])
            before[:, 1:] = torch.where(is_better, at[:, None], before[:, 1:])
            step, following = torch.where(is_used, torch.inf, least)[:, 1:].min(1)
            step = torch.where(is_open, step, 0)
            row_potential.scatter_add_(1, row_of, torch.where(is_used, step[:, None], 0))
            potential -= torch.where(is_used, step[:, None], 0)
            least = torch.where(is_used, least, least - step[:, None])
            at = torch.where(is_open, following + 1, at)
        for _ in range(row):  # gives each column of the path the row of the column before it
            previous = before[each, at]
            moved = torch.where(at > 0, row_of[each, previous], row_of[each, at])
            row_of[each, at] = moved
            at = torch.where(at > 0, previous, at)
    return row_of[:, 1:].argsort(1)
