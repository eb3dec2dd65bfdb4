"""The response cache: what was said once is said again, whoever writes at once, whatever is killed or broken."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from models.semantic_reasoner.engines.openai_engine import OpenAIEngine
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.engines.response_cache import CachedEngine, ResponseCache
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from stable_data.errors import ConfigError
from tests.models.semantic_reasoner.engines.endpoint import Act, ask, endpoint, said

ROOT = Path(__file__).parents[4]
SAMPLING = Sampling()


def never_the_same(words: str, number: int, body: dict[str, Any]) -> Act:
    return Act(body=said(f"{words}, said the time {number + 1}"), after_s=0.03)


def test_a_replay_is_equal_and_asks_nothing(tmp_path: Path) -> None:
    with endpoint(never_the_same) as server:
        requests = [ask(f"é {k % 15}", seed=k % 5) for k in range(30)]  # each twice
        settings = server.settings(prompt_price=1.0)
        first = CachedEngine(OpenAIEngine(settings), ResponseCache(tmp_path), SAMPLING).complete(requests)
        assert server.tries.total() == 15
        again = CachedEngine(OpenAIEngine(settings), ResponseCache(tmp_path), SAMPLING).complete(requests)
        assert server.tries.total() == 15
    assert [c.is_cached for c in first] == [False] * 15 + [True] * 15
    assert all(c.is_cached for c in again)
    assert [replace(c, is_cached=False) for c in first] == [replace(c, is_cached=False) for c in again]
    assert first[:15] == [replace(c, is_cached=False) for c in first[15:]]
    assert again[0].cost == pytest.approx(20e-6)


def test_all_that_shapes_a_reply_is_in_the_key() -> None:
    request = ask("x")
    other_form = Request(request.messages, ReplyGrammar(119.0, 60.0))
    keys = {
        ResponseCache.key("e", SAMPLING, request),
        ResponseCache.key("f", SAMPLING, request),
        ResponseCache.key("e", Sampling(temperature=0.0), request),
        ResponseCache.key("e", SAMPLING, ask("y")),
        ResponseCache.key("e", SAMPLING, ask("x", seed=1)),
        ResponseCache.key("e", SAMPLING, other_form),
        ResponseCache.key("e", SAMPLING, Request(({"role": "system", "content": "x"},), request.form)),
    }
    assert len(keys) == 7
    assert ResponseCache.key("e", SAMPLING, ask("x")) in keys


def test_failures_are_not_kept(tmp_path: Path) -> None:
    script: list[str | Completion] = [Completion("", 9, 9, "cut", "reply_cut", cost=1.0), "better"]
    engine = CachedEngine(ScriptedEngine(script), ResponseCache(tmp_path), SAMPLING)
    first, twin = engine.complete([ask("x"), ask("x")])
    assert (first.code, twin.code) == ("reply_cut", "reply_cut")
    assert (first.cost, twin.cost) == (1.0, 0.0)
    assert engine.complete([ask("x")]) == [Completion("better")]
    assert engine.complete([ask("x")]) == [Completion("better", is_cached=True)]


def with_sum(content: bytes, **changes: Any) -> bytes:
    """An entry with other content and the checksum that fits: whoever can write to the folder can make one."""
    fields = {**json.loads(content), **changes}
    key, _ = fields.pop("key"), fields.pop("sum")
    return json.dumps({"key": key, "sum": sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest(), **fields}).encode()


BROKEN: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda b: b"",
    "half": lambda b: b[: len(b) // 2],
    "no text": lambda b: b"\xff\x00\xfe",
    "zeros": lambda b: bytes(len(b)),
    "changed": lambda b: b.replace(b"first", b"other"),
    "of another": lambda b: json.dumps({**json.loads(b), "key": "0"}).encode(),
    "a list": lambda b: b"[]",
    "deep": lambda b: b"[" * 100_000,
    "no words": lambda b: with_sum(b, text=7),
    "half a character": lambda b: with_sum(b, text="\ud800"),
    "tokens below none": lambda b: with_sum(b, prompt_tokens=-1),
    "a cost that is no number": lambda b: with_sum(b, cost=float("nan")),
    "a further field": lambda b: with_sum(b, is_cached=False),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_entry_is_a_miss_with_a_notice_and_is_mended(how: str, tmp_path: Path) -> None:
    engine = CachedEngine(ScriptedEngine(["first", "second"]), ResponseCache(tmp_path), SAMPLING)
    engine.complete([ask("x")])
    path = engine.cache.path(ResponseCache.key(engine.name, SAMPLING, ask("x")))
    path.write_bytes(BROKEN[how](path.read_bytes()))
    assert engine.complete([ask("x")]) == [Completion("second")]
    assert [n.code for n in engine.notices] == ["cache_entry_broken"]
    assert str(path) in engine.notices[0].message
    assert engine.complete([ask("x")]) == [Completion("second", is_cached=True)]
    assert len(engine.notices) == 1


def test_a_folder_in_the_place_of_an_entry_is_a_notice(tmp_path: Path) -> None:
    engine = CachedEngine(ScriptedEngine(["first"]), ResponseCache(tmp_path), SAMPLING)
    engine.cache.path(ResponseCache.key(engine.name, SAMPLING, ask("x"))).mkdir(parents=True)
    assert engine.complete([ask("x")]) == [Completion("first")]
    assert [n.code for n in engine.notices] == ["cache_entry_broken", "cache_unwritable"]


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        ResponseCache(tmp_path / "file" / "cache")


def test_who_writes_at_once_gets_what_the_first_one_wrote(tmp_path: Path) -> None:
    requests, found = [ask(str(k)) for k in range(40)], [list[Completion]() for _ in range(4)]
    with endpoint(never_the_same) as server:

        def work(k: int) -> None:
            found[k] = CachedEngine(OpenAIEngine(server.settings()), ResponseCache(tmp_path), SAMPLING).complete(requests)

        threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert server.tries.total() > 40  # they did ask the same at once
    texts = [[c.text for c in completions] for completions in found]
    assert texts == [texts[0]] * 4
    assert len([p for p in tmp_path.rglob("*") if p.is_file()]) == 40


def test_a_file_system_without_links_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: Any) -> None:
        raise PermissionError("no links here")

    monkeypatch.setattr("os.link", no_links)
    cache, key = ResponseCache(tmp_path), "ab" * 32
    assert cache.store(key, Completion("first")) == Completion("first")
    assert cache.store(key, Completion("second")) == Completion("first")
    assert cache.read(key) == Completion("first", is_cached=True)
    assert not cache.notices


KILLED = """
import sys
from models.semantic_reasoner.engines.protocol import Sampling
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.openai_engine import OpenAIEngine
from models.semantic_reasoner.engines.response_cache import CachedEngine, ResponseCache
from tests.models.semantic_reasoner.engines.endpoint import ask

class Loud(ResponseCache):
    def store(self, key, completion):
        kept = super().store(key, completion)
        print(key, kept.text, flush=True)
        return kept

engine = OpenAIEngine(HttpSettings(sys.argv[1], "m", concurrency=4))
CachedEngine(engine, Loud(sys.argv[2]), Sampling()).complete([ask(str(k)) for k in range(100)])
print("done", flush=True)
"""


def test_a_kill_loses_no_completion_that_was_kept(tmp_path: Path) -> None:
    kept: dict[str, str] = {}
    with endpoint(never_the_same) as server:
        command = [sys.executable, "-c", KILLED, server.url, str(tmp_path)]
        for _ in range(2):
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as child:
                assert child.stdout is not None
                for _ in range(7):
                    key, _, text = child.stdout.readline().rstrip("\n").partition(" ")
                    kept[key] = text
                child.send_signal(signal.SIGKILL)
                more = [line.partition(" ") for line in child.stdout.read().splitlines(keepends=True)]
                kept |= {key: text.rstrip("\n") for key, _, text in more if text.endswith("\n")}
            assert child.returncode == -signal.SIGKILL
            assert len(server.tries) < 100  # it was in the middle
        cache = ResponseCache(tmp_path)
        engine = CachedEngine(OpenAIEngine(server.settings()), cache, SAMPLING)
        requests = [ask(str(k)) for k in range(100)]
        completions = engine.complete(requests)
        final = {cache.key(engine.name, SAMPLING, r): c for r, c in zip(requests, completions, strict=True)}
        assert 14 <= len(kept) < 100
        assert {key: final[key].text for key in kept} == kept
        assert all(final[key].is_cached for key in kept)
        for text in kept.values():  # nothing that was kept was asked again
            words, _, number = text.partition(", said the time ")
            assert server.tries[words] == int(number)
    assert not cache.notices
    assert not [c for c in completions if c.failure]
