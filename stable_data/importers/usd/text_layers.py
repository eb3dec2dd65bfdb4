"""How deep the brackets of a text layer of USD nest, found before USD parses it.

Its parser calls itself for each level, and what a file never closes is reported once for each level with the whole line: a few
megabytes of opening brackets end the process, or fill its memory.
"""

import re

import numpy as np

from stable_data.errors import MeshError
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, at_most

_TEXT = b"#usda"  # what a text layer begins with; USD parses no other
# A text that is not closed ends with its line, or with the file: USD refuses it, and the search stays linear.
_NO_CODE = re.compile(
    rb'"""(?>(?:[^"\\]+|\\.|"(?!""))*)(?:""")?'
    rb"|'''(?>(?:[^'\\]+|\\.|'(?!''))*)(?:''')?"
    rb'|"(?>(?:[^"\\\n]+|\\[^\n])*)"?'
    rb"|'(?>(?:[^'\\\n]+|\\[^\n])*)'?"
    rb"|@@@(?>(?:[^@]+|@(?!@@))*)(?:@@@)?|@[^@\n]*@?|#[^\n]*",
    re.DOTALL,
)
_OTHERS = bytes(set(range(256)) - set(b"()[]{}"))
_OPENS = np.isin(np.arange(256), list(b"([{"))
_PIECE = 2**20  # brackets that are counted at once


def check_brackets(content: bytes, path: str) -> None:
    """Refuses a text layer whose brackets nest too deep; binary layers and packages pass.

    Args:
        content: The file.
        path: Its name, for the message.

    Raises:
        MeshError: ``model_unreadable``.
    """
    if content.startswith(_TEXT) and bracket_levels(content) > LIMITS.model.max_bracket_levels:
        most = at_most(LIMITS.model, "max_bracket_levels", "levels")
        raise MeshError(
            f"{quote_value(path)} has brackets that nest deeper, expected {most}; is it hostile?", "model_unreadable"
        )


def bracket_levels(content: bytes) -> int:
    """Returns how many brackets of a text layer are open at once, outside of its texts, names of files and comments."""
    brackets = np.frombuffer(_NO_CODE.sub(b"", content).translate(None, _OTHERS), np.uint8)
    level = deepest = 0
    for start in range(0, len(brackets), _PIECE):
        steps = np.where(_OPENS[brackets[start : start + _PIECE]], 1, -1)
        steps[0] += level
        levels = np.cumsum(steps)
        levels -= np.minimum.accumulate(np.minimum(levels, 0))  # what closes nothing does not count
        level, deepest = int(levels[-1]), max(deepest, int(levels.max()))
    return deepest
