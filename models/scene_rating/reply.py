"""Reads the scores in a reply; a reply with any fault has no scores at all."""

from collections.abc import Mapping
from typing import Any

from models.scene_rating.prompt import NUMBERS
from stable_data.errors import SceneError
from stable_data.json_text import quote_value
from stable_data.rating.criteria import CRITERIA, HIGHEST, LOWEST, STEP
from stable_data.rating.rating import CriterionScore

_LONGEST_RATIONALE = 1000  # characters that are kept

NOT_SEEN = "pictures_not_seen"
"""Code of a reply that does not repeat the numbers below the pictures."""


def read_rating(data: Any, numbers: Mapping[str, int]) -> dict[str, CriterionScore]:
    """Returns the scores of a reply by criterion.

    Args:
        data: The JSON document of the reply.
        numbers: The number below each picture, by the picture's name.

    Raises:
        SceneError: The reply is no object, lacks a criterion, a score or a rationale, has a score that is none
            (``reply_malformed``), or was given without sight of the pictures (``pictures_not_seen``).
    """
    if not isinstance(data, dict):
        raise SceneError(f"reply is {quote_value(data)}, expected a JSON object", "reply_malformed")
    found = {criterion.key: _score(data, criterion.key) for criterion in CRITERIA}
    for name, number in numbers.items():
        said = data.get(NUMBERS[name])
        if type(said) is not int or said != number:  # the right number is not told, since the message is sent to the model
            raise SceneError(f"{quote_value(said)} is not the number below the {name} picture; look at both again", NOT_SEEN)
    return found


def _score(data: Mapping[str, Any], key: str) -> CriterionScore:
    entry: Any = data.get(key)
    if not isinstance(entry, dict):
        raise SceneError(f'"{key}" is {quote_value(entry)}, expected an object with rationale and score', "reply_malformed")
    score: Any = entry.get("score")
    rationale: Any = entry.get("rationale")
    # JSON's true is an int in Python.
    if type(score) not in (int, float) or not LOWEST <= score <= HIGHEST or (score - LOWEST) % STEP:
        raise SceneError(
            f'"{key}" has score {quote_value(score)}, expected a whole or half number from {LOWEST:g} to {HIGHEST:g}',
            "reply_malformed",
        )
    if not isinstance(rationale, str) or not rationale.strip():
        raise SceneError(f'"{key}" has rationale {quote_value(rationale)}, expected one or two sentences', "reply_malformed")
    return CriterionScore(float(score), " ".join(rationale.split())[:_LONGEST_RATIONALE])
