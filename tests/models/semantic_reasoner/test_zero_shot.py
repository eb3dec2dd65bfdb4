"""Models that were not trained on the prompts: what they are told, and whatever they may answer."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from models.semantic_reasoner.editing import apply_edit
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.openai_engine import OpenAIEngine
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.factory import ReasonerSettings, load_reasoner, proposal_config
from models.semantic_reasoner.prompt_styles import PromptStyle, StagedPromptStyle, prompt_style_of
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.checks import ReplyCheck, form_check
from models.semantic_reasoner.replies.grammar import MOST_OBJECTS
from models.semantic_reasoner.staged_layout import ONE_SHOT, LayoutTask, StagedLayout, staged_layouts
from models.semantic_reasoner.text.prompt import SYSTEM, WANTED, messages
from models.semantic_reasoner.text.reply_json import layout_objects, parse_reply, render_objects
from models.semantic_reasoner.text.zero_shot_prompt import EXAMPLE, EXAMPLE_OBJECTS, ZERO_SHOT_SYSTEM
from stable_data.errors import ConfigError
from stable_data.limits import LIMITS
from stable_data.scene import TABLE, Stage
from tests.models.semantic_reasoner.endpoint_replies import EndpointReply, good_replies, task_replies
from tests.models.semantic_reasoner.engines.endpoint import Act, Endpoint, endpoint
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, interpreter, thing
from tests.models.semantic_reasoner.language.known_categories import TABLE as DESK

INSTRUCTION = "Move the mug next to the plate."
ZERO_SHOT = prompt_style_of("zero_shot")
CHECK = ReplyCheck(STATISTICS)  # that objects of the instruction are missing is judged elsewhere


def reasoner_of(engine: Any, tries: int = 4, dialect: PromptStyle = ZERO_SHOT) -> SemanticReasoner:
    return SemanticReasoner(engine, CHECK, tries, tells_reasons=True, dialect=dialect)


# --- the prompt ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", list(WANTED))
def test_the_question_and_the_form_are_those_of_trained_models_and_only_the_explanation_differs(wanted: Any) -> None:
    question = ask(INSTRUCTION, wanted, [thing("mug_0", 30, 25)])
    told, trained = ZERO_SHOT.messages(question), messages(question)
    assert told == [{"role": "system", "content": ZERO_SHOT_SYSTEM}, trained[1]]
    assert trained[0]["content"] == SYSTEM
    assert ZERO_SHOT.form(question) == StagedPromptStyle().form(question)


def test_every_kind_of_question_and_every_limit_is_explained() -> None:
    for wanted in ("task objects:", "important background:", "rest of the background:", "whole scene:", "change:"):
        assert f"\n- {wanted}" in ZERO_SHOT_SYSTEM
        assert any(wanted[:-1].split()[-1] in words for words in WANTED.values())
    assert f"at most {MOST_OBJECTS} objects" in ZERO_SHOT_SYSTEM
    assert len(ZERO_SHOT_SYSTEM) < 6000  # it is paid for in every request


def test_the_worked_example_is_a_reply_without_faults() -> None:
    assert ZERO_SHOT_SYSTEM.endswith(render_objects(EXAMPLE_OBJECTS))
    reply = parse_reply(ZERO_SHOT_SYSTEM.rpartition("Answer:")[2])
    assert reply.objects == EXAMPLE_OBJECTS
    assert ReplyCheck(STATISTICS, interpreter())(reply, EXAMPLE) == []


def test_endpoints_are_told_by_default_and_trained_ones_can_be_spared(tmp_path: Path) -> None:
    http = HttpSettings("http://127.0.0.1:1/v1", "default")
    at_endpoint, embedded = EngineSettings("openai:large", http=http), EngineSettings("embedded")
    script = tmp_path / "script.json"
    script.write_text("[]")
    for settings, engine, expected in (
        (ReasonerSettings(), at_endpoint, "zero_shot"),
        (ReasonerSettings(dialect="stages"), at_endpoint, "stages"),
        (ReasonerSettings(), embedded, "stages"),
        (ReasonerSettings(dialect="mesatask"), embedded, "stages"),
        (ReasonerSettings(), EngineSettings(f"scripted:{script}"), "stages"),
        (ReasonerSettings(dialect="zero_shot"), EngineSettings(f"scripted:{script}"), "zero_shot"),
    ):
        assert settings.dialect_with(engine) == expected
    one, other = (proposal_config(at_endpoint, ReasonerSettings(dialect=d)) for d in ("zero_shot", "stages"))
    assert one == proposal_config(at_endpoint)
    assert one.keys() - other.keys() == {"dialect", "wording"}
    with pytest.raises(ConfigError, match="dialect"):
        ReasonerSettings(dialect="klingon")  # type: ignore[arg-type]


def test_a_loaded_reasoner_tells_what_its_settings_say(tmp_path: Path) -> None:
    script = tmp_path / "script.json"
    script.write_text(json.dumps(good_replies("stages")))
    for dialect, system in (("zero_shot", ZERO_SHOT_SYSTEM), ("auto", SYSTEM)):
        engine = ScriptedEngine.from_file(script)
        reasoner, _ = load_reasoner(EngineSettings(f"scripted:{script}"), ReasonerSettings(dialect=dialect), engine)  # type: ignore[arg-type]
        (found,) = reasoner.propose([ask()], [0])
        assert found.tries == 1
        assert engine.requests[0].messages[0]["content"] == system


# --- whatever an endpoint answers ---------------------------------------------------------------------------------------------


class Answers:
    """An endpoint that gives one answer first, and a good one whenever a refused answer is shown."""

    def __init__(self) -> None:
        self.first: dict[str, Any] = {}
        self.good = next(r for r in task_replies() if r.name == "plain").completion()

    def __call__(self, words: str, number: int, body: dict[str, Any]) -> Act:
        return Act(body=self.first if len(body["messages"]) == 2 else self.good)


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[Answers, Endpoint, OpenAIEngine]]:
    answers = Answers()
    with endpoint(answers) as server:
        yield answers, server, OpenAIEngine(server.settings())


@pytest.mark.parametrize("recorded", task_replies(), ids=lambda r: r.name)
def test_any_reply_is_read_or_refused_with_a_reason_and_asked_for_again(
    recorded: EndpointReply, served: tuple[Answers, Endpoint, OpenAIEngine]
) -> None:
    answers, server, engine = served
    answers.first = recorded.completion()
    server.bodies.clear()
    (found,) = reasoner_of(engine, tries=2).propose([ask(INSTRUCTION)], [0])
    assert found.failure == ""
    if recorded.instances is not None:
        assert tuple(o.instance for o in found.objects) == recorded.instances
        assert (found.tries, found.refused) == (1, ())
        assert all(o.description.isprintable() and "<|" not in o.description for o in found.objects)
        return
    assert [o.instance for o in found.objects] == ["plate_0", "mug_0"]
    (refused,) = found.refused
    assert refused.faults[0].code == recorded.code
    assert recorded.says in refused.reason
    assert "\n" not in refused.reason
    assert len(refused.reason) < 20_000
    shown, reason = server.bodies[1]["messages"][2:]
    assert shown["content"].strip()
    assert len(shown["content"]) <= 20_000  # not the megabytes that were sent
    assert recorded.says in reason["content"]


@pytest.mark.parametrize("recorded", [r for r in task_replies() if r.instances is None], ids=lambda r: r.name)
def test_a_reply_that_stays_so_fails_its_scene_alone(recorded: EndpointReply) -> None:
    """Without the checks of sizes and places, so that nothing but the form of the reply is in its way."""
    with endpoint(lambda words, *_: Act(body=recorded.completion()) if "mug" in words else None) as server:
        reasoner = SemanticReasoner(OpenAIEngine(server.settings()), form_check, 1, dialect=ZERO_SHOT)
        (found, other) = reasoner.propose([ask(INSTRUCTION), ask("Lift the orange.")], [0, 1])
    assert other.code == "reply_unusable"  # an echo of the question
    if found.reply is None:
        assert found.code == "reply_unusable"
        assert recorded.says in found.failure
    else:  # a layout that only the checks can refuse
        assert recorded.code in ("floats", "below_table", "empty", "too_many")


def test_the_fixture_has_every_kind() -> None:
    recorded = task_replies()
    assert Counter(r.name for r in recorded).most_common(1)[0][1] == 1
    assert sum(r.instances is not None for r in recorded) >= 8
    assert {r.code for r in recorded} >= {
        "reply_not_json",
        "reply_malformed",
        "reply_too_long",
        "reply_cut",
        "reply_empty",
        "unit",
    }
    assert max(len(r.content or "") for r in recorded) > 5_000_000 > LIMITS.text.max_reply_bytes


# --- good replies -------------------------------------------------------------------------------------------------------------


def layout_of(replies: list[str], **more: Any) -> tuple[StagedLayout, ScriptedEngine]:
    engine = ScriptedEngine(replies)
    (layout,) = staged_layouts(reasoner_of(engine), [LayoutTask("desk", INSTRUCTION, DESK)], [0], **more)
    return layout, engine


def test_a_whole_scene_is_laid_out_stage_by_stage() -> None:
    layout, engine = layout_of(good_replies("stages"))
    assert layout.is_whole
    assert all(not p.refused and not p.faults for _, p in layout.proposals)
    assert Counter(o.stage for o in layout.objects) == dict.fromkeys(Stage, 3)
    supports = {o.instance: o.support for o in layout.objects if o.support != TABLE}
    assert supports == {"mug_0": "serving_tray_0", "cookie_0": "plate_0", "orange_0": "serving_tray_0"}
    assert [r.messages[0]["content"] for r in engine.requests] == [ZERO_SHOT_SYSTEM] * 3
    for request, wanted, known in zip(engine.requests, Stage, (0, 3, 6), strict=True):
        assert request.messages[1]["content"].endswith(WANTED[wanted])
        assert request.messages[1]["content"].count('"instance"') == known


def test_a_stage_that_was_answered_badly_is_asked_again_and_the_others_are_not() -> None:
    task, important, secondary = good_replies("stages")
    floating = important.replace("2.6]", "22.6]")
    layout, engine = layout_of([task, important[:150], floating, important, secondary])
    assert layout.is_whole
    assert [p.tries for _, p in layout.proposals] == [1, 3, 1]
    chat = engine.requests[3].messages
    assert [m["role"] for m in chat] == ["system", "user", "assistant", "user", "assistant", "user"]
    assert "cut off" in chat[3]["content"]
    assert "cookie_0 is 20.0 cm above everything" in chat[5]["content"]


def test_a_whole_scene_is_laid_out_in_one_shot() -> None:
    layout, engine = layout_of(good_replies("whole"), stages=ONE_SHOT)
    assert layout.is_whole
    assert len(layout.objects) == 7
    assert engine.requests[0].messages[1]["content"].endswith(WANTED["whole"])


def test_a_scene_is_edited() -> None:
    scene = layout_of(good_replies("stages"))[0].scene
    question = ask("Put the mug in front of the tray and take the cookie away.", "edit", layout_objects(scene.objects))
    engine = ScriptedEngine(['{"remove": ["biscuit_0"], "objects": []}', *good_replies("edit")])
    (found,) = reasoner_of(engine).propose([question], [0])
    assert [f.code for r in found.refused for f in r.faults] == ["removed_unknown"]
    assert found.reply is not None
    done = apply_edit(scene, found.reply)
    assert (done.removed, done.changed, done.added) == (("cookie_0",), ("mug_0",), ())
    assert done.scene["mug_0"].support == TABLE
    twice = replace(found.reply, objects=found.reply.objects * 2)
    assert {f.code for f in CHECK(twice, question)} == {"instance_twice"}
