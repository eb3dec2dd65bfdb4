"""Holodeck-Table and I-Design-Table on recorded replies, and layouts of other systems: each ends as a scene or a failure."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from models.baselines.layout.drafting import layout_drafting
from models.baselines.layout.holodeck import holodeck
from models.baselines.layout.idesign import MOST_ROUNDS, idesign
from models.baselines.layout.imported_layout import imported_layout
from models.baselines.layout.prompts import CORRECTION_WANTED, OBJECTS_WANTED, RELATIONS_WANTED
from models.baselines.placement.problem import Placement
from models.dual_system.algorithm1 import LoopSettings
from models.dual_system.batching import run_batched
from models.dual_system.requests import (
    CorrectionRequest,
    ExchangedAssets,
    ExchangeRequest,
    GenerationResult,
    LanguageAnswer,
    LanguageRequest,
    Loop,
    PlacementRequest,
    Request,
    RetrievalRequest,
)
from models.physics_corrector.certify.correction import Correction, CorrectionOptions
from models.physics_corrector.corrector import PhysicsCorrector
from models.semantic_reasoner.engines.incremental_batches import Conversation
from models.semantic_reasoner.engines.protocol import Completion
from models.semantic_reasoner.engines.protocol import Request as EngineRequest
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from models.semantic_reasoner.text.reply_json import LayoutObject, render_objects
from stable_data.assets.assignment import AssignedLayout
from stable_data.assets.retrieval import UnmatchedQuery
from stable_data.errors import Notice
from stable_data.metrics.audit import audit_scene
from stable_data.scene import TABLE, Scene, Tabletop
from tests.models.physics_corrector.geometry.shapes import SHAPES, store, thing

REPLIES = json.loads(Path(__file__).with_name("recorded_replies.json").read_text("utf-8"))
DESK = Tabletop("office_table", (1.0, 0.8))
TASK = LayoutTask("scene", "Lift the cube that is on the plate.", DESK)
NEVER = LoopSettings(corrects="never")


def reply(kind: str, name: str) -> str:
    found = REPLIES[kind][name]
    return found if isinstance(found, str) else json.dumps(found)


@dataclass
class Handler:
    """Answers with a scripted engine, the shapes of the same name, and a corrector that certifies."""

    script: Callable[[EngineRequest], str | Completion]
    tries: int = 2
    asked: list[Request] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.engine = ScriptedEngine(self.script)
        self.reasoner = SemanticReasoner(self.engine, tries=self.tries, tells_reasons=True)

    def propose(self, questions: Sequence[LanguageRequest]) -> Conversation[LanguageAnswer, LanguageRequest]:
        talk = self.reasoner.converse([(q.question, q.seed) for q in questions])
        found = next(talk, None)
        while found is not None:
            more = yield found
            try:
                found = talk.send([(q.question, q.seed) for q in more])
            except StopIteration:
                found = None

    def retrieve(self, questions: Sequence[RetrievalRequest]) -> list[AssignedLayout]:
        self.asked += questions
        return [self.furnished(q.scene) for q in questions]

    def furnished(self, scene: Scene) -> AssignedLayout:
        lost = {o.instance: UnmatchedQuery(f"nothing is like {o.category}") for o in scene.objects if o.category not in SHAPES}
        objects = tuple(
            replace(o, **{key: getattr(thing(o.instance, (*o.position, o.yaw)), key) for key in ("asset_id", "scale", "size")})
            for o in scene.objects
            if o.instance not in lost
        )
        return AssignedLayout(replace(scene, objects=objects), lost)

    def exchange(self, questions: Sequence[ExchangeRequest]) -> list[ExchangedAssets]:
        raise AssertionError("no system exchanges assets")

    def place(self, questions: Sequence[PlacementRequest]) -> list[Placement]:
        self.asked += questions
        return [q.search(q.problem) for q in questions]

    def correct(self, questions: Sequence[CorrectionRequest]) -> list[Correction]:
        self.asked += questions
        options = [CorrectionOptions(q.fixed) for q in questions]
        return PhysicsCorrector().correct([q.scene for q in questions], store(), options)

    @property
    def questions(self) -> list[str]:
        """The last line of each question."""
        return [r.messages[-1]["content"].rpartition("\n")[2] for r in self.engine.requests]


def chats(objects: str = "plain", relations: str = "plain", corrected: str | None = None) -> Handler:
    """A language model that answers each kind of question with one recorded reply."""

    def script(request: EngineRequest) -> str:
        question = request.messages[1]["content"]
        if question.endswith(OBJECTS_WANTED):
            return reply("objects", objects)
        return reply("relations", corrected or relations if question.endswith(CORRECTION_WANTED) else relations)

    return Handler(script)


def made(handler: Handler, loop: Loop) -> GenerationResult:
    (found,) = run_batched([loop], handler)
    return found


def codes(found: GenerationResult) -> list[str]:
    return [n.code for n in found.warnings]


@pytest.mark.parametrize("system", [holodeck, idesign])
def test_recorded_replies_become_a_scene(system: Any) -> None:
    handler = chats()
    found = made(handler, system(TASK, 3, NEVER))
    assert found.failure is None
    assert found.scene is not None
    assert [o.instance for o in found.scene.objects] == ["plate_0", "cube_0", "cube_1", "bowl_0", "ball_0", "cup_0"]
    support = {o.instance: o.support for o in found.scene.objects}
    assert (support["cube_0"], support["ball_0"], support["cup_0"]) == ("plate_0", "bowl_0", TABLE)
    assert found.scene["cube_1"].position[0] < found.scene["plate_0"].position[0] < found.scene["bowl_0"].position[0]
    assert found.start == found.scene
    (turn,) = found.turns
    assert (turn.wanted, turn.proposal.tries, turn.rejected) == ("whole", 2, "")
    assert turn.proposal.reply is not None
    assert [o.instance for o in turn.proposal.reply.objects] == [o.instance for o in found.scene.objects]
    assert handler.questions == [OBJECTS_WANTED, RELATIONS_WANTED]
    assert codes(found) == []
    task = found.scene.task
    assert task is not None
    assert task.task == TASK.instruction
    # Retrieval knows that something is in the bowl, and that the cube on the plate may lean.
    first = next(q for q in handler.asked if isinstance(q, RetrievalRequest)).scene
    assert first["ball_0"].bottom < first["bowl_0"].top
    assert first["cube_0"].bottom == pytest.approx(first["plate_0"].top)


def test_holodeck_keeps_true_boxes_apart_and_idesign_those_that_were_proposed() -> None:
    """The replies call the cube smaller than it is: only a search after retrieval knows better."""
    objects = {"objects": [{"category": "cube", "description": "a cube", "size": [2, 2, 2], "number": 40}]}

    def script(request: EngineRequest) -> str:
        is_list = request.messages[1]["content"].endswith(OBJECTS_WANTED)
        return json.dumps(objects) if is_list else '{"relations":[]}'

    first, second = (made(Handler(script), system(TASK, 1, NEVER)).scene for system in (holodeck, idesign))
    assert first is not None
    assert second is not None
    assert audit_scene(first, store().shapes(first)[0]).card().num_collisions == 0
    assert audit_scene(second, store().shapes(second)[0]).card().num_collisions > 0


def test_idesign_asks_the_corrector_until_the_graph_has_no_conflict() -> None:
    handler = chats(relations="circle", corrected="plain")
    found = made(handler, idesign(TASK, 3, NEVER))
    assert handler.questions == [OBJECTS_WANTED, RELATIONS_WANTED, CORRECTION_WANTED]
    shown = handler.engine.requests[2].messages[1]["content"]
    assert "- cube_1 on cube_0: cube_0 is on or in cube_1 itself" in shown
    assert "- cup_0 left of plate_0: other relations together say the opposite" in shown
    assert "- no relation says where ball_0 is" in shown
    assert codes(found) == []
    assert found.turns[0].proposal.tries == 3


def test_idesign_asks_the_corrector_so_often_and_leaves_out_what_remains() -> None:
    handler = chats(relations="circle")
    found = made(handler, idesign(TASK, 3, NEVER))
    assert handler.questions.count(CORRECTION_WANTED) == MOST_ROUNDS
    assert found.scene is not None
    assert codes(found) == ["relation_circle", "relation_circle", "unrelated"]


def test_a_correction_that_loses_relations_is_not_used() -> None:
    handler = chats(relations="circle", corrected="none")
    found = made(handler, idesign(TASK, 3, NEVER))
    assert found.scene is not None
    assert codes(found) == ["relation_circle", "relation_circle", "unrelated"]


def test_a_corrector_that_talks_prose_costs_the_conflicting_relations_alone() -> None:
    handler = chats(relations="unknown_object", corrected="prose")
    found = made(handler, idesign(TASK, 3, NEVER))
    assert found.scene is not None
    assert found.scene["cube_0"].support == "plate_0"
    assert codes(found) == ["object_unknown", "unrelated"]
    assert [r.faults[0].code for r in found.turns[0].proposal.refused] == ["reply_not_json"] * 2


@pytest.mark.parametrize("system", [holodeck, idesign])
@pytest.mark.parametrize(
    ("objects", "relations", "code", "says"),
    [
        ("prose", "plain", "reply_unusable", "not JSON"),
        ("empty", "plain", "reply_unusable", "no object"),
        ("too_many", "plain", "reply_unusable", "200 objects"),
        ("metres", "plain", "reply_unusable", "centimetres"),
        ("plain", "prose", "reply_unusable", "not JSON"),
        ("nothing_retrievable", "none", "layout_empty", "no object has"),
    ],
)
def test_replies_that_cannot_be_used_are_a_failure_with_a_reason(
    system: Any, objects: str, relations: str, code: str, says: str
) -> None:
    handler = chats(objects, relations)
    found = made(handler, system(TASK, 3, replace(NEVER, tries=2)))
    assert found.scene is None
    assert found.failure is not None
    assert found.failure.code == code
    assert says in found.failure.message
    assert len(found.turns) == 2  # tried again with another seed
    assert len({r.seed for r in handler.engine.requests}) == len(handler.engine.requests)


def test_fenced_replies_with_commas_too_many_are_read() -> None:
    found = made(chats("fenced", "unknown_object"), holodeck(TASK, 3, NEVER))
    assert found.scene is not None
    assert [o.instance for o in found.scene.objects] == ["plate_0", "cube_0", "cube_1"]
    assert codes(found) == ["object_unknown"]


def test_what_is_too_large_for_the_table_has_no_place() -> None:
    found = made(chats("too_large", "none"), idesign(TASK, 3, replace(NEVER, tries=1)))
    assert found.failure is not None
    assert found.failure.code == "layout_empty"
    assert "there is no free place on the table" in found.failure.message
    # Holodeck gives it its asset first, which is a small cube.
    again = made(chats("too_large", "none"), holodeck(TASK, 3, NEVER))
    assert again.scene is not None


def test_an_engine_that_is_down_is_asked_once_and_its_code_kept() -> None:
    down = Handler(lambda _: Completion("", failure="nobody there", code="endpoint_down"))
    found = made(down, holodeck(TASK, 3, NEVER))
    assert found.failure is not None
    assert found.failure.code == found.turns[0].proposal.code == "endpoint_down"
    assert len(down.engine.requests) == 1
    off_later = Handler(
        lambda r: (
            reply("objects", "plain")
            if r.messages[1]["content"].endswith(OBJECTS_WANTED)
            else Completion("", failure="spent", code="quota_spent")
        )
    )
    assert made(off_later, idesign(TASK, 3, NEVER)).turns[-1].proposal.code == "quota_spent"


def test_an_instruction_that_no_prompt_holds_is_a_failure() -> None:
    handler = chats()
    found = made(handler, holodeck(replace(TASK, instruction=" "), 3, NEVER))
    assert found.failure is not None
    assert found.failure.code == "instruction_invalid"
    assert handler.questions == []


def test_a_layout_is_corrected_if_the_settings_say_so() -> None:
    handler = chats()
    found = made(handler, holodeck(TASK, 3, LoopSettings(corrects="end")))
    (asked,) = (q for q in handler.asked if isinstance(q, CorrectionRequest))
    assert asked.is_last
    assert {str(r) for r in asked.scene.relations} == {"cube_0 on plate_0", "ball_0 in bowl_0"}
    assert found.correction is not None
    assert found.scene is found.correction.certified


def test_a_model_that_knows_its_own_prompts_alone_drafts_by_a_layout() -> None:
    whole = [
        LayoutObject("plate_0", "a plate", (20.0, 16.0, 1.0), (50.0, 40.0, 0.5), 0),
        LayoutObject("cube_0", "a cube", (10.0, 10.0, 10.0), (50.0, 40.0, 6.0), 0),
        LayoutObject("cup_0", "a cup", (8.0, 8.0, 10.0), (80.0, 40.0, 5.0), 90),
    ]
    handler = Handler(lambda request: render_objects(whole) if WANTED["whole"] in request.messages[-1]["content"] else "?")
    found = made(handler, holodeck(TASK, 3, NEVER, None, layout_drafting()))
    assert found.scene is not None
    assert found.scene["cube_0"].support == "plate_0"
    cup = found.scene["cup_0"]
    assert cup.position[0] > found.scene["plate_0"].position[0]
    assert cup.yaw == pytest.approx(1.5708, abs=1e-3)
    assert found.turns[0].proposal.tries == 1
    silent = made(Handler(lambda _: "what?"), holodeck(TASK, 3, NEVER, None, layout_drafting()))
    assert silent.failure is not None
    assert silent.failure.code == "reply_unusable"


def test_scenes_of_one_run_share_the_requests_and_do_not_depend_on_each_other() -> None:
    tasks = [replace(TASK, scene_id=f"scene_{k}") for k in range(4)]
    together = run_batched([holodeck(t, k, NEVER) for k, t in enumerate(tasks)], chats())
    alone = [made(chats(), holodeck(t, k, NEVER)) for k, t in enumerate(tasks)]
    assert [r.scene for r in together] == [r.scene for r in alone]
    assert len({str(r.scene.poses()) for r in together if r.scene is not None}) == 4


# --- layouts of other systems --------------------------------------------------------------------------------------------------


def foreign(width: float = 1.0) -> Scene:
    objects = thing("cube_0", (0.3, 0.3, 0.05, 0.0)), thing("cube_1", (0.38, 0.3, 0.05, 0.2))
    return Scene("theirs", Tabletop("table", (width, 0.8)), objects)


def test_a_layout_of_another_system_gets_the_task_and_the_name_of_ours() -> None:
    found = made(chats(), imported_layout(TASK, foreign(), NEVER))
    assert found.scene is not None
    assert (found.scene.scene_id, found.scene.table.table_type) == ("scene", "office_table")
    assert found.scene.poses().tolist() == foreign().poses().tolist()
    assert found.scene.task is not None
    assert found.scene.task.task == TASK.instruction
    assert (found.turns, codes(found), found.correction) == ((), [], None)


def test_a_layout_on_another_table_keeps_it_and_the_difference_is_told() -> None:
    found = made(chats(), imported_layout(TASK, foreign(1.4), NEVER))
    assert found.scene is not None
    assert found.scene.table.size_xy == (1.4, 0.8)
    assert codes(found) == ["table_differs"]
    assert "140.0 x 80.0 cm, that of the task 100.0 x 80.0 cm" in found.warnings[0].message


def test_a_layout_is_judged_in_the_place_of_the_task() -> None:
    sink, wall = Tabletop("vanity", (1.0, 0.8), (0.2, 0.5, 0.2, 0.5)), thing("cube_2", (0.9, 0.7, 0.05, 0.0))
    task = replace(TASK, table=sink, surroundings=(wall,))
    found = made(chats(), imported_layout(task, foreign(), NEVER, remarks=[Notice("scene", "read", "odd", "scene: odd")]))
    assert found.scene is not None
    assert (found.scene.table, found.scene.surroundings) == (sink, (wall,))
    assert [o.instance for o in found.scene.movable] == ["cube_0", "cube_1"]
    assert [(w.code, w.message) for w in found.warnings] == [("odd", "scene: odd")]


def test_a_post_processor_knows_what_stands_on_what() -> None:
    stacked = replace(foreign(), objects=(thing("cube_0", (0.3, 0.3, 0.05, 0.0)), thing("cube_1", (0.3, 0.3, 0.15, 0.0))))
    loop = imported_layout(TASK, stacked, LoopSettings(corrects="end"))
    asked = next(loop)
    assert isinstance(asked, CorrectionRequest)
    assert {(r.subject, str(r.kind), r.target) for r in asked.scene.relations} == {("cube_1", "on", "cube_0")}


def test_a_layout_of_another_system_can_be_corrected() -> None:
    found = made(chats(), imported_layout(TASK, foreign(), LoopSettings(corrects="end")))
    assert found.scene is not None
    assert audit_scene(found.scene, store().shapes(found.scene)[0]).card().clean
    assert found.start.poses().tolist() == foreign().poses().tolist()


@pytest.mark.parametrize(
    ("there", "code"),
    [
        (Notice("scene", "layout", "layout_missing", "scene: PLACE has no scene of this id"), "layout_missing"),
        (replace(foreign(), objects=()), "layout_empty"),
    ],
)
def test_a_layout_that_is_missing_or_empty_is_a_failure(there: Scene | Notice, code: str) -> None:
    found = made(chats(), imported_layout(TASK, there, NEVER))
    assert found.failure is not None
    assert found.failure.code == code
    assert found.failure.message.startswith("scene: ")
    assert found.failure.message.count("scene: ") == 1
