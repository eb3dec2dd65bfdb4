"""The baselines by name."""

from collections.abc import Mapping
from types import MappingProxyType

from models.baselines.mesatask import MesaTask
from models.baselines.outcome import Baseline
from models.baselines.penalty import PenaltyDescent
from models.baselines.settling import Settle
from models.baselines.steerable import Steerable

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
