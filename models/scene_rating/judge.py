"""The interface of those who rate scenes; the judges in :mod:`stable_data.judges` are physics engines."""

from collections.abc import Sequence
from typing import Protocol

from models.scene_rating.rating_case import RatingCase
from stable_data.rating.rating import Rating

SYMBOLIC = "symbolic"
"""The judge by rules, in settings and in ratings."""


class RatingJudge(Protocol):
    """Rates scenes by the five criteria.

    Attributes:
        name: Its name in ratings.
        version: Hash of the prompt; or of the rules and of all that they rest on beside the scenes.
    """

    name: str
    version: str

    def rate(self, cases: Sequence[RatingCase]) -> list[Rating]:
        """Returns one rating for each scene, in their order; never raises for a single scene, whose rating is then unknown."""
        ...
