"""Questions and answers where an answer may bring further questions: none waits for those that were asked with it.

A conversation is a generator: it yields answers with the numbers of their questions, counted in the order in which they were asked, and
is sent the questions that come of them. It ends when nothing is left to be answered.
"""

from collections.abc import Callable, Generator, Sequence
from typing import TypeAlias, TypeVar

Q = TypeVar("Q")
A = TypeVar("A")

Conversation: TypeAlias = Generator[list[tuple[int, A]], Sequence[Q], None]
"""Yields answers, each with the number of its question; is sent further questions."""


def batch_conversation(answer: Callable[[Sequence[Q]], Sequence[A]], questions: Sequence[Q]) -> Conversation[A, Q]:
    """The conversation with somebody who answers whole batches: what comes of one batch is the next.

    Args:
        answer: One answer for each question, in their order.
        questions: Those to begin with.
    """
    first = 0
    while questions:
        found = list(enumerate(answer(questions), first))
        first += len(questions)
        questions = yield found


def run_conversation(talk: Conversation[A, Q], answer: Callable[[list[tuple[int, A]]], Sequence[Q]]) -> None:
    """Leads a conversation to its end.

    Args:
        talk: The conversation, not begun.
        answer: What comes of answers: further questions.
    """
    try:
        found = next(talk)
        while True:
            found = talk.send(answer(found))
    except StopIteration:
        return
