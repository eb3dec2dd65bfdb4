"""The baselines by name."""

from collections.abc import Mapping
from types import MappingProxyType

from benchmarks.baselines.mesatask import MesaTask
from benchmarks.baselines.outcome import Baseline
from benchmarks.baselines.penalty import PenaltyDescent
from benchmarks.baselines.settling import Settle
from benchmarks.baselines.steerable import Steerable

METHODS: Mapping[str, Baseline] = MappingProxyType(
    {
        "mesatask": MesaTask(),
        "mesatask_released": MesaTask(is_released=True),
        "steerable": Steerable(),
        "steerable_parts": Steerable(with_parts=True),
        "penalty": PenaltyDescent(),
        "settle": Settle(),
    }
)
"""Re-implementations of the paper's post-hoc optimisers, and two plain methods."""
