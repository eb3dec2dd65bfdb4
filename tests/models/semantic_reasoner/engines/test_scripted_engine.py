"""The scripted engine: what it was told to say, and nothing else."""

from pathlib import Path

import pytest

from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.text.reply_json import parse_reply
from stable_data.errors import ConfigError, SceneError
from tests.models.semantic_reasoner.engines.endpoint import ask


def test_replies_by_words_are_the_same_every_time() -> None:
    down = Completion("", failure="down", code="endpoint_down")
    engine = ScriptedEngine({"set the table": "plates", "write": down})
    asked = [ask("please write"), ask("please set the table"), ask("sing")]
    first = engine.complete(asked)
    assert first[:2] == [down, Completion("plates")]
    assert first[2].code == "script_silent"
    assert "sing" in first[2].failure
    assert engine.complete(asked) == first
    assert engine.repeats
    assert list(engine.requests) == asked * 2


def test_replies_in_order_go_on_over_calls_and_end() -> None:
    engine = ScriptedEngine(["a", Completion("", failure="cut", code="reply_cut"), "b"])
    assert [c.text for c in engine.complete([ask("x"), ask("x")])] == ["a", ""]
    found = engine.complete([ask("x"), ask("x")])
    assert [(c.text, c.code) for c in found] == [("b", ""), ("", "script_silent")]
    assert not engine.repeats


def test_of_many_requests_the_last_are_kept_and_replies_stay_in_order() -> None:
    engine = ScriptedEngine([str(k) for k in range(1200)])
    asked = [ask(f"x {k}") for k in range(1200)]
    assert [c.text for c in engine.complete(asked)] == [str(k) for k in range(1200)]
    assert list(engine.requests) == asked[-1000:]


def test_a_function_answers_and_its_errors_are_failures_by_their_code() -> None:
    def script(request: Request) -> str:
        if request.seed == 1:
            raise SceneError("no room", "no_room")
        return f"{request.messages[-1]['content']} {request.seed}"

    found = ScriptedEngine(script).complete([ask("x", seed) for seed in range(3)])
    assert found == [Completion("x 0"), Completion("", failure="no room", code="no_room"), Completion("x 2")]


def test_scripts_are_read_from_files(tmp_path: Path) -> None:
    path = tmp_path / "script.json"
    path.write_text('{"tea": {"objects": []}, "raw": "no JSON"}', "utf-8")
    tea, raw = ScriptedEngine.from_file(path).complete([ask("make tea"), ask("raw")])
    assert parse_reply(tea.text).objects == ()
    assert raw.text == "no JSON"
    path.write_text('["a", {"objects": []}]', "utf-8")
    assert [c.text for c in ScriptedEngine.from_file(path).complete([ask("x")] * 2)] == ["a", '{"objects":[]}']


@pytest.mark.parametrize("content", [None, "{", "7"])
def test_files_that_are_no_scripts_are_refused(content: str | None, tmp_path: Path) -> None:
    path = tmp_path / "script.json"
    if content is not None:
        path.write_text(content, "utf-8")
    with pytest.raises(ConfigError, match=r"script\.json") as caught:
        ScriptedEngine.from_file(path)
    assert caught.value.code == "script_invalid"
