"""A batched computation that allocates memory; a separate process imports this module, so that it needs as little as it can."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from pipelines.correct.shard import CorrectWork
from pipelines.execution.item_progress import ItemProgress
from stable_data.errors import Notice
from stable_data.storage.table_rows import notice_row
from tests.pipelines.execution.allocating import MIB


@dataclass(frozen=True, slots=True)
class Batch(CorrectWork):
    """A batched computation that holds 20 MiB for each scene; of a big one 400 MiB, an odd one fails, a slow one takes a minute."""

    def opened(self) -> Any:
        return SimpleNamespace(taken={})

    def look(self, item: str, progress: ItemProgress) -> None:
        """Nothing."""

    def prepare_to_ask(self, items: Sequence[str]) -> None:
        """Nothing."""

    def answers(self, items: Sequence[str]) -> list[Any]:
        if "odd" in items:
            raise ValueError("it is odd")
        time.sleep(60.0 * items.count("slow"))
        held = [bytearray((400 if item == "big" else 20) * MIB) for item in items]
        return [None for _ in held]

    def finished(self, item: str, answer: Any) -> Any:
        return {"warnings": [notice_row(Notice(item, "finish", "done", item))]}
