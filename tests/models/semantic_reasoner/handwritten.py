"""Instructions as people would say them, written by hand: nothing of the reasoner's training data sounds like them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_data.metrics.alignment import AlignmentReference
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import Relation, RelationKind, Tabletop

FILE = Path(__file__).with_suffix(".jsonl")


@dataclass(frozen=True, slots=True)
class Handwritten:
    """One of them.

    Attributes:
        instruction: The words.
        table: The table that it is said at.
        reference: The objects that it speaks of, and what it says of where they are at the start.
        unknown: Things that it speaks of and the embedded world has nothing like.
    """

    instruction: str
    table: Tabletop
    reference: AlignmentReference
    unknown: tuple[str, ...]


def read_handwritten(file: Path = FILE) -> tuple[Handwritten, ...]:
    """All of a file, in its order; further keys of a line are not read."""
    lines = file.read_text("utf-8").splitlines()
    return tuple(_of(f"{file.stem}_{number:02}", json.loads(line)) for number, line in enumerate(lines) if line.strip())


def _of(name: str, row: dict[str, Any]) -> Handwritten:
    kinds = [entry if isinstance(entry, list) else [entry] for entry in row["objects"]]
    required = tuple(RequiredObject(str(k), tuple(categories)) for k, categories in enumerate(kinds))
    relations = tuple(Relation(str(a), RelationKind(kind), str(b)) for a, kind, b in row["relations"])
    width, depth = row["table_size_cm"]
    table = Tabletop(row["table_type"], (width / 100, depth / 100))
    return Handwritten(row["instruction"], table, AlignmentReference(name, required, relations), tuple(row["unknown"]))
