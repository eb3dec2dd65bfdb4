"""Answers of a language model that were refused."""

from dataclasses import dataclass

from models.semantic_reasoner.replies.checks import ReplyFault


@dataclass(frozen=True, slots=True)
class RefusedReply:
    """An answer that was refused.

    Attributes:
        answer: The text of the answer.
        faults: The reasons.
    """

    answer: str
    faults: tuple[ReplyFault, ...]

    @property
    def reason(self) -> str:
        """The faults in one line."""
        return "; ".join(f.message for f in self.faults)

    @property
    def is_hard(self) -> bool:
        """Whether one of the faults is hard."""
        return any(f.is_hard for f in self.faults)
