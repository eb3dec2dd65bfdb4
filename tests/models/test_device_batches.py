from collections.abc import Sequence

import pytest
import torch

from models.device_batches import DeviceBatches
from stable_data.errors import ConfigError


def test_batches_are_halved_until_they_fit_and_nothing_is_lost() -> None:
    sizes = []

    def compute(items: Sequence[int]) -> list[int]:
        if len(items) > 4:
            raise torch.OutOfMemoryError
        sizes.append(len(items))
        return [-item for item in items]

    batches = DeviceBatches("flow", 8)
    with pytest.warns(RuntimeWarning, match=r"flow: the device has too little memory for 8 scenes; computing 4 at a time"):
        assert batches.run(range(10), compute) == [-n for n in range(10)]
    assert sizes == [4, 4, 2]


def test_one_item_that_does_not_fit_is_an_error() -> None:
    def compute(_: Sequence[int]) -> list[int]:
        raise torch.OutOfMemoryError

    with pytest.raises(ConfigError, match="too little memory for one scene"):
        DeviceBatches("flow", 1).run([1], compute)
