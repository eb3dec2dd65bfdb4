"""The chat server: an engine behind it answers as the engine itself does, and whatever else is asked gets a clear error."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import typer
import urllib3
from typer.testing import CliRunner

from models.semantic_reasoner.engines.chat_server import main, serve
from models.semantic_reasoner.engines.http_engine import HttpEngine
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from stable_data.errors import ConfigError
from tests.models.semantic_reasoner.engines.endpoint import ask


def script(request: Request) -> Completion:
    words = request.messages[-1]["content"]
    failures = {1: ("was cut", "reply_cut"), 2: ("is down", "endpoint_down"), 3: ("json_schema: unsupported seed", "odd")}
    failure, code = failures.get(request.seed % 8, ("", ""))
    text = "" if failure else f'{{"objects":[]}} {words} {request.form.width_cm} é\n'
    return Completion(text, len(words), len(text), failure, code)


def test_an_engine_behind_the_server_answers_as_the_engine_itself() -> None:
    requests = [
        Request(
            ({"role": "system", "content": "s"}, {"role": "user", "content": f"request {k}"}),
            ReplyGrammar(100.0 + k, 60.0, k % 2 == 0, ("mug_0",) * (k % 3 == 0), k % 3, 9),
            seed=k * 2**50,
        )
        for k in range(40)
    ] + [ask(f"request {k}", seed=k) for k in range(40)]
    engine = ScriptedEngine(script)
    with serve(engine) as server:
        client = HttpEngine(server.settings(tries=1))
        assert client.complete(requests) == ScriptedEngine(script).complete(requests)
        assert client.name == "openai:scripted"
        assert not client.notices
    assert len(engine.requests) == 80
    assert all(request in engine.requests for request in requests)


class Slow:
    """Counts its batches, each of which takes a moment."""

    name, repeats = "slow", True

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        time.sleep(0.02)
        return [Completion(r.messages[-1]["content"]) for r in requests]


def test_what_comes_together_is_answered_together() -> None:
    with serve(Slow(), max_batch=8, max_wait_s=0.2) as server:
        completions = HttpEngine(server.settings(concurrency=64)).complete([ask(str(k)) for k in range(64)])
        assert [c.text for c in completions] == [str(k) for k in range(64)]
        assert server.batcher.sizes == [8] * 8


def test_one_request_does_not_wait_for_others_for_ever() -> None:
    with serve(Slow(), max_batch=64, max_wait_s=0.0) as server:
        assert HttpEngine(server.settings()).complete([ask("x")])[0].text == "x"
        assert server.batcher.sizes == [1]


class Warm:
    """Says at which temperature and with which other draws it was asked."""

    name, repeats = "warm", True

    def __init__(self, sampling: Sampling) -> None:
        self.sampling = sampling

    def with_sampling(self, sampling: Sampling) -> "Warm":
        return Warm(sampling)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [Completion(str(self.sampling)) for _ in requests]


def test_an_engine_that_can_draws_as_the_request_says() -> None:
    default = Sampling(0.2)
    with serve(Warm(default), sampling=default) as server:
        for sampling in (Sampling(1.5, 0.5, 7, 99), default):
            assert HttpEngine(server.settings(), sampling).complete([ask("x")])[0].text == str(sampling)
        body = {"model": "warm", "messages": [{"role": "user", "content": "x"}], "temperature": 0.9}
        status, answer = post(server.url, body)
        assert status == 200
        assert answer["choices"][0]["message"]["content"] == str(Sampling(0.9))


class Broken:
    name, repeats = "broken", True

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        if requests[0].seed:
            raise IndexError("list index\nout of range")
        return []


def test_an_engine_that_breaks_is_a_failure_and_the_server_goes_on() -> None:
    with serve(Broken()) as server:
        engine = HttpEngine(server.settings())
        for seed in (1, 0, 1):
            (completion,) = engine.complete([ask("x", seed=seed)])
            assert completion.code == "unexpected"
            assert "\n" not in completion.failure


def post(url: str, body: Any, path: str = "/chat/completions") -> tuple[int, Any]:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    with urllib3.PoolManager() as pool:
        answer = pool.request("POST", url + path, body=content, retries=False)
        return answer.status, answer.json()


GOOD = {"model": "scripted", "messages": [{"role": "user", "content": "x"}]}
WRONG: list[tuple[Any, int, str]] = [
    (b"{", 400, "Expecting"),
    (b"[" * 100_000, 400, "recursion"),
    ([], 400, "no JSON object"),
    ({**GOOD, "messages": []}, 400, "messages"),
    ({**GOOD, "messages": [{"role": "user", "content": [{"type": "text", "text": "x"}]}]}, 400, "role and content"),
    ({**GOOD, "stream": True}, 400, "stream"),
    ({**GOOD, "n": 2}, 400, "n > 1"),
    ({**GOOD, "temperature": "warm"}, 400, "temperature"),
    ({**GOOD, "seed": -1}, 400, "seed"),
    ({**GOOD, "stable_data": {"form": {"width_cm": 1}}}, 400, "form"),
    ({**GOOD, "stable_data": 7}, 400, "stable_data"),
    ({**GOOD, "model": "other"}, 404, "expected scripted"),
    (b" " * (4 * 2**20 + 1), 413, "Content-Length"),
]


@pytest.mark.parametrize(("body", "status", "words"), WRONG)
def test_what_is_no_request_gets_a_clear_error(body: Any, status: int, words: str) -> None:
    with serve(ScriptedEngine(script)) as server:
        found, answer = post(server.url, body)
        assert found == status
        assert words in answer["error"]["message"]
        assert post(server.url, GOOD)[0] == 200


def test_a_schema_is_taken_and_its_limits_reach_the_engine() -> None:
    engine = ScriptedEngine(script)
    form = ReplyGrammar(120.0, 60.0, True, ("mug_0",), 1, 5)
    with serve(engine) as server:
        HttpEngine(server.settings(sends_form=False)).complete([ask("x", form=form)])
    (request,) = engine.requests
    assert (request.form.names, request.form.at_least, request.form.at_most) == (("mug_0",), 1, 5)


def test_models_are_listed_and_other_paths_are_not_served() -> None:
    with serve(ScriptedEngine(script)) as server, urllib3.PoolManager() as pool:
        listed = pool.request("GET", f"{server.url}/models").json()
        assert [model["id"] for model in listed["data"]] == ["scripted"]
        assert pool.request("GET", f"{server.url}/secrets").status == 404
        assert post(server.url, GOOD, "/embeddings")[0] == 404


def test_it_listens_on_this_machine_alone() -> None:
    with serve(ScriptedEngine(script)) as server:
        assert server.server_address[0] == "127.0.0.1"


def test_an_address_that_is_taken_is_refused() -> None:
    with serve(ScriptedEngine(script)) as server:
        port = server.server_address[1]
        with pytest.raises(ConfigError) as caught:
            serve(ScriptedEngine(script), port=port).__enter__()
    assert caught.value.code == "address_unusable"


class Held:
    """Answers when it is let go."""

    name, repeats = "held", True

    def __init__(self) -> None:
        self.begun, self.go = threading.Event(), threading.Event()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.begun.set()
        self.go.wait()
        return [Completion("at last") for _ in requests]


def test_what_is_under_way_is_answered_before_it_closes() -> None:
    found: list[Completion] = []
    held = Held()
    with serve(held) as server:
        engine = HttpEngine(server.settings(tries=1))
        thread = threading.Thread(target=lambda: found.extend(engine.complete([ask("x")])))
        thread.start()
        held.begun.wait()
        threading.Timer(0.1, held.go.set).start()  # it is asked to close before
    thread.join()
    assert [c.text for c in found] == ["at last"]
    assert engine.complete([ask("y")])[0].code in ("endpoint_down", "endpoint_error")


def test_the_command_serves_until_it_is_interrupted(tmp_path: Path) -> None:
    script = tmp_path / "script.json"
    script.write_text(json.dumps({"hello": "an answer"}))
    command = [
        sys.executable,
        "-m",
        "models.semantic_reasoner.engines.chat_server",
        "--engine",
        f"scripted:{script}",
        "--port",
        "0",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).resolve().parents[4]) as process:
        assert process.stdout is not None
        url, _, rest = process.stdout.readline().partition(" ")
        assert url.startswith("http://127.0.0.1:")
        assert f"openai:scripted --set engine.http.base_url={url}" in rest
        assert HttpEngine(HttpSettings(url, "scripted", sends_form=True)).complete([ask("hello")])[0].text == "an answer"
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 0


@pytest.mark.parametrize("words", [["--engine", "gpt"], ["--port", "70000"], ["--engine", "scripted:/nowhere.json"]])
def test_a_command_that_cannot_serve_is_one_line_and_status_2(words: list[str]) -> None:
    app = typer.Typer()
    app.command()(main)
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert done.output.startswith("error: ")
    assert done.output.count("\n") == 1
