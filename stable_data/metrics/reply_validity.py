"""How many of a reasoner's replies can be used: they parse and pass the checks."""

from collections import Counter
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReplyValidity:
    """Counts of replies.

    Attributes:
        num_valid: Replies that parse and pass the checks.
        invalid: Code of a failure and how many replies have it first, most frequent first.
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
        """All of them, unknown ones included."""
        return self.num_valid + self.num_invalid + self.num_unknown

    @property
    def share(self) -> float | None:
        """Valid ones over all; what is unknown is not valid. None where there were none."""
        return self.num_valid / self.num_replies if self.num_replies else None

    def __str__(self) -> str:
        """The figures as text."""
        share = f" ({100 * self.share:.1f} %)" if self.share is not None else ""
        unknown = f", {self.num_unknown} unknown" if self.num_unknown else ""
        line = f"{'replies valid':<44} {self.num_valid} of {self.num_replies}{share}{unknown}"
        return "\n".join([line, *(f"  {code:<42} {count}" for code, count in self.invalid)])


class ReplyTally:
    """Counts outcomes as they come."""

    def __init__(self) -> None:
        self._valid = 0
        self._unknown = 0
        self._invalid = Counter[str]()

    def valid(self) -> None:
        """A reply that parses and passes the checks."""
        self._valid += 1

    def invalid(self, code: str) -> None:
        """A reply that does not.

        Args:
            code: The ``code`` of the error that it was refused with.
        """
        self._invalid[code] += 1

    def unknown(self) -> None:
        """A request whose reply could not be judged."""
        self._unknown += 1

    def figures(self) -> ReplyValidity:
        """The counts so far."""
        invalid = sorted(self._invalid.items(), key=lambda item: (-item[1], item[0]))
        return ReplyValidity(self._valid, tuple(invalid), self._unknown)
