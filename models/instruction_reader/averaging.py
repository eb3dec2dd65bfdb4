"""Averages the weights of readers that were trained one from another: the mean reads constructions that none was taught better.

``python -m models.instruction_reader.averaging OUT FILE SHARE FILE SHARE ...``
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from models.instruction_reader.weights import ReaderModel, load_reader, save_reader
from models.training.averaging import average_states
from stable_data.errors import ConfigError


def average_readers(readers: Sequence[ReaderModel], shares: Sequence[float]) -> ReaderModel:
    """Gives the first reader the weighted mean of all weights, and returns it.

    Args:
        readers: Readers of one architecture; the first one is changed.
        shares: The share of each, not all 0; they are divided by their sum.

    Raises:
        ValueError: There are not as many shares as readers.
    """
    states = average_states([reader.network.state_dict() for reader in readers], shares)
    readers[0].network.load_state_dict(states)
    return readers[0]


def main(out: str, *rest: str) -> None:
    """Writes the mean of reader weights; the notes of the file are those of the first one.

    Raises:
        ConfigError: A file has no share, or it cannot be read.
    """
    if not rest or len(rest) % 2:
        raise ConfigError("expected OUT, then a file and its share for each reader", "config_invalid")
    files, shares = rest[::2], [float(share) for share in rest[1::2]]
    reader = average_readers([load_reader(Path(file), trains=True) for file in files], shares)
    notes: Mapping[str, str] = {**reader.notes, "mean_of": " ".join(rest[1::2])}
    save_reader(Path(out), reader, notes)


if __name__ == "__main__":
    main(*sys.argv[1:])
