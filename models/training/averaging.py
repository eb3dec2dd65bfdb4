"""The weighted mean of the weights of networks that were trained one from another."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


def average_states(states: Sequence[Mapping[str, Tensor]], shares: Sequence[float]) -> dict[str, Tensor]:
    """Returns the weighted mean of states of one architecture.

    Args:
        states: The weights by name; what is no floating-point number is taken from the first.
        shares: The share of each, not all 0; they are divided by their sum.

    Raises:
        ValueError: There are not as many shares as states.
    """
    total = sum(shares)

    def mean(name: str) -> Tensor:
        first = states[0][name]
        if not first.is_floating_point() or all(torch.equal(first, state[name]) for state in states):
            return first  # the mean of equal values may differ by rounding
        parts = [share / total * state[name] for share, state in zip(shares, states, strict=True)]
        return torch.stack(parts).sum(0)

    return {name: mean(name) for name in states[0]}
