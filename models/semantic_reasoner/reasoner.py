"""The Semantic Reasoner: asks an engine, checks its answers, and asks again after an answer with faults."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeAlias

from models.semantic_reasoner.chat import ChatQuestion, ChatReply, PendingChat
from models.semantic_reasoner.engines.incremental_batches import Conversation, collect_answers
from models.semantic_reasoner.engines.protocol import Completion, Engine, Request, conversation
from models.semantic_reasoner.language.interpreter import (
    InstructionInterpreter,
    compare_with_instruction,
    relations_of_task,
)
from models.semantic_reasoner.prompt_styles import PromptStyle, StagedPromptStyle
from models.semantic_reasoner.replies.checks import CROWDED, REQUIRED_MISSING, ReplyFault
from models.semantic_reasoner.replies.grammar import MOST_OBJECTS
from models.semantic_reasoner.replies.object_check import ObjectCheck
from models.semantic_reasoner.replies.refused_reply import RefusedReply
from models.semantic_reasoner.replies.relation_repair import repair_relations
from models.semantic_reasoner.replies.required_objects import PLACED, RemovedObject, RequiredObjects
from models.semantic_reasoner.text.prompt import ReasonerQuestion, check_instruction
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply, renumber_instances
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.random_seeds import named_seed
from stable_data.scene import Relation, Stage
from stable_data.totals import total

_LEFT_OUT = "left_out"
_SMALL_SHARE = 1 / 8  # of the objects of a reply: so few are removed without another try


class FaultFinder(Protocol):
    """Finds faults in a reply to a question."""

    def __call__(self, reply: LayoutReply, question: ReasonerQuestion, /) -> Sequence[ReplyFault]:
        """Returns the faults; none if the reply may enter the scene."""
        ...


@dataclass(frozen=True, slots=True)
class Proposal:
    """The objects that the reasoner proposes for a question.

    Attributes:
        reply: The objects; None if no answer could be used.
        faults: The soft faults that remain in the reply.
        refused: The refused answers, in the order of the tries.
        failure: Why there is no reply, one line; empty if there is one.
        code: Short machine-readable reason of the failure.
        notices: Unknown words of the question, and how each was interpreted.
        tries: How often the engine was asked; 0 if the question is invalid.
        prompt_tokens: Tokens read, over all tries; None if the engine did not count them.
        reply_tokens: Tokens written, over all tries; None likewise.
        cost: Cost of all tries, in the currency of the engine's prices; None if it is not known.
    """

    reply: LayoutReply | None
    faults: tuple[ReplyFault, ...] = ()
    refused: tuple[RefusedReply, ...] = ()
    failure: str = ""
    code: str = ""
    notices: tuple[Notice, ...] = ()
    tries: int = 0
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    cost: float | None = 0.0

    @property
    def objects(self) -> tuple[LayoutObject, ...]:
        """New and changed objects; none after a failure."""
        return () if self.reply is None else self.reply.objects


Question: TypeAlias = ReasonerQuestion | ChatQuestion
Reply: TypeAlias = Proposal | ChatReply
"""The answer to a question: a proposal to one for a layout, a reply to a chat."""


@dataclass(frozen=True, slots=True)
class _UsableReply:
    """A refused reply that may be used if the tries run out.

    Attributes:
        reply: The reply, without its objects that have hard faults.
        faults: Its soft faults.
        changes: Soft faults that report the objects that were left out or placed anew.
    """

    reply: LayoutReply
    faults: tuple[ReplyFault, ...] = ()
    changes: tuple[ReplyFault, ...] = ()

    @property
    def rank(self) -> tuple[bool, int, int]:
        """How bad it is, less is better; an edit with many faults is better than one that changes nothing."""
        return any(f.code == "nothing_changed" for f in self.faults), len(self.changes), len(self.faults)

    @property
    def holds(self) -> bool:
        """Whether all relations of the instruction hold."""
        return not any(f.relation for f in self.faults)


@dataclass(slots=True, eq=False)
class _PendingQuestion:
    """A question without an accepted answer, with the answers that may be used if the tries run out."""

    question: ReasonerQuestion
    seed: int
    notices: tuple[Notice, ...] = ()
    refused: list[RefusedReply] = field(default_factory=list)
    usable: list[_UsableReply] = field(default_factory=list)
    num_objects: int = 0
    tries: int = 0
    prompt_tokens: int | None = 0
    reply_tokens: int | None = 0
    cost: float | None = 0.0

    def refuse(self, answer: str, faults: Sequence[ReplyFault]) -> None:
        """Records a refused answer."""
        self.refused.append(RefusedReply(answer, tuple(faults)))

    def proposal(self, usable: _UsableReply | None = None, failure: str = "", code: str = "") -> Proposal:
        """Returns the proposal of a reply, or a failure: without the reason, that of the last answer."""
        reply, faults = (None, ()) if usable is None else (usable.reply, (*usable.changes, *usable.faults))
        if usable is None and not failure:
            reason = self.refused[-1].reason
            failure = f"{len(self.refused)} answers could not be used, the last because {reason}"
            code = "reply_unusable"
        counts = (self.tries, self.prompt_tokens, self.reply_tokens, self.cost)
        return Proposal(reply, faults, tuple(self.refused), failure, code, self.notices, *counts)


class SemanticReasoner:
    """Asks an engine for the objects of a stage, of a whole layout, or of an edit: SR in the paper.

    In a refused answer, objects with hard faults are left out, and required objects among them are placed anew. An answer that
    passes after changes of at most an eighth of its objects is used at once; in the first stage, if none is left out. After the
    last try the reasoner uses the answer with the fewest changes in which all relations of the instruction hold, or in which
    objects can be moved until they hold; else the one with the fewest changes. The proposal's faults name what was left out,
    placed anew or moved.

    Args:
        engine: Completes the requests.
        check: Finds faults in a reply; None accepts every reply that can be parsed.
        tries: How often a question is asked at most.
        tells_reasons: Whether a retry shows the refused answers and the reasons, which large models can use; else a retry asks
            the same question with another seed.
        interpret: Interprets instructions; its notices are those of the proposals. None gives no notices.
        plan_edit: Returns the reply to an edit without the engine. None asks the engine.
        dialect: The style of the prompts; by default this project's own.
        required: Judges the number of required objects, and adds those that an answer lacks; None does neither.
        object_check: Returns the judge of each object of the answers to a question while they are written; None judges none.
    """

    def __init__(
        self,
        engine: Engine,
        check: FaultFinder | None = None,
        tries: int = 4,
        tells_reasons: bool = False,
        interpret: InstructionInterpreter | None = None,
        dialect: PromptStyle | None = None,
        plan_edit: Callable[[ReasonerQuestion], LayoutReply] | None = None,
        required: RequiredObjects | None = None,
        object_check: Callable[[ReasonerQuestion], ObjectCheck] | None = None,
    ) -> None:
        if tries < 1:
            raise ConfigError(f"tries is {tries}, expected at least 1", "config_invalid")
        self._tries = tries
        self.engine, self._check, self._interpret = engine, check, interpret
        self._tells_reasons, self._plan_edit = tells_reasons, plan_edit
        self._dialect, self._required = dialect or StagedPromptStyle(), required
        self._object_check = object_check

    def propose(self, questions: Sequence[ReasonerQuestion], seeds: Sequence[int]) -> list[Proposal]:
        """Returns a proposal for each question, in their order; a failure does not affect the other questions.

        Each question has a seed: if the engine is reproducible, the same question and seed give the same proposal.
        """
        found = collect_answers(self.converse(list(zip(questions, seeds, strict=True))), len(questions))
        return [one for one in found if isinstance(one, Proposal)]

    def converse(self, questions: Sequence[tuple[Question, int]]) -> Conversation[Reply, tuple[Question, int]]:
        """Yields proposals and replies to chats, and accepts the questions that follow from them, such as those of a scene's next stage.

        Proposals are collected until they are at least a third of the open questions. The questions that follow from them are
        then numerous enough for a batch, and the engine is busy with the open ones meanwhile. Each question has a seed.
        """
        pending: list[_PendingQuestion | PendingChat] = []
        question_of_request: list[int] = []  # index in pending
        done: list[tuple[int, Reply]] = []
        exchange: Conversation[Completion, Request] | None = None
        num_open = 0

        def next_request(k: int) -> list[Request]:
            """The next request for a question; none if the question is done."""
            one = pending[k]
            if isinstance(one, PendingChat):
                question_of_request.append(k)
                return [one.request()]
            if (finished := self._without_engine(one)) is not None:
                done.append((k, finished))
                return []
            try:
                request = self._request(one)
            except SceneError as error:
                done.append((k, one.proposal(failure=str(error), code=error.code)))
                return []
            question_of_request.append(k)
            return [request]

        def begin(more: Sequence[tuple[Question, int]]) -> list[Request]:
            first = len(pending)
            pending.extend(self._pending(*question) for question in more)
            return [request for k in range(first, len(pending)) for request in next_request(k)]

        requests = begin(questions)
        while True:
            while done and 3 * len(done) >= num_open + len(requests):
                found, done = done, []
                requests += begin((yield found))
            num_open += len(requests)
            if not num_open:
                return
            if exchange is None:
                exchange = conversation(self.engine, requests)
                completions = next(exchange)
            else:
                completions = exchange.send(requests)
            requests = []
            num_open -= len(completions)
            for number, completion in completions:
                k = question_of_request[number]
                one = pending[k]
                reply = one.judge(completion) if isinstance(one, PendingChat) else self._judge(one, completion)
                if reply is None:
                    requests += next_request(k)
                else:
                    done.append((k, reply))

    def _pending(self, question: Question, seed: int) -> _PendingQuestion | PendingChat:
        if isinstance(question, ChatQuestion):
            return PendingChat(question, seed, self._tries, self._tells_reasons)
        if self._interpret is None:
            return _PendingQuestion(question, seed)
        _, notices = self._interpret.table_type(question.table.table_type)
        return _PendingQuestion(question, seed, (*self._interpret(question.instruction, question.edits).notices, *notices))

    def _without_engine(self, pending: _PendingQuestion) -> Proposal | None:
        """The proposal for a question that has no try left or cannot be asked, or for an edit that can be planned; else None."""
        question = pending.question
        if pending.tries:
            # Many objects are seldom all without faults, and cost many tokens.
            is_costly = question.wanted is Stage.TASK and pending.num_objects >= MOST_OBJECTS
            is_last = pending.tries >= self._tries or (is_costly and bool(pending.usable))
            return self._final_proposal(pending) if is_last else None
        try:
            check_instruction(question.instruction)
            if self._required is not None:
                self._required.check_room(question)
            if self._plan_edit is not None and question.edits:
                return pending.proposal(_UsableReply(self._plan_edit(question)))
        except SceneError as error:
            return pending.proposal(failure=str(error), code=error.code)
        return None

    def _request(self, pending: _PendingQuestion) -> Request:
        question = pending.question
        refused = [(r.answer, r.reason) for r in pending.refused] if self._tells_reasons else []
        chat = tuple(self._dialect.messages(question, refused))
        refuses = None if self._object_check is None or question.edits else self._object_check(question)
        return Request(chat, self._dialect.form(question), named_seed(pending.seed, question.wanted, pending.tries), refuses)

    def _final_proposal(self, pending: _PendingQuestion) -> Proposal:
        """The proposal for a question that has no try left."""
        ranked = sorted(pending.usable, key=lambda one: one.rank)
        for one in ranked:
            if self._check is None or one.holds:
                return pending.proposal(one)
            stated = self._stated(one.reply, pending.question)
            if (repaired := repair_relations(one.reply, one.faults, pending.question, self._check, stated)) is not None:
                return pending.proposal(replace(one, reply=repaired[0], faults=repaired[1]))
        return pending.proposal(ranked[0] if ranked else None)

    def _stated(self, reply: LayoutReply, question: ReasonerQuestion) -> tuple[Relation, ...]:
        """The relations that the instruction states of the start, in the names of a reply."""
        if self._interpret is None:
            return ()
        layout = [o.to_scene_object() for o in (*question.layout, *reply.objects)]
        found, _ = compare_with_instruction(layout, question.table, self._interpret(question.instruction))
        return () if found is None else relations_of_task(found)

    def _judge(self, pending: _PendingQuestion, completion: Completion) -> Proposal | None:
        """The proposal that an answer gives; None if the question has to be asked again."""
        pending.tries += 1
        pending.prompt_tokens = total((pending.prompt_tokens, completion.prompt_tokens))
        pending.reply_tokens = total((pending.reply_tokens, completion.reply_tokens))
        pending.cost = total((pending.cost, completion.cost))
        if completion.code.startswith("reply_"):  # the engine answered, but the answer cannot be used
            pending.refuse(completion.text, [ReplyFault(completion.code, completion.failure)])
            return None
        if completion.failure:
            return pending.proposal(failure=completion.failure, code=completion.code)
        try:
            reply = self._dialect.parse(completion.text)
        except SceneError as error:
            pending.refuse(completion.text, [ReplyFault(error.code, str(error))])
            return None
        question = pending.question
        if not question.edits:  # in an edit a name identifies an object of the layout
            reply = replace(reply, objects=renumber_instances(reply.objects, (o.instance for o in question.layout)))
        faults = self._check(reply, question) if self._check else ()
        if not faults:
            return pending.proposal(_UsableReply(reply))
        pending.refuse(completion.text, faults)
        pending.num_objects += len(reply.objects)
        usable = self._usable(reply, faults, question)
        if usable is not None:
            pending.usable.append(usable)
            if self._is_small_change(usable, len(reply.objects), question):
                return pending.proposal(usable)
        return None

    @staticmethod
    def _is_small_change(usable: _UsableReply, num_objects: int, question: ReasonerQuestion) -> bool:
        """Whether few objects of a reply were changed; in the first stage none may be left out."""
        is_whole = question.wanted is not Stage.TASK or all(f.code == PLACED for f in usable.changes)
        return usable.holds and is_whole and 0 < len(usable.changes) <= _SMALL_SHARE * num_objects

    def _usable(self, reply: LayoutReply, faults: Sequence[ReplyFault], question: ReasonerQuestion) -> _UsableReply | None:
        """A reply without the objects that have hard faults, and without those that float then; None if that is not enough.

        Required objects among them are placed anew.
        """
        removed: list[RemovedObject] = []
        check = self._check
        while faulty := {f.instance: f for f in faults if f.is_hard and f.instance}:
            if question.edits or check is None:
                return None
            removed += [(o, faulty[o.instance]) for o in reply.objects if o.instance in faulty]
            reply = replace(reply, objects=tuple(o for o in reply.objects if o.instance not in faulty))
            faults = check(reply, question)
        of_reply = {f.code for f in faults if f.is_hard}
        if not of_reply:
            return _UsableReply(reply, tuple(faults), tuple(_left_out(removed)))
        if question.edits or check is None or self._required is None or not of_reply <= {CROWDED, REQUIRED_MISSING}:
            return None
        for whole, placed, left in self._required.completed(reply, removed, question):
            faults = check(whole, question)
            if not any(f.is_hard for f in faults):
                return _UsableReply(whole, tuple(faults), (*placed, *_left_out(left)))
        return None


def _left_out(removed: Sequence[RemovedObject]) -> Iterator[ReplyFault]:
    return (ReplyFault(_LEFT_OUT, f"{o.instance} is left out: {fault.message}", is_hard=False) for o, fault in removed)
