"""A batched computation that allocates memory; a separate process imports this module, so that it needs as little as it can."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipelines.correct.shard import CorrectWork
from tests.pipelines.execution.allocating import MIB


@dataclass(frozen=True, slots=True)
class Batch(CorrectWork):
    """A batched computation that holds 20 MiB for each scene."""

    def prepare_to_ask(self) -> None:
        """Nothing."""

    def answers(self, items: Sequence[str]) -> list[Any]:
        held = [bytearray(20 * MIB) for _ in items]
        return [None for _ in held]
