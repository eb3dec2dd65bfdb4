import json
from dataclasses import replace

import pytest

from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.prompt_styles import MesaTaskPromptStyle, StagedPromptStyle, prompt_style_of
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.text.prompt import ReasonerQuestion, messages
from models.semantic_reasoner.text.reply_json import LayoutObject, render_objects
from stable_data.errors import ConfigError, SceneError
from stable_data.scene import Relation, RelationKind, Stage, Tabletop, TaskInfo
from stable_data.task_info import task_info_of
from tests.models.semantic_reasoner.language.known_categories import interpreter

VANITY = Tabletop("bathroom_vanity", (1.2, 0.6), (0.2, 0.45, 0.1, 0.3))
TASK = TaskInfo(
    "A bathroom.",
    "Put the soap into the dish.",
    ("The soap is in the dish.",),
    ("Pick(Soap)", "PlaceOn(SoapDish)"),
    ("Soap", "SoapDish"),
    ("3_soap_0", "4_soap_dish_0"),
    (Relation("3_soap_0", RelationKind.LEFT_OF, "4_soap_dish_0"),),
)
ASK = ReasonerQuestion(TASK.task, VANITY, "whole", details=TASK)
PEN = LayoutObject("pen_0", "a blue pen", (1.0, 14.0, 1.0), (20.0, 10.0, 0.5), 0)
TOLD = (
    "The pen belongs in front {really}.\n(pen_0, is at, front left)\n\nTherefore, the scene layout is:\n**Final Answer**\n"
    '{"item_placement_zone":[0,120,0,60],"objects":[{"instance":"pen_0","description":"a blue pen","z_rotation":0.0,'
    '"size":[1.0,14.0,1.0],"position":[20.0,10.0,0.5]}]}<|im_end|>'
)


def test_mesatask_is_told_the_whole_task_info_and_no_answer() -> None:
    (only,) = MesaTaskPromptStyle().messages(ASK)
    assert only["role"] == "user"
    document = json.loads(only["content"][only["content"].index('{\n  "Environment"') :])
    told = task_info_of(document)
    for key in ("environment", "task", "goal", "action_sequence", "objects_cluster"):
        assert getattr(told, key) == getattr(TASK, key)
    assert document["item_placement_zone"] == [0, 120, 0, 60]
    assert document["sink_zone"] == [20, 45, 10, 30]
    assert not {"task_objects", "relations"} & set(document)  # which instances there shall be is what is asked


def test_mesatask_s_own_wording_can_be_given() -> None:
    (only,) = MesaTaskPromptStyle("As you were trained:").messages(ASK)
    assert only["content"].startswith("As you were trained:\n{")


def test_an_instruction_alone_will_do() -> None:
    (only,) = MesaTaskPromptStyle().messages(replace(ASK, details=None))
    assert '"Task": "Put the soap into the dish."' in only["content"]


def test_the_layout_follows_the_reasons() -> None:
    assert MesaTaskPromptStyle().parse(TOLD).objects == (PEN,)
    for text, code in (
        ("no answer", "reply_malformed"),
        (render_objects([PEN]), "reply_malformed"),
        (TOLD[:-30], "reply_not_json"),
    ):
        with pytest.raises(SceneError) as caught:
            MesaTaskPromptStyle().parse(text)
        assert caught.value.code == code


def test_mesatask_knows_whole_layouts_alone() -> None:
    engine = ScriptedEngine(lambda _: TOLD)
    reasoner = SemanticReasoner(engine, dialect=MesaTaskPromptStyle())
    whole, staged = reasoner.propose([ASK, replace(ASK, wanted=Stage.TASK)], [0, 1])
    assert whole.objects == (PEN,)
    assert (staged.reply, staged.code) == (None, "stage_unknown")


def test_a_refused_answer_is_shown_with_its_reason() -> None:
    engine = ScriptedEngine(["nonsense", TOLD])
    (found,) = SemanticReasoner(engine, dialect=MesaTaskPromptStyle(), tells_reasons=True).propose([ASK], [0])
    assert found.objects == (PEN,)
    assert found.refused[0].faults[0].code == "reply_malformed"


def test_only_our_own_words_bind_the_answer() -> None:
    assert StagedPromptStyle().form(ASK).binds
    assert not MesaTaskPromptStyle().form(ASK).binds
    assert StagedPromptStyle().messages(ASK) == messages(ASK)
    edit = replace(ASK, wanted="edit", layout=(PEN,))
    assert StagedPromptStyle().form(edit).names == ("pen_0",)


def test_what_was_read_is_stated_where_a_model_knows_the_form() -> None:
    ask = ReasonerQuestion("The mug that is left of the plate goes onto the tray.", VANITY, Stage.TASK)
    for style, is_stated in (
        (StagedPromptStyle(interpreter()), False),
        (StagedPromptStyle(interpreter(), requires=True), True),
        (prompt_style_of("zero_shot", interpret=interpreter()), True),
    ):
        told = style.messages(ask)[-1]["content"]
        assert ("\nDetails: mug_0; plate_0; serving_tray_0; mug_0 left of plate_0\n" in told) == is_stated
        assert "Details" not in style.messages(replace(ask, wanted=Stage.SECONDARY))[-1]["content"]


def test_dialects_by_name() -> None:
    assert isinstance(prompt_style_of("stages"), StagedPromptStyle)
    assert isinstance(prompt_style_of("mesatask"), MesaTaskPromptStyle)
    with pytest.raises(ConfigError, match="expected stages, zero_shot or mesatask"):
        prompt_style_of("klingon")
