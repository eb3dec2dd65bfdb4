"""The judge by a language model that sees pictures: the paper's GPT-score (stable_paper.tex, appendix, Metrics)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from models.scene_rating.pictures import captioned, picture_number, png
from models.scene_rating.prompt import FORM, NUMBERS, PROMPT_VERSION, rating_messages
from models.scene_rating.rating_case import RatingCase
from models.scene_rating.reply import parse_rating
from models.semantic_reasoner.engines.protocol import Completion, Engine, Request
from models.semantic_reasoner.replies.json_form import JsonForm
from models.semantic_reasoner.text.prompt import Message, refusal_messages
from stable_data.errors import SceneError
from stable_data.random_seeds import named_seed
from stable_data.rating.rating import CriterionScore, Rating

_ASKED_AGAIN = ("reply_cut", "reply_empty")
"""Codes of failures of a reply after which the question is asked again; other failures of an engine are final."""


@dataclass(slots=True, eq=False)
class _Question:
    """A scene that is not rated yet."""

    case: RatingCase
    messages: tuple[Message, ...]
    pictures: tuple[bytes, ...]
    numbers: dict[str, int]
    refused: list[tuple[str, str]] = field(default_factory=list)
    code: str = ""
    reason: str = ""
    tries: int = 0
    prompt_tokens: int = 0
    reply_tokens: int = 0
    cost: float = 0.0

    def request(self, form: JsonForm) -> Request:
        messages = (*self.messages, *refusal_messages(self.refused))
        return Request(messages, form, named_seed("rating", self.case.scene_id, self.tries), pictures=self.pictures)


class VisionJudge:
    """Rates scenes by asking a language model about their two pictures.

    What cannot be scored is unknown, with a code and the reason: a scene without task or pictures, a failure of the engine, a
    refusal, and an answer that is no rating after several tries.

    Args:
        engine: The model, such as :class:`models.semantic_reasoner.engines.openai_engine.OpenAIEngine`, with or without a cache.
        tries: How often a question is asked, at most, until its answer is a rating.
        binds: Whether the endpoint is asked to bind the reply to the form.
    """

    def __init__(self, engine: Engine, tries: int = 3, *, binds: bool = True) -> None:
        self.name, self.version = engine.name, PROMPT_VERSION
        self._engine, self._tries = engine, tries
        self._form = JsonForm(FORM.name, FORM.schema_json, binds)

    def rate(self, cases: Sequence[RatingCase]) -> list[Rating]:
        """Returns one rating for each scene, in their order; the engine gets all questions of a round at once."""
        found: dict[int, Rating] = {}
        open_: dict[int, _Question] = {}
        for k, case in enumerate(cases):
            try:
                open_[k] = _question(case)
            except SceneError as error:
                found[k] = self._unknown(case, error.code, str(error))
        for _ in range(self._tries):
            if not open_:
                break
            completions = self._engine.complete([question.request(self._form) for question in open_.values()])
            for (k, question), completion in zip(list(open_.items()), completions, strict=True):
                rating = self._answered(question, completion)
                if rating is not None:
                    found[k] = rating
                    del open_[k]
        for k, question in open_.items():
            reason = f"{question.tries} answers could not be used, the last because {question.reason}"
            found[k] = self._rating(question, {}, question.code, f"{question.case.scene_id}: {reason}")
        return [found[k] for k in range(len(cases))]

    def _answered(self, question: _Question, completion: Completion) -> Rating | None:
        """The rating of a scene after an answer; None if it is asked again."""
        question.tries += 1
        question.prompt_tokens += completion.prompt_tokens
        question.reply_tokens += completion.reply_tokens
        question.cost += completion.cost
        if completion.failure:
            question.code, question.reason = completion.code, completion.failure
            if completion.code in _ASKED_AGAIN:
                return None
            return self._rating(question, {}, completion.code, f"{question.case.scene_id}: {completion.failure}")
        try:
            return self._rating(question, parse_rating(completion.text, question.numbers))
        except SceneError as error:
            question.code, question.reason = error.code, str(error)
            question.refused.append((completion.text, str(error)))
            return None

    def _rating(self, question: _Question, scores: dict[str, CriterionScore], code: str = "", reason: str = "") -> Rating:
        case, q = question.case, question
        return Rating(
            case.scene_id,
            self.name,
            self.version,
            scores,
            case.clean,
            code,
            reason,
            q.tries,
            q.prompt_tokens,
            q.reply_tokens,
            q.cost,
        )

    def _unknown(self, case: RatingCase, code: str, reason: str) -> Rating:
        return Rating(case.scene_id, self.name, self.version, {}, case.clean, code, reason)


def _question(case: RatingCase) -> _Question:
    """The question about a scene.

    Raises:
        SceneError: The scene has no task (``task_missing``), an invalid instruction (``instruction_invalid``), or lacks a picture
            (``picture_missing``).
    """
    if case.scene.task is None or not case.scene.task.task.strip():
        raise SceneError(f"{case.scene_id}: has no task, expected one to compare with", "task_missing")
    pictures, numbers = [], {}
    for name, picture in zip(NUMBERS, (case.front, case.perspective), strict=True):
        if picture is None:
            raise SceneError(f"{case.scene_id}: has no {name} picture, expected both", "picture_missing")
        numbers[name] = picture_number(case.scene_id, name)
        pictures.append(png(captioned(picture, name, numbers[name])))
    return _Question(case, rating_messages(case.scene), tuple(pictures), numbers)
