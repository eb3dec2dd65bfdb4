"""Turns on the spot that words describe: "a quarter turn", "by 45 degrees clockwise", "to face the wall"."""

import re
from collections.abc import Sequence

_DEGREES = re.compile(r"\b(\d{1,3}) ?(?:°|deg)")
_TURNS = {
    "quarter": 90, "half": 180, "eighth": 45, "around": 180, "round": 180, "about": 180, "other": 180, "reverse": 180,
    "reversed": 180, "sideways": 90, "lengthwise": 90, "crosswise": 90, "crossways": 90, "angle": 90, "angles": 90,
    "ten": 10, "fifteen": 15, "twenty": 20, "thirty": 30, "forty": 45, "fifty": 50, "sixty": 60, "ninety": 90, "hundred": 180,
    **dict.fromkeys(("slightly", "bit", "little", "touch", "fraction", "smidge", "notch", "further"), 20),
}  # fmt: skip
"""Degrees of a turn by a word of it; the first word that is there counts."""

_FACINGS = {
    "front": 0, "forward": 0, "forwards": 0, "me": 0, "us": 0, "viewer": 0, "camera": 0,
    "right": 90, "back": 180, "backwards": 180, "wall": 180, "away": 180, "left": -90,
}  # fmt: skip
"""Yaw in degrees of an object that faces somewhere, as :func:`stable_data.scene_graph.relations.facing_of` defines it."""

_BACKWARD = frozenset({"clockwise", "cw"})
_TURNING = frozenset(
    (
        "turn",
        "turned",
        "turns",
        "twist",
        "degrees",
        "degree",
        "deg",
        "revolution",
        "rotated",
        "rotate",
        "clockwise",
        "cw",
        "anticlockwise",
        "counterclockwise",
        "ccw",
    )
)
_AROUND = frozenset(
    (
        "around",
        "round",
        "about",
        "sideways",
        "lengthwise",
        "crosswise",
        "crossways",
        "reverse",
        "reversed",
        "angle",
        "angles",
        "way",
    )
)
_FACING = frozenset({"face", "faces", "facing", "point", "points", "pointing", "look", "looks", "looking", "towards", "toward"})
_SHORT = 4  # words of a turn such as "the other way round", which has no word that means a turn alone
_USUAL = 90  # degrees of a turn of which no more is said


def yaw_after_turn(words: Sequence[str], yaw: int) -> int | None:
    """Returns the yaw of an object after a turn, whole degrees in (-180, 180]; None if the words describe no turn.

    Args:
        words: The words of the turn, in lower case.
        yaw: The yaw before, degrees, counter-clockwise seen from above.
    """
    said = set(words)
    if said & _FACING:
        facing = next((_FACINGS[word] for word in words if word in _FACINGS), None)
        if facing is not None:
            return facing
    degrees = _DEGREES.search(" ".join(words))
    if degrees is None and not said & _TURNING and not (said & _AROUND and len(words) <= _SHORT):
        return None
    amount = int(degrees[1]) if degrees else next((_TURNS[word] for word in words if word in _TURNS), _USUAL)
    turned = yaw + (-amount if said & _BACKWARD else amount)
    return 180 - (180 - turned) % 360
