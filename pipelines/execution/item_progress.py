"""How far an item came, so that a failure names its step."""

from dataclasses import dataclass


@dataclass(slots=True)
class ItemProgress:
    """How far an item came.

    Attributes:
        step: What is being done to it.
    """

    step: str
