import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from models.physics_corrector.training.assignment import assign


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 4), st.booleans())
def test_the_total_cost_is_the_least(seed: int, size: int, num_problems: int, has_ties: bool) -> None:
    cost = torch.rand(num_problems, size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    cost = (3 * cost).round() if has_ties else cost
    columns = assign(cost)
    assert torch.equal(columns.sort(1).values, torch.arange(size).expand_as(columns))
    for own, chosen in zip(cost.numpy(), columns.numpy(), strict=True):
        rows, best = linear_sum_assignment(own)
        assert own[np.arange(size), chosen].sum() == pytest.approx(own[rows, best].sum())


def test_no_problem_has_no_answer() -> None:
    assert assign(torch.zeros(0, 3, 3)).shape == (0, 3)
