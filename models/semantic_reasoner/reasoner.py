"""The Semantic Reasoner: asks an engine, checks what comes back, asks again with the reason, and gives objects."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from models.semantic_reasoner.engines.incremental_batches import Conversation, run_conversation
from models.semantic_reasoner.engines.protocol import Completion, Engine, Request, conversation
from models.semantic_reasoner.language.word_grounding import WordGrounding
from models.semantic_reasoner.prompt_styles import PromptStyle, StagedPromptStyle
from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.replies.relation_repair import repair_relations
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply, renumber_instances
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.random_seeds import named_seed
from stable_data.scene import MAX_INSTRUCTION, Stage

_LEFT_OUT = "left_out"
_FEW = 1 / 8  # of a long list: it is not asked for again for their sake


class FaultFinder(Protocol):
    """Finds faults in a reply to a question."""

    def __call__(self, reply: LayoutReply, ask: ReasonerQuestion, /) -> Sequence[ReplyFault]:
        """The faults; none where the reply may enter the scene."""
        ...


@dataclass(frozen=True, slots=True)
class RefusedReply:
    """An answer that was not taken.

    Attributes:
        answer: Its text.
        faults: Why.
    """

    answer: str
    faults: tuple[ReplyFault, ...]

    @property
    def reason(self) -> str:
        """Its faults in one line."""
        return "; ".join(f.message for f in self.faults)

    @property
    def is_hard(self) -> bool:
        """Whether it must be kept out."""
        return any(f.is_hard for f in self.faults)


@dataclass(frozen=True, slots=True)
class Proposal:
    """What the reasoner proposes for a question.

    Attributes:
        reply: The objects; None where no answer could be used.
        faults: What is still wrong with them, softly.
        refused: Answers that were not taken, in the order in which they came.
        failure: Why there are none, one line; empty where there are.
        code: Short machine-readable reason of the failure.
        notices: What was unknown in the question, and what it was read as.
        tries: How often it was asked; 0 where the question itself could not be.
        prompt_tokens: Read, over all tries.
        reply_tokens: Written, over all tries.
        cost: Of all tries, in the currency of the engine's prices.
    """

    reply: LayoutReply | None
    faults: tuple[ReplyFault, ...] = ()
    refused: tuple[RefusedReply, ...] = ()
    failure: str = ""
    code: str = ""
    notices: tuple[Notice, ...] = ()
    tries: int = 0
    prompt_tokens: int = 0
    reply_tokens: int = 0
    cost: float = 0.0

    @property
    def objects(self) -> tuple[LayoutObject, ...]:
        """New and changed objects; none where there is a failure."""
        return () if self.reply is None else self.reply.objects


@dataclass(slots=True, eq=False)
class _Asking:
    """A question that has no answer yet."""

    ask: ReasonerQuestion
    seed: int
    notices: tuple[Notice, ...] = ()
    refused: list[RefusedReply] = field(default_factory=list)
    best: tuple[LayoutReply, tuple[ReplyFault, ...]] | None = None
    rest: tuple[LayoutReply, tuple[ReplyFault, ...]] | None = None
    misplaced: list[tuple[LayoutReply, tuple[ReplyFault, ...]]] = field(default_factory=list)
    tries: int = 0
    prompt_tokens: int = 0
    reply_tokens: int = 0
    cost: float = 0.0

    def refuse(self, answer: str, faults: Sequence[ReplyFault], reply: LayoutReply | None = None) -> None:
        """Keeps an answer that will not do, and the best of those that would at need."""
        refused = RefusedReply(answer, tuple(faults))
        self.refused.append(refused)
        if reply is not None and not refused.is_hard and (self.best is None or _amiss(faults) < _amiss(self.best[1])):
            self.best = reply, refused.faults
        if reply is not None and all(f.relation is not None for f in faults):
            self.misplaced.append((reply, refused.faults))

    def may_use(self, reply: LayoutReply, faults: tuple[ReplyFault, ...]) -> None:
        """Keeps what is left of a refused answer, if the least so far had to be left out of it."""
        if self.rest is None or _left_out(faults) < _left_out(self.rest[1]):
            self.rest = reply, faults

    def proposal(
        self, reply: LayoutReply | None = None, failure: str = "", code: str = "", faults: tuple[ReplyFault, ...] = ()
    ) -> Proposal:
        """What comes of it."""
        if reply is None and not failure:
            if (taken := self.best or self.rest) is not None:
                reply, faults = taken
            else:
                last = self.refused[-1]
                failure, code = (
                    f"{len(self.refused)} answers could not be used, the last because {last.reason}",
                    "reply_unusable",
                )
        told = (self.tries, self.prompt_tokens, self.reply_tokens, self.cost)
        return Proposal(reply, faults, tuple(self.refused), failure, code, self.notices, *told)


class SemanticReasoner:
    """Asks an engine for the objects of a stage, of a whole layout, or of an edit.

    Args:
        engine: Answers.
        check: Finds faults in a reply; None takes whatever can be read.
        tries: How often a question is asked at most, or that and how often the first stage's is. Where no answer would do,
            things that are not where the instruction says are put there in one that has no other fault; else the one is taken
            of which the least has to be left out to pass the checks, if there is one. Its faults say what was moved or left
            out. After the first stage an answer of which an eighth at most has to be left out is taken without that at once.
        tells_reasons: Whether a refused answer and its reason are shown when it is asked again, as a large model can use; else
            the same question is asked with other draws.
        grounding: Puts an instruction into words that the engine knows; None for an engine that knows them all.
        dialect: How it is spoken to; our own words by default.
    """

    def __init__(
        self,
        engine: Engine,
        check: FaultFinder | None = None,
        tries: int | tuple[int, int] = 4,
        tells_reasons: bool = False,
        grounding: WordGrounding | None = None,
        dialect: PromptStyle | None = None,
    ) -> None:
        self._tries, self._task_tries = (tries, tries) if isinstance(tries, int) else tries
        if min(self._tries, self._task_tries) < 1:
            raise ConfigError(f"tries is {tries}, expected at least 1", "config_invalid")
        self.engine, self._check, self._grounding = engine, check, grounding
        self._tells_reasons = tells_reasons
        self._dialect = dialect or StagedPromptStyle()

    def propose(self, asks: Sequence[ReasonerQuestion], seeds: Sequence[int]) -> list[Proposal]:
        """A proposal for each question, in their order; what fails does not touch the others.

        Args:
            asks: The questions.
            seeds: One each: with an engine that repeats itself, the same question and seed have the same proposal.
        """
        done: dict[int, Proposal] = {}

        def keep(found: list[tuple[int, Proposal]]) -> Sequence[tuple[ReasonerQuestion, int]]:
            done.update(found)
            return ()

        run_conversation(self.converse(list(zip(asks, seeds, strict=True))), keep)
        return [done[k] for k in range(len(asks))]

    def converse(
        self, questions: Sequence[tuple[ReasonerQuestion, int]]
    ) -> Conversation[Proposal, tuple[ReasonerQuestion, int]]:
        """Proposals, and the questions that come of them, such as for a scene's next stage.

        Proposals are given when they are a third of what is open, or more: what comes of them is then worth a batch, and those
        that are still being answered are enough to go on with.

        Args:
            questions: What is asked, each with its seed.
        """
        askings: list[_Asking] = []
        of_request: list[int] = []  # the question of each
        done: list[tuple[int, Proposal]] = []
        talk: Conversation[Completion, Request] | None = None
        num_open = 0

        def ask(k: int) -> list[Request]:
            """The request that is next for a question; none where there is an end to it."""
            asking = askings[k]
            if asking.tries == (self._task_tries if asking.ask.wanted is Stage.TASK else self._tries):
                done.append((k, self._last_word(asking)))
                return []
            try:
                request = self._request(asking, asking.tries)
            except SceneError as error:
                done.append((k, asking.proposal(failure=str(error), code=error.code)))
                return []
            of_request.append(k)
            return [request]

        def begin(more: Sequence[tuple[ReasonerQuestion, int]]) -> list[Request]:
            first = len(askings)
            askings.extend(self._asking(*question) for question in more)
            return [request for k in range(first, len(askings)) for request in ask(k)]

        requests = begin(questions)
        while True:
            while done and 3 * len(done) >= num_open + len(requests):
                found, done = done, []
                requests += begin((yield found))
            num_open += len(requests)
            if not num_open:
                return
            if talk is None:
                talk = conversation(self.engine, requests)
                completions = next(talk)
            else:
                completions = talk.send(requests)
            requests = []
            num_open -= len(completions)
            for number, completion in completions:
                k = of_request[number]
                proposal = self._judge(askings[k], completion)
                if proposal is None:
                    requests += ask(k)
                else:
                    done.append((k, proposal))

    def _asking(self, ask: ReasonerQuestion, seed: int) -> _Asking:
        if self._grounding is None:
            return _Asking(ask, seed)
        grounded = self._grounding.ground(ask.instruction[: MAX_INSTRUCTION + 1])
        table_type, notices = self._grounding.table_type(ask.table.table_type)
        known = replace(ask, instruction=grounded.instruction, table=replace(ask.table, table_type=table_type))
        return _Asking(known, seed, (*grounded.notices, *notices))

    def _request(self, asking: _Asking, attempt: int) -> Request:
        ask = asking.ask
        told = [(r.answer, r.reason) for r in asking.refused] if self._tells_reasons else []
        chat = tuple(self._dialect.messages(ask, told))
        return Request(chat, self._dialect.form(ask), named_seed(asking.seed, ask.wanted, attempt))

    def _last_word(self, asking: _Asking) -> Proposal:
        """What comes of a question that was asked as often as it may be."""
        if self._check is not None:
            for reply, faults in sorted(asking.misplaced, key=lambda one: len(one[1])):
                if (mended := repair_relations(reply, faults, asking.ask, self._check)) is not None:
                    return asking.proposal(mended[0], faults=mended[1])
        return asking.proposal()

    def _judge(self, asking: _Asking, completion: Completion) -> Proposal | None:
        """What comes of an answer; None where it is to be asked again."""
        asking.tries += 1
        asking.prompt_tokens += completion.prompt_tokens
        asking.reply_tokens += completion.reply_tokens
        asking.cost += completion.cost
        if completion.code.startswith("reply_"):  # there was an answer, if none to use
            asking.refuse(completion.text, [ReplyFault(completion.code, completion.failure)])
            return None
        if completion.failure:
            return asking.proposal(failure=completion.failure, code=completion.code)
        try:
            reply = self._dialect.parse(completion.text)
        except SceneError as error:
            asking.refuse(completion.text, [ReplyFault(error.code, str(error))])
            return None
        if not asking.ask.edits:  # there a name says which object is meant
            reply = replace(reply, objects=renumber_instances(reply.objects, (o.instance for o in asking.ask.layout)))
        faults = self._check(reply, asking.ask) if self._check else ()
        if not faults:
            return asking.proposal(reply)
        asking.refuse(completion.text, faults, reply)
        if self._check and not asking.ask.edits:
            rest = _without_the_faulty(reply, faults, asking.ask, self._check)
            if rest is not None:
                asking.may_use(*rest)
                if asking.ask.wanted is not Stage.TASK and _left_out(rest[1]) <= _FEW * len(reply.objects):
                    return asking.proposal()
        return None


def _without_the_faulty(
    reply: LayoutReply, faults: Sequence[ReplyFault], ask: ReasonerQuestion, check: FaultFinder
) -> tuple[LayoutReply, tuple[ReplyFault, ...]] | None:
    """What is left of a reply when the objects go that keep it out, and what then rests on nothing; None where that is no cure."""
    left: list[ReplyFault] = []
    while hard := [f for f in faults if f.is_hard]:
        gone = {f.instance: f.message for f in hard}
        if not gone.keys() <= {o.instance for o in reply.objects}:
            return None  # something is wrong with the whole
        left += [ReplyFault(_LEFT_OUT, f"{name} is left out: {message}", is_hard=False) for name, message in gone.items()]
        reply = replace(reply, objects=tuple(o for o in reply.objects if o.instance not in gone))
        faults = check(reply, ask)
    return (reply, (*left, *faults)) if left else None


def _left_out(faults: Sequence[ReplyFault]) -> int:
    return sum(f.code == _LEFT_OUT for f in faults)


def _amiss(faults: Sequence[ReplyFault]) -> tuple[bool, int]:
    """How much is wrong with a reply; an edit that does something, if oddly, is better than one that does nothing."""
    return any(f.code == "nothing_changed" for f in faults), len(faults)
