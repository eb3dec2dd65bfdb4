"""Conversations: questions and answers, where answers may lead to further questions that do not wait for the open ones.

A conversation is a generator. It yields answers with the numbers of their questions, counted in the order in which these were
asked, and is sent the questions that follow from them. It ends when no question is open.
"""

from collections.abc import Callable, Generator, Sequence
from typing import TypeAlias, TypeVar

Q = TypeVar("Q")
A = TypeVar("A")

Conversation: TypeAlias = Generator[list[tuple[int, A]], Sequence[Q], None]
"""Yields answers, each with the number of its question; is sent further questions."""


def batch_conversation(answer: Callable[[Sequence[Q]], Sequence[A]], questions: Sequence[Q]) -> Conversation[A, Q]:
    """Makes a conversation from a function that answers batches: the questions after one batch are the next batch.

    Args:
        answer: Returns one answer for each question, in their order.
        questions: The first batch.
    """
    first = 0
    while questions:
        found = list(enumerate(answer(questions), first))
        first += len(questions)
        questions = yield found


def run_conversation(talk: Conversation[A, Q], answer: Callable[[list[tuple[int, A]]], Sequence[Q]]) -> None:
    """Runs a conversation to its end.

    Args:
        talk: The conversation, not started.
        answer: Returns the questions that follow from answers.
    """
    try:
        found = next(talk)
        while True:
            found = talk.send(answer(found))
    except StopIteration:
        return


def collect_answers(talk: Conversation[A, Q], count: int) -> list[A]:
    """Runs a conversation without further questions.

    Args:
        talk: The conversation, not started.
        count: Number of its questions.

    Returns:
        One answer for each question, in their order.

    Raises:
        KeyError: A question has no answer.
    """
    done: dict[int, A] = {}

    def store(found: list[tuple[int, A]]) -> Sequence[Q]:
        done.update(found)
        return ()

    run_conversation(talk, store)
    return [done[k] for k in range(count)]
