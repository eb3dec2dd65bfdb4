"""The current step of an item, so that a failure can name it."""

from dataclasses import dataclass


@dataclass(slots=True)
class ItemProgress:
    """The progress of an item.

    Attributes:
        step: The part of the work that is running, such as ``read``.
    """

    step: str
