"""Cells of the table in the words of an instruction: rows, columns and corners."""

import re
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from models.instruction_reader.network import CELLS

Scores: TypeAlias = npt.NDArray[np.float32]
"""Probabilities, the last axis over classes."""

_ROWS = {
    **dict.fromkeys(("front", "near", "nearest", "closest", "closer"), "front"),
    **dict.fromkeys(("back", "rear", "far", "farthest", "furthest", "farther"), "back"),
}
_CORNER_ROWS = {"bottom": "front", "top": "back"}
"""Words of rows before a side and ``corner``: the table as a person sees it on paper."""

_COLUMNS = {"left": "left", "leftmost": "left", "right": "right", "rightmost": "right"}
_CENTRE = frozenset({"centre", "center", "middle", "central"})
"""Words of rows and columns of the table."""

_AT_EDGE = frozenset({"corner", "edge", "end", "left", "right", "side"})  # words after "near" and "far" that mean a row

_IN_CORNER = re.compile(
    r"(?:, )?(?:that|which) (?:' s|is|was|sits|stands|lies)(?: now| still)? (?:in|at) the "
    r"(?P<row>front|back|rear|near|far) (?:- )?(?P<column>left|right) (?:- )?(?:hand )?corner\b"
)
_CORNER_WORDS = 14

_AFTER_JUST = frozenset({"at", "away", "behind", "beside", "by", "here", "in", "next", "now", "on", "there", "under", "up"})
"""Words after a ``right`` that means ``just``."""

_CELL_GAP = 3  # words between two that mean one cell, as in "the middle of the front edge"
_CLAUSE = 6  # most words between two of one clause that may mean one cell
_STOPS = frozenset(".;!?")

CLAUSE_ENDS = frozenset({*_ROWS, *_COLUMNS, *_AT_EDGE, *_CENTRE, "me", "you", "us", "viewer", "robot"})
"""Words that may end a clause which singles out an object by its place."""

SINGLING = frozenset(
    {
        "bigger", "closer", "farther", "higher", "larger", "left", "longer", "lower", "nearer", "right", "shorter", "smaller",
        "taller", "thicker", "thinner", "upper", "wider",
    }
)  # fmt: skip
"""Words before a noun that single out one of several objects."""

_IS_PLACE = 0.5


def of_spoken_cells(scores: Scores, words: Sequence[str]) -> Scores:
    """Returns the probabilities of cells without the cells that no words mean: frames teach each cell in few words.

    Args:
        scores: Probabilities of each mention, (M, cells).
        words: The words of the sentence.
    """
    spoken = spoken_cells(words)
    is_spoken = np.array([cell in spoken for cell in CELLS], bool)
    likely = scores + (scores[:, :1] < _IS_PLACE) * is_spoken  # a place that is not "none" is one of those that are spoken of
    return np.where(is_spoken | (np.arange(len(CELLS)) == 0), likely, 0).astype(np.float32)


def set_stated_corners(said: Mapping[str, Scores], words: Sequence[str], ends: Sequence[int]) -> None:
    """Gives a mention the corner that a clause after it says: ``the mug that is in the back left corner``.

    Args:
        said: Probabilities by name, which are changed.
        words: The words of the sentence.
        ends: The last word of each mention.
    """
    for k, end in enumerate(ends):
        clause = _IN_CORNER.match(" ".join(words[end + 1 : end + _CORNER_WORDS]))
        if clause is not None:
            cell = _cell(_ROWS[clause["row"]], _COLUMNS[clause["column"]])
            said["region"][k] = np.eye(len(CELLS), dtype=np.float32)[CELLS.index(cell)]
            said["goal_region"][k, CELLS.index(cell)] = 0


def spoken_cells(words: Sequence[str]) -> set[str]:
    """Returns the cells that words of rows and columns mean; words that stand close together mean one cell.

    Words of one clause that stand apart ("on the right, all the way at the back") may mean one cell or several.
    """
    words = [_CORNER_ROWS[w] if w in _CORNER_ROWS and _is_corner(words, k) else w for k, w in enumerate(words)]
    found: set[str] = set()
    row = column = ""
    last = -1
    for k, word in enumerate(words):
        if word not in _ROWS and word not in _COLUMNS and word not in _CENTRE:
            continue
        if word in ("near", "far") and not (k + 1 < len(words) and words[k + 1] in _AT_EDGE):
            continue
        if _singles_out(words, k) or (
            word == "right" and words[k - 1 : k] != ["the"] and {*words[k + 1 : k + 2]} & _AFTER_JUST
        ):
            continue
        other = (word in _ROWS and row not in ("", "middle", _ROWS[word])) or (
            word in _COLUMNS and column not in ("", _COLUMNS[word])
        )
        between = words[last + 1 : k]
        if last >= 0 and (other or len(between) >= _CELL_GAP):
            found.add(_cell(row, column))
            if other or len(between) > _CLAUSE or not _STOPS.isdisjoint(between):
                row = column = ""
            elif _cell(_ROWS.get(word, row), _COLUMNS.get(word, column)) != _cell(row, column):
                found.add(_cell(_ROWS.get(word, ""), _COLUMNS.get(word, "")))
        row, column = _ROWS.get(word, row), _COLUMNS.get(word, column)
        last = k
    return found | {_cell(row, column)} if last >= 0 else found


def _is_corner(words: Sequence[str], k: int) -> bool:
    """Whether the words after word k are a side and ``corner``, as in ``bottom left corner`` and ``top right - hand corner``."""
    after = [w for w in words[k + 1 : k + 5] if w not in ("-", "hand")]
    return len(after) > 1 and after[0] in _COLUMNS and after[1] == "corner"


def _singles_out(words: Sequence[str], k: int) -> bool:
    """Whether a word of a row or column says which of several objects is meant, not where: ``the right-hand cup``."""
    if tuple(words[k + 1 : k + 3]) == ("-", "hand"):
        return not _AT_EDGE & {*words[k + 3 : k + 4]}
    clause = words[max(0, k - 5) : k + 1]  # "that is farthest to the left"
    return any(
        clause[n] in ("that", "which")
        and clause[n + 1] == "is"
        and (clause[n + 2].endswith("est") or clause[n + 2] in SINGLING or clause[n + 2] == "further")
        and _STOPS.isdisjoint(clause[n:])
        for n in range(len(clause) - 2)
    )


def _cell(row: str, column: str) -> str:
    return f"{row or 'middle'}_{column or 'middle'}"
