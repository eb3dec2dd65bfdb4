"""The judge by a language model that sees pictures: the paper's GPT-score (stable_paper.tex, appendix, Metrics)."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import cast

from models.scene_rating.pictures import captioned, picture_number, png
from models.scene_rating.prompt import FORM, NUMBERS, PROMPT_VERSION, rating_messages
from models.scene_rating.rating_case import RatingCase
from models.scene_rating.reply import read_rating
from models.semantic_reasoner.chat import ChatQuestion, ChatReply
from models.semantic_reasoner.engines.incremental_batches import collect_answers
from models.semantic_reasoner.engines.protocol import Engine
from models.semantic_reasoner.reasoner import SemanticReasoner
from stable_data.errors import SceneError
from stable_data.random_seeds import named_seed
from stable_data.rating.rating import CriterionScore, Rating


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
        self._reasoner = SemanticReasoner(engine, tries=tries, tells_reasons=True)
        self._form = replace(FORM, binds=binds)

    def rate(self, cases: Sequence[RatingCase]) -> list[Rating]:
        """Returns one rating for each scene, in their order; the engine gets all questions of a round at once."""
        found: dict[int, Rating] = {}
        asked: dict[int, ChatQuestion] = {}
        for k, case in enumerate(cases):
            try:
                asked[k] = self._question(case)
            except SceneError as error:
                found[k] = self._rating(case, ChatReply(code=error.code, failure=str(error)))
        seeded = [(question, named_seed("rating", cases[k].scene_id)) for k, question in asked.items()]
        replies = collect_answers(self._reasoner.converse(seeded), len(seeded))
        for k, reply in zip(asked, replies, strict=True):
            found[k] = self._rating(cases[k], cast(ChatReply, reply))
        return [found[k] for k in range(len(cases))]

    def _question(self, case: RatingCase) -> ChatQuestion:
        """The question about a scene.

        Raises:
            SceneError: The scene has no task (``task_missing``), an invalid instruction (``instruction_invalid``), or lacks a
                picture (``picture_missing``).
        """
        if case.scene.task is None or not case.scene.task.task.strip():
            raise SceneError("has no task, expected one to compare with", "task_missing")
        pictures, numbers = [], {}
        for name, picture in zip(NUMBERS, (case.front, case.perspective), strict=True):
            if picture is None:
                raise SceneError(f"has no {name} picture, expected both", "picture_missing")
            numbers[name] = picture_number(case.scene_id, name)
            pictures.append(png(captioned(picture, name, numbers[name])))
        read = partial(read_rating, numbers=numbers)
        return ChatQuestion(rating_messages(case.scene), self._form, read, tuple(pictures))

    def _rating(self, case: RatingCase, reply: ChatReply) -> Rating:
        scores = cast(dict[str, CriterionScore], reply.content or {})
        code, reason = reply.code, f"{case.scene_id}: {reply.failure}" if reply.failure else ""
        if code == "reply_unusable":  # the last fault says more
            code = reply.refused[-1].faults[0].code
        counts = (reply.tries, reply.prompt_tokens, reply.reply_tokens, reply.cost)
        return Rating(case.scene_id, self.name, self.version, scores, case.clean, code, reason, *counts)
