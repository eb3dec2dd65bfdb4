"""Makes the input of a finding smaller while the finding stays the same."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from benchmarks.fuzzing.cases import Case, Target, num_edits

_MOST_BYTES = 200_000  # of an input of which parts are cut out: each try runs the reader
_LEAST_PIECE = 1


def reduced(
    case: Case, target: Target, seed: int, number: int, is_same: Callable[[Case], bool], may_go_on: Callable[[], bool]
) -> Case:
    """Returns an input with the same finding: with fewer edits, then with less content.

    Args:
        case: The input.
        target: Its target.
        seed: The seed of its campaign.
        number: Its number.
        is_same: Whether an input has the finding.
        may_go_on: Whether there is time for another try.
    """
    for other in _with_fewer_edits(target, seed, number):
        if not may_go_on():
            return case
        if other != case and is_same(other):
            case = other
            break
    if len(case.content) > _MOST_BYTES:
        return case
    size = max(1, len(case.content) // 2)
    while size >= _LEAST_PIECE:
        at, has_shrunk = 0, False
        while at < len(case.content):
            if not may_go_on():
                return case
            other = replace(case, content=case.content[:at] + case.content[at + size :])
            if is_same(other):
                case, has_shrunk = other, True
            else:
                at += size
        size = size if has_shrunk and size > 1 else size // 2
    return case


def _with_fewer_edits(target: Target, seed: int, number: int) -> Iterator[Case]:
    """The input with one edit, then with all but one."""
    edits = range(num_edits(seed, target, number))
    if len(edits) > 1:
        yield from (target.case(seed, number, {k}) for k in edits)
    if len(edits) > 2:
        yield from (target.case(seed, number, {*edits} - {k}) for k in edits)
