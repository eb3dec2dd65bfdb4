"""How a draft is obtained: what is asked of the language model, and what that took."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias, TypeVar

from models.baselines.layout.draft import (
    OBJECTS_FORM,
    RELATIONS_FORM,
    RelationText,
    read_objects,
    read_relations,
)
from models.baselines.layout.layout_draft import relations_of_layout
from models.baselines.layout.prompts import objects_chat, relations_chat
from models.baselines.placement.problem import Constraint
from models.dual_system.requests import Answer, ChatRequest, ProposalRequest, Request
from models.semantic_reasoner.chat import ChatQuestion, ChatReply
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.errors import SceneError
from stable_data.random_seeds import named_seed
from stable_data.totals import total

T = TypeVar("T")
Asking: TypeAlias = Generator[Request, Answer, T]

UNUSABLE = "reply_unusable"
"""Code of a chat of which no answer could be used; other failures are those of the engine or of the question."""


@dataclass(frozen=True, slots=True)
class Draft:
    """Objects that need places.

    Attributes:
        objects: The objects; their positions are not used.
        constraints: The relations that they shall have, without conflicts.
    """

    objects: tuple[LayoutObject, ...]
    constraints: tuple[Constraint, ...]


@dataclass(slots=True, eq=False)
class Exchanges:
    """All that was asked of the language model for one draft.

    Attributes:
        task: The task.
        seed: Seed of all requests.
        answers: The answers so far.
        faults: What is wrong with the draft, and was left out of it.
        failure: Why there is no draft; empty if there is one.
        code: Short machine-readable reason of the failure.
    """

    task: LayoutTask
    seed: int
    answers: list[ChatReply | Proposal] = field(default_factory=list)
    faults: list[ReplyFault] = field(default_factory=list)
    failure: str = ""
    code: str = ""

    def ask(self, make: Callable[[], ChatQuestion]) -> Asking[object]:
        """Asks a chat, and returns what its reply contains; None if it has none, or if the chat cannot be made."""
        try:
            question = make()
        except SceneError as error:
            self.failure, self.code = str(error), error.code
            return None
        reply = yield ChatRequest(question, named_seed(self.seed, len(self.answers)))
        assert isinstance(reply, ChatReply)
        self.answers.append(reply)
        self.failure, self.code = reply.failure, reply.code
        return reply.content

    def objects(self, system: str) -> Asking[tuple[LayoutObject, ...] | None]:
        """Asks for the objects."""
        read = partial(read_objects, table=self.task.table)
        found = yield from self.ask(lambda: ChatQuestion(objects_chat(system, self.task), OBJECTS_FORM, read))
        assert found is None or isinstance(found, tuple)
        return found

    def relations(self, system: str, objects: Sequence[LayoutObject]) -> Asking[tuple[RelationText, ...] | None]:
        """Asks for the relations between objects."""
        found = yield from self.ask(
            lambda: ChatQuestion(relations_chat(system, self.task, objects), RELATIONS_FORM, read_relations)
        )
        assert found is None or isinstance(found, tuple)
        return found

    def proposal(self, layout: Sequence[LayoutObject] | None) -> Proposal:
        """Returns a proposal with what all requests took.

        Args:
            layout: The objects at their places; None if there are none.
        """
        refused = tuple(r for answer in self.answers for r in answer.refused)
        notices = tuple(n for answer in self.answers if isinstance(answer, Proposal) for n in answer.notices)
        counts = (
            sum(a.tries for a in self.answers),
            total(a.prompt_tokens for a in self.answers),
            total(a.reply_tokens for a in self.answers),
            total(a.cost for a in self.answers),
        )
        reply = None if layout is None else LayoutReply(tuple(layout))
        return Proposal(reply, tuple(self.faults), refused, self.failure, self.code, notices, *counts)


Drafting: TypeAlias = Callable[[Exchanges], Asking[Draft | None]]
"""Obtains a draft; None if there is none, which ``failure`` of the exchanges explains."""


def layout_drafting(
    interpret: InstructionInterpreter | None = None, holds: Callable[[str], bool | None] = lambda _: None
) -> Drafting:
    """Returns a drafting that takes objects and relations from a whole layout, for models that know no other prompts.

    Args:
        interpret: Interprets the instruction; None: only the layout has relations.
        holds: Whether things of a category can contain others; None if it is not known.
    """

    def draft(exchanges: Exchanges) -> Asking[Draft | None]:
        task = exchanges.task
        question = ReasonerQuestion(task.instruction, task.shown_table, "whole", details=task.details)
        proposal = yield ProposalRequest(question, exchanges.seed)
        assert isinstance(proposal, Proposal)
        exchanges.answers.append(proposal)
        exchanges.faults += proposal.faults
        exchanges.failure, exchanges.code = proposal.failure, proposal.code
        if proposal.reply is None:
            return None
        objects = proposal.reply.objects
        checked = relations_of_layout(objects, task.instruction, task.shown_table, interpret, holds)
        exchanges.faults += checked.faults
        return Draft(objects, checked.constraints)

    return draft
