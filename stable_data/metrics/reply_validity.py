"""Validity of a reasoner's replies: the share that parses and passes the checks."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReplyValidity:
    """Counts of replies.

    Attributes:
        num_valid: Replies that parse and pass the checks.
        invalid: Code of a failure and the number of replies whose first failure it is, most frequent first.
        num_unknown: Requests whose reply could not be judged, such as those that no engine answered.
    """

    num_valid: int
    invalid: tuple[tuple[str, int], ...]
    num_unknown: int

    @property
    def num_invalid(self) -> int:
        """Replies that do not parse or fail a check."""
        return sum(count for _, count in self.invalid)

    @property
    def num_replies(self) -> int:
        """All replies, with the unknown ones."""
        return self.num_valid + self.num_invalid + self.num_unknown

    @property
    def share(self) -> float | None:
        """Valid replies over all; an unknown reply is not valid. None without replies."""
        return self.num_valid / self.num_replies if self.num_replies else None

    def __str__(self) -> str:
        share = f" ({100 * self.share:.1f} %)" if self.share is not None else ""
        unknown = f", {self.num_unknown} unknown" if self.num_unknown else ""
        line = f"{'replies valid':<44} {self.num_valid} of {self.num_replies}{share}{unknown}"
        return "\n".join([line, *(f"  {code:<42} {count}" for code, count in self.invalid)])


def reply_validity(num_valid: int, invalid: Iterable[str], num_unknown: int) -> ReplyValidity:
    """Summarises replies; ``invalid`` are the codes of the errors that refused the invalid ones."""
    counts = sorted(Counter(invalid).items(), key=lambda item: (-item[1], item[0]))
    return ReplyValidity(num_valid, tuple(counts), num_unknown)
