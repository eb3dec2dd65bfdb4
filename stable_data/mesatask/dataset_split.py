"""The split of a scene: train, validation or test by a hash of its near-duplicate group, or unseen by its type of table."""

import hashlib
from dataclasses import dataclass

from stable_data.mesatask.dataset import TABLE_TYPES


@dataclass(frozen=True, slots=True)
class SplitShares:
    """How near-duplicate groups are distributed over the splits.

    Attributes:
        seed: Of the hash.
        train: Share of the groups in the training split.
        validation: Share of the groups in the validation split; the rest is the test split.
    """

    seed: int = 0
    train: float = 0.9
    validation: float = 0.05


def split_of(group: str, table_type: str, shares: SplitShares = SplitShares()) -> str:
    """The split of a near-duplicate group. It does not change when scenes are added to the data set.

    Args:
        group: The group, see :func:`~stable_data.mesatask.near_duplicates.duplicate_group`.
        table_type: The type of table. Types that MesaTask-10K does not have are not trained on: their split is ``unseen``.
        shares: The shares of the splits.

    Returns:
        ``train``, ``validation``, ``test`` or ``unseen``.
    """
    if table_type not in TABLE_TYPES:
        return "unseen"
    place = int(hashlib.sha256(f"{shares.seed}:{group}".encode()).hexdigest()[:8], 16) / 2**32  # in [0, 1)
    if place < shares.train:
        return "train"
    return "validation" if place < shares.train + shares.validation else "test"
