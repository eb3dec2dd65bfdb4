"""What the checks of a run find: damage, and what cannot be known."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from stable_data.errors import short_line

MOST_TOLD = 1000
"""Findings of one file that are shown: a file of few bytes may have millions of equal rows."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Damage of a run.

    Attributes:
        where: The file in the run's folder, such as ``scenes/part-0afc4d93b893eb0e.parquet``; or a table, or empty for the whole run.
        row: Row of the file, from 0; None if it is no single row.
        what: What is wrong, one line.
    """

    where: str
    row: int | None
    what: str

    def __str__(self) -> str:
        """Returns the finding in one line: table, shard, row, what."""
        row = "" if self.row is None else f" row {self.row}"
        what = " ".join(self.what.split())
        return short_line(f"{short_line(self.where)}{row}: {what}" if self.where else what)


class Findings:
    """Collects what the checks find. Findings are passed on at once and not kept; of one file, only the first are passed on.

    Args:
        tell: Called with each finding.

    Attributes:
        num_damaged: Number of findings by table, or by file outside of the tables.
        unknown: What cannot be known, such as that a run is older than its checksums; each sentence once.
    """

    def __init__(self, tell: Callable[[Finding], None]) -> None:
        self._tell, self._of_file = tell, Counter[str]()
        self.num_damaged = Counter[str]()
        self.unknown = list[str]()

    def damage(self, where: str, what: str, row: int | None = None) -> None:
        """Notes damage; the arguments are the attributes of :class:`Finding`."""
        self.num_damaged[where.partition("/")[0] or "the run"] += 1
        self._of_file[where] += 1
        if self._of_file[where] <= MOST_TOLD:
            self._tell(Finding(where, row, what))
        elif self._of_file[where] == MOST_TOLD + 1:
            self._tell(Finding(where, None, f"has more than {MOST_TOLD:,} findings; the others are counted and not shown"))

    def cannot_know(self, what: str) -> None:
        """Notes that something cannot be known: such a run is not known to be whole."""
        what = short_line(what)
        if what not in self.unknown:
            self.unknown.append(what)
