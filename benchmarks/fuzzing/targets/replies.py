"""Targets: what language models and their endpoints answer: layouts, edits, drafts, tasks, ratings."""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import check_finite, check_notices, check_scene
from benchmarks.fuzzing.watching import FalsePass
from models.baselines.layout.draft import OBJECTS_FORM, RELATIONS_FORM, read_objects, read_relations
from models.baselines.layout.relation_checks import check_relations
from models.scene_rating.pictures import picture_number
from models.scene_rating.prompt import NUMBERS
from models.scene_rating.rating_case import RatingCase
from models.scene_rating.vision_judge import VisionJudge
from models.semantic_reasoner.chat import ChatQuestion, ChatReply
from models.semantic_reasoner.editing import apply_edit, edit_prompt_of
from models.semantic_reasoner.engines.incremental_batches import collect_answers
from models.semantic_reasoner.engines.openai_engine import completion_of
from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.engines.registry import EMBEDDED
from models.semantic_reasoner.factory import embedded_interpreter
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.prompt_styles import StagedPromptStyle
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.checks import CheckSettings, ReplyCheck
from models.semantic_reasoner.replies.required_objects import RequiredObjects
from models.semantic_reasoner.replies.to_scene import objects_of_reply
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import parse_beginning, parse_reply
from stable_data.errors import SceneError
from stable_data.instructions.task_info import model_task
from stable_data.json_text import json_value
from stable_data.rating.criteria import CRITERIA
from stable_data.scene import Scene, SceneObject, Stage, Tabletop, TaskInfo
from stable_data.scene_graph.relations import contacts_of, scene_graph

_TABLE = Tabletop("office_table", (1.2, 0.6))
_WORDS = (
    *(
        "objects",
        "remove",
        "instance",
        "description",
        "size",
        "position",
        "z_rotation",
        "mug_0",
        "laptop_0",
        "category",
        "number",
        "relations",
    ),
    *(
        "subject",
        "relation",
        "target",
        "on",
        "left of",
        "face to",
        "is at",
        "front left",
        "```json",
        "```",
        "<think>",
        "</think>",
        "}",
        "]}",
        "//",
    ),
)


class _Said:
    """An engine that says one text to everything."""

    repeats = True
    name = "said"

    def __init__(self) -> None:
        self.text = ""

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [Completion(self.text)] * len(requests)


def _object(name: str, words: str, size: Sequence[float], position: Sequence[float], angle: float = 0) -> dict[str, Any]:
    return {"instance": name, "description": words, "size": list(size), "position": list(position), "z_rotation": angle}


_LAYOUT = {
    "objects": [
        _object("mug_0", "a white mug", (8, 8, 10), (20, 20, 5), 30),
        _object("plate_0", "a dinner plate", (20, 20, 2), (60, 30, 1)),
        _object("laptop_0", "a grey laptop", (32, 22, 2), (95, 40, 1), 180),
    ]
}
_EDIT = {
    "remove": ["plate_0"],
    "objects": [
        _object("mug_0", "a white mug", (8, 8, 10), (40, 20, 5)),
        _object("lamp_0", "a lamp", (10, 10, 30), (100, 10, 15)),
    ],
}
_DRAFT = {
    "objects": [
        {"category": "mug", "description": "a mug", "size": [8, 8, 10], "number": 2},
        {"category": "plate", "description": "a plate", "size": [20, 20, 2], "number": 1},
    ]
}
_RELATIONS = {
    "relations": [
        {"subject": "mug_0", "relation": "on", "target": "plate_0"},
        {"subject": "plate_0", "relation": "is at", "target": "front left"},
        {"subject": "mug_1", "relation": "left of", "target": "plate_0"},
        {"subject": "mug_1", "relation": "face to", "target": "front"},
    ]
}


def _json_and_text(name: str, document: Any) -> list[Base]:
    text = json.dumps(document)
    around = f"Here it is:\n```json\n{json.dumps(document, indent=1)}\n```\nDone."
    return [Base(name, {"reply.json": text.encode()}), Base(f"{name}_text", {"reply.txt": around.encode()})]


def _text(folder: Path) -> str:
    """The reply, as an engine gives it: text without lone surrogates."""
    place = folder / "reply.json"
    return (place if place.exists() else folder / "reply.txt").read_bytes().decode("utf-8", "replace")


@lru_cache(maxsize=1)
def _engine() -> _Said:
    return _Said()


@lru_cache(maxsize=1)
def _reasoners() -> tuple[SemanticReasoner, SemanticReasoner]:
    """A reasoner with all checks, and one with few tries that tells the reasons."""
    statistics, interpret, settings = CategoryStatistics.load(EMBEDDED), embedded_interpreter(), CheckSettings()
    check, required = ReplyCheck(statistics, interpret, settings), RequiredObjects(statistics, interpret, settings.most_objects)
    own = SemanticReasoner(_engine(), check, 2, False, interpret, StagedPromptStyle(), None, required)
    return own, SemanticReasoner(_engine(), check, 1, True)


def _scene() -> Scene:
    places = {
        "0_plate_0": ("plate", (0.6, 0.3, 0.01), (0.2, 0.2, 0.02)),
        "1_mug_0": ("mug", (0.6, 0.3, 0.07), (0.08, 0.08, 0.1)),
    }
    objects = tuple(
        SceneObject(
            name,
            category,
            position,
            0.0,
            size,
            description=f"a {category}",
            support="0_plate_0" if category == "mug" else "table",
        )
        for name, (category, position, size) in places.items()
    )
    return Scene("office", _TABLE, objects, TaskInfo("An office.", "Put the mug on the plate."))


def _layouts() -> list[Base]:
    return [*_json_and_text("task", _LAYOUT), *_json_and_text("whole", _LAYOUT), *_json_and_text("edit", _EDIT)]


def _read_layout(folder: Path, base: str) -> bool:
    text, wanted = _text(folder), base.partition("_")[0]
    parse_beginning(text)
    parse_reply(text)  # raises what the reasoner turns into a refusal
    _engine().text = text
    if wanted == "edit":
        prompt = edit_prompt_of(_scene())
        question = prompt.question("Move the mug and add a lamp.")
    else:
        question = ReasonerQuestion("Put the mug on the plate.", _TABLE, Stage.TASK if wanted == "task" else "whole")
    found = False
    for reasoner in _reasoners():
        (proposal,) = reasoner.propose([question], [0])
        check_notices(proposal.notices)
        if len(proposal.failure) > 5000:
            raise FalsePass(f"a failure of {len(proposal.failure)} characters")
        if proposal.reply is None:
            continue
        found = True
        if wanted == "edit":
            try:
                check_scene(apply_edit(prompt, proposal.reply).scene)
            except SceneError as error:
                if error.code != "edit_refused":
                    raise
            continue
        objects = objects_of_reply(proposal.reply, question, None)
        check_scene(Scene("layout", _TABLE, objects))
    return found


def _drafts() -> list[Base]:
    return [*_json_and_text("objects", _DRAFT), *_json_and_text("relations", _RELATIONS)]


def _read_draft(folder: Path, base: str) -> bool:
    _engine().text = _text(folder)
    read: Callable[[Any], object] = partial(read_objects, table=_TABLE) if base.startswith("objects") else read_relations
    form = OBJECTS_FORM if base.startswith("objects") else RELATIONS_FORM
    question = ChatQuestion(({"role": "user", "content": "Draft."},), form, read)
    (reply,) = collect_answers(_reasoners()[1].converse([(question, 0)]), 1)
    assert isinstance(reply, ChatReply)
    if reply.content is None:
        return False
    content = cast(Any, reply.content)
    if base.startswith("relations"):
        check_relations(content, read_objects(_DRAFT, _TABLE))
    return True


_RATED = "a"


def _ratings() -> list[Base]:
    document: dict[str, Any] = {NUMBERS[name]: picture_number(_RATED, name) for name in NUMBERS}
    document |= {criterion.key: {"rationale": "It is good.", "score": 8.5} for criterion in CRITERIA}
    return _json_and_text("rating", document)


@lru_cache(maxsize=1)
def _judge() -> tuple[VisionJudge, RatingCase]:
    picture = np.full((32, 48, 3), 200, np.uint8)
    return VisionJudge(_engine(), tries=1), RatingCase(replace(_scene(), scene_id=_RATED), None, picture, picture)


def _read_rating(folder: Path, base: str) -> bool:
    _engine().text = _text(folder)
    judge, case = _judge()
    (rating,) = judge.rate([case])
    if len(rating.reason) > 5000:
        raise FalsePass(f"a reason of {len(rating.reason)} characters")
    check_finite("scores", [score.score for score in rating.scores.values()], [rating.average or 0.0])
    return bool(rating.scores)


def _tasks() -> list[Base]:
    task = {
        "Environment": "An office.",
        "item_placement_zone": [0, 120, 0, 60],
        "Task": "Put the mug on the table.",
        "Goal": ["The mug is on the table."],
        "Action Sequence": ["Pick(mug)", "PlaceOn(table)"],
        "Objects cluster": ["mug", "plate"],
    }
    return [Base("task", {"reply.json": json.dumps(task).encode()})]


def _read_task(folder: Path, base: str) -> bool:
    scene = _scene()
    graph = scene_graph(scene, contacts_of(scene), containers={"1_mug_0": True})
    task, notices = model_task(scene, graph, lambda *_: json_value(_text(folder)), Path(tempfile.gettempdir()) / "tasks")
    check_notices(notices)
    return task.origin == "model"


def _answers() -> list[Base]:
    answer = {
        "choices": [
            {"finish_reason": "stop", "message": {"role": "assistant", "content": json.dumps(_LAYOUT), "refusal": None}}
        ],
        "usage": {"prompt_tokens": 10, "completion_tokens": 20},
    }
    return [Base("answer", {"answer.json": json.dumps(answer).encode()})]


def _read_answer(folder: Path, base: str) -> bool:
    try:
        completion = completion_of(json.loads((folder / "answer.json").read_bytes()), 1.0, 2.0)
    except (ValueError, RecursionError):
        return False  # the engine turns these into a failure of the request
    completion.text.encode()
    check_finite("cost", completion.cost)
    if (completion.cost is None) != (completion.prompt_tokens is None or completion.reply_tokens is None):
        raise FalsePass(
            f"cost is {completion.cost} of {completion.prompt_tokens} and {completion.reply_tokens} tokens with prices"
        )
    return not completion.failure


TARGETS = (
    Target("reply_layout", 20, _layouts, _read_layout, _WORDS),
    Target("reply_draft", 30, _drafts, _read_draft, _WORDS),
    Target(
        "reply_rating", 30, _ratings, _read_rating, ("score", "rationale", "10", "9.25", "true", *(c.key for c in CRITERIA))
    ),
    Target(
        "reply_task", 30, _tasks, _read_task, ("Task", "Goal", "Objects cluster", "mug", "origin", "template", "conditions")
    ),
    Target(
        "answer", 30, _answers, _read_answer, ("choices", "message", "content", "refusal", "length", "content_filter", "usage")
    ),
)
"""The targets of this module."""
