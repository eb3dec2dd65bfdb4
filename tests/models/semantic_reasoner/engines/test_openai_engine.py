"""The openai engine against servers that misbehave: nothing is lost, nothing is doubled, and what is said helps."""

import asyncio
import gzip
import ipaddress
import logging
import pickle
import ssl
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.openai_engine import OpenAIEngine, completion_of
from models.semantic_reasoner.engines.protocol import Completion, Sampling
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from stable_data.errors import ConfigError
from tests.bounds import limit
from tests.models.semantic_reasoner.engines.endpoint import Act, ask, closed_url, endpoint, error, said

KEY = "sk-very/secret-0123456789"


FAULTS = {
    0: [Act(429, error("slow down"))],
    1: [Act(429, error("slow down"), {"Retry-After": "1"})],
    2: [Act(500, b"<html>oops</html>"), Act(503, error("busy"))],
    3: [Act(body=said("too late"), after_s=5.0)],  # the client reads for two seconds
    4: [Act(drops=True), Act(drops=True)],
    5: [Act(body=said("half"), cuts=True)],
    6: [Act(409, error("conflict")), Act(408, b"")],
}
"""What the first tries of a request get, by its number; others get none."""


def test_of_200_requests_at_once_none_is_lost_and_none_doubled() -> None:
    faults = {f"request {k}": FAULTS.get(k % 16, []) for k in range(200)}
    with endpoint(lambda words, number, _: faults[words][number] if number < len(faults[words]) else None) as server:
        settings = server.settings(concurrency=200, read_s=2.0)
        completions = OpenAIEngine(settings).complete([ask(words) for words in faults])
        assert completions == [Completion(f"echo {words}", 20, 5) for words in faults]
        assert server.tries == {words: 1 + len(acts) for words, acts in faults.items()}
        late = {words for words, acts in faults.items() if acts == FAULTS[3]}  # answered, but nobody listened any more
        assert {words: n for words, n in server.answered.items() if words not in late} == dict.fromkeys(faults.keys() - late, 1)
        asked_to_wait = [server.moments[words] for words, acts in faults.items() if acts == FAULTS[1]]
        assert len(asked_to_wait) == 13
        assert all(second - first >= 0.99 for first, second in asked_to_wait)


def test_no_more_requests_are_under_way_than_allowed() -> None:
    with endpoint(lambda *_: Act(body=said("x"), after_s=0.01)) as server:
        engine = OpenAIEngine(server.settings(concurrency=7))
        assert len(engine.complete([ask(str(k)) for k in range(100)])) == 100
        assert 1 < server.most_under_way <= 7


def test_no_requests_are_no_completions() -> None:
    assert OpenAIEngine(HttpSettings(closed_url(), "m")).complete([]) == []


def test_what_is_asked_for_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", f" {KEY}\n")
    with endpoint() as server:
        settings = server.settings(key_variable="SOME_KEY", extra='{"top_k": 50}')
        OpenAIEngine(settings, Sampling(0.3, 0.8, 40, 123)).complete([ask("hello", seed=2**63 + 7)])
        (body,), (headers,) = server.bodies, server.headers
    asked = {key: body[key] for key in ("model", "temperature", "top_p", "max_tokens", "seed", "top_k")}
    assert asked == {"model": "m", "temperature": 0.3, "top_p": 0.8, "max_tokens": 123, "seed": 7, "top_k": 50}
    assert body["messages"] == [{"role": "user", "content": "hello"}]
    assert body["response_format"]["type"] == "json_schema"
    assert body["response_format"]["json_schema"]["strict"] is True
    assert headers["Authorization"] == f"Bearer {KEY}"


@pytest.mark.parametrize("status", [401, 400, 500, 200])
def test_the_key_is_in_no_message_and_no_log_whatever_the_endpoint_says(
    status: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    caplog.set_level(logging.DEBUG)
    body = said(f"your key is {KEY}") if status == 200 else error(f"json_schema: bad key {KEY}")
    with endpoint(lambda *_: Act(status, body)) as server:
        engine = OpenAIEngine(server.settings(key_variable="SOME_KEY", tries=1))
        (completion,) = engine.complete([ask("x")])
    seen = f"{completion} {engine!r} {engine.name} {engine.settings} {pickle.dumps(engine)!r} {caplog.text}"
    assert "***" in seen
    assert KEY not in seen
    assert KEY.replace("/", "\\/") not in seen


REFUSED = [
    (401, "key_refused", "check the key (key_variable names none)"),
    (403, "key_refused", "check the key"),
    (404, "model_unknown", "ends in /v1"),
    (400, "request_refused", "too long a prompt"),
    (418, "request_refused", "null in extra"),
]


@pytest.mark.parametrize(("status", "code", "words"), REFUSED)
def test_what_cannot_pass_is_not_tried_again_and_says_what_to_do(status: int, code: str, words: str) -> None:
    with endpoint(lambda words, *_: Act(status, error("too long a\nprompt")) if words == "x" else None) as server:
        (completion,) = OpenAIEngine(server.settings()).complete([ask("x")])
        assert server.tries["x"] == 1
    assert completion.code == code
    assert words in completion.failure
    assert server.url in completion.failure
    assert "\n" not in completion.failure
    assert completion.text == ""


def test_a_longer_wait_than_the_client_agrees_to_is_not_begun() -> None:
    with endpoint(lambda *_: Act(429, error("later"), {"Retry-After": "3600"})) as server:
        (completion,) = OpenAIEngine(server.settings()).complete([ask("x")])
        assert (completion.code, server.tries["x"]) == ("rate_limited", 1)
    assert "later" in completion.failure


@pytest.mark.parametrize("settings", [{"read_s": 0.1}, {"total_s": 0.3}])
def test_silence_and_answers_that_drip_are_left(settings: dict[str, float]) -> None:
    act = Act(body=said("x" * 1000), drips_s=0.02) if "total_s" in settings else Act(body=said("x"), after_s=0.5)
    with endpoint(lambda words, *_: act if words == "x" else None) as server:
        (completion,) = OpenAIEngine(server.settings(tries=2, **settings)).complete([ask("x")])
    assert completion.code == "endpoint_timeout"


def test_a_redirect_is_refused_and_its_target_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    with endpoint() as other, endpoint(lambda *_: Act(307, b"", {"Location": f"{other.url}/chat/completions?a=b"})) as server:
        (completion,) = OpenAIEngine(server.settings(key_variable="SOME_KEY")).complete([ask("x")])
        assert (completion.code, server.tries["x"], other.tries.total()) == ("redirect_refused", 1, 0)
        assert f"127.0.0.1:{other.server_address[1]}" in completion.failure
    assert "base_url" in completion.failure


def test_a_proxy_of_the_environment_is_asked_and_one_that_cannot_be_used_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with endpoint() as proxy:
        monkeypatch.setenv("http_proxy", proxy.url.removesuffix("/v1"))
        engine = OpenAIEngine(HttpSettings("http://some-host.invalid/v1", "m", tries=1))
        assert engine.complete([ask("x")])[0].text == "echo x"
        assert proxy.paths == ["http://some-host.invalid/v1/chat/completions"]
    monkeypatch.setenv("http_proxy", "gopher://host")
    with pytest.raises(ConfigError, match="check the proxies"):
        OpenAIEngine(HttpSettings("http://some-host.invalid/v1", "m"))


def test_an_azure_endpoint_is_asked_as_azure_wants_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    with endpoint() as server:
        url = server.url.removesuffix("/v1")
        settings = server.settings(base_url=url, key_variable="SOME_KEY", azure_api_version="2024-10-21")
        assert OpenAIEngine(settings).complete([ask("x")])[0].text == "echo x"
        assert server.paths == ["/openai/deployments/m/chat/completions?api-version=2024-10-21"]
        assert server.headers[0]["api-key"] == KEY
        assert "Authorization" not in server.headers[0]


def certificate_of_this_machine(folder: Path) -> Path:
    """A certificate that nobody vouches for, with its key."""
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "127.0.0.1")])
    builder = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number(), now, now + timedelta(days=1))
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    certificate = builder.add_extension(address, critical=False).sign(key, hashes.SHA256())
    pem, none = serialization.Encoding.PEM, serialization.NoEncryption()
    path = folder / "certificate.pem"
    path.write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, none) + certificate.public_bytes(pem))
    return path


def test_nothing_is_sent_to_a_host_that_nobody_vouches_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    certificate = certificate_of_this_machine(tmp_path)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    with endpoint() as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        settings = server.settings(base_url=server.url.replace("http:", "https:"))
        (completion,) = OpenAIEngine(settings).complete([ask("x")])
        assert completion.code == "certificate_refused"
        assert "SSL_CERT_FILE" in completion.failure
        assert not server.tries
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        assert OpenAIEngine(settings).complete([ask("x")])[0].text == "echo x"


NEW_FIELDS = '{"max_tokens": null, "max_completion_tokens": 99, "temperature": null}'


def test_a_field_that_the_endpoint_never_takes_ends_the_run_and_null_leaves_it_out() -> None:
    refused = error("Unsupported parameter: 'max_tokens' is not supported with this model.", code="unsupported_parameter")
    with endpoint(lambda words, number, body: Act(400, refused) if "max_tokens" in body else None) as server:
        (completion,) = OpenAIEngine(server.settings()).complete([ask("x")])
        assert (completion.code, server.tries["x"]) == ("endpoint_down", 1)
        assert "'max_tokens' is not supported" in completion.failure
        assert "null in extra leaves out" in completion.failure
        assert OpenAIEngine(server.settings(extra=NEW_FIELDS)).complete([ask("x")])[0].text == "echo x"
        last = server.bodies[-1]
    assert last["max_completion_tokens"] == 99
    assert {"max_tokens", "temperature"}.isdisjoint(last)
    assert {"top_p", "seed", "response_format"} <= set(last)


def test_one_request_that_is_refused_for_its_words_changes_nothing_for_the_others() -> None:
    with endpoint(lambda words, *_: Act(400, error("bad grammar in messages")) if words == "bad" else None) as server:
        engine = OpenAIEngine(server.settings(concurrency=1))
        assert [c.code for c in engine.complete([ask("bad"), ask("good")])] == ["request_refused", ""]
        assert server.bodies[-1]["response_format"]["type"] == "json_schema"


def test_a_reply_without_a_form_has_no_schema_and_nor_has_the_question_that_looks_for_the_endpoint() -> None:
    with endpoint(lambda words, *_: Act(500) if words == "x" else None) as server:
        free = ask("x", form=ReplyGrammar(120.0, 60.0, binds=False))
        (completion,) = OpenAIEngine(server.settings(tries=1)).complete([free])
        assert completion.code == "endpoint_error"
        assert len(server.bodies) == 2
        assert not [body for body in server.bodies if "response_format" in body]


@pytest.mark.parametrize(
    "detail", ["too large", [{"loc": ["body", "seed"], "msg": "too large"}], {"deep": ["too large"]}], ids=type
)
def test_an_error_says_what_the_endpoint_says_however_it_is_nested(detail: Any) -> None:
    for body in (error(detail), {"error": detail}, {"detail": detail}, {"object": "error", "message": detail, "code": 400}):
        with endpoint(lambda words, *_, body=body: Act(422, body) if words == "x" else None) as server:
            (completion,) = OpenAIEngine(server.settings()).complete([ask("x")])
        assert completion.code == "request_refused"
        assert "too large" in completion.failure


def test_a_prompt_that_the_model_cannot_read_is_said_to_be_too_long() -> None:
    refused = error("This model's maximum context length is 2048 tokens.", code="context_length_exceeded")
    with endpoint(lambda *_: Act(400, refused)) as server:
        (completion,) = OpenAIEngine(server.settings()).complete([ask("x")])
        assert server.tries == {"x": 1}
    assert completion.code == "prompt_too_long"
    assert "maximum context length" in completion.failure


FLAWS = [
    ({"finish_reason": "length"}, {}, "reply_cut"),
    ({"finish_reason": "content_filter"}, {}, "reply_filtered"),
    ({}, {"content": None, "refusal": "I will not"}, "reply_refused"),
    ({}, {"content": None}, "reply_empty"),
    ({}, {"content": " \n"}, "reply_empty"),
]


@pytest.mark.parametrize(("choice", "message", "code"), FLAWS)
def test_a_reply_that_cannot_be_used_is_a_failure_that_costs(
    choice: dict[str, Any], message: dict[str, Any], code: str
) -> None:
    body = said("half a rep")
    body["choices"][0] |= choice
    body["choices"][0]["message"] |= message
    with endpoint(lambda *_: Act(body=body)) as server:
        engine = OpenAIEngine(server.settings(prompt_price=2.0, reply_price=8.0))
        (completion,) = engine.complete([ask("x")])
        assert server.tries == {"x": 1}
    assert (completion.text, completion.code) == ("", code)
    assert completion.failure
    assert (completion.prompt_tokens, completion.reply_tokens) == (20, 5)
    assert completion.cost == pytest.approx((20 * 2 + 5 * 8) / 1e6)


def test_costs_are_counted_by_the_million() -> None:
    with endpoint(lambda *_: Act(body=said("x", usage={"prompt_tokens": 1000, "completion_tokens": 3000}))) as server:
        (completion,) = OpenAIEngine(server.settings(prompt_price=2.5, reply_price=10.0)).complete([ask("x")])
    assert completion == Completion("x", 1000, 3000, cost=0.0325)


def test_an_endpoint_that_counts_no_tokens_is_used_and_they_are_unknown() -> None:
    with endpoint(lambda *_: Act(body=said("x", usage=None))) as server:
        assert OpenAIEngine(server.settings(prompt_price=1.0)).complete([ask("x")]) == [Completion("x", None, None, cost=None)]
        assert OpenAIEngine(server.settings()).complete([ask("x")]) == [Completion("x", None, None, cost=0.0)]
    with endpoint(lambda *_: Act(body=said("x", usage={"prompt_tokens": 2000}))) as server:
        (completion,) = OpenAIEngine(server.settings(prompt_price=1.0)).complete([ask("x")])
    assert completion == Completion("x", 2000, None, cost=0.002)


def test_it_works_within_a_running_event_loop() -> None:
    with endpoint() as server:

        async def main() -> list[Completion]:
            return OpenAIEngine(server.settings()).complete([ask("x")])

        assert [c.text for c in asyncio.run(main())] == ["echo x"]


def test_what_is_not_under_way_is_not_sent_once_nobody_listens() -> None:
    with endpoint(lambda *_: Act(body=said("x"), after_s=0.05)) as server:
        found = OpenAIEngine(server.settings(concurrency=2)).as_completed([ask(str(k)) for k in range(500)])
        assert next(found)[1].text == "x"
        del found
        sent = server.tries.total()
        time.sleep(0.5)  # in which twenty more would be sent
        assert server.tries.total() <= sent + 4


def test_giving_up_in_a_wait_ends_it_and_leaves_the_engine_as_it_was() -> None:
    later = Act(429, error("later"), {"Retry-After": "100"})
    with endpoint(lambda words, *_: None if words in "ab" else later) as server:
        engine = OpenAIEngine(server.settings(concurrency=2))
        found = engine.as_completed([ask("a"), ask("waits")])
        assert next(found)[1].text == "echo a"
        del found
        assert [c.text for c in engine.complete([ask("b"), ask("b")])] == ["echo b"] * 2  # both places are free


@pytest.mark.parametrize("body", [b'{"choices": [', b"<html>oops</html>", b"[" * 100_000, {"error": "upstream"}, [], b""])
def test_an_answer_that_is_none_is_one_requests_failure(body: Any) -> None:
    with endpoint(lambda words, *_: Act(body=body) if words == "1" else None) as server:
        completions = OpenAIEngine(server.settings()).complete([ask("1"), ask("2")])
    assert [c.code for c in completions] == ["response_invalid", ""]
    assert "\n" not in completions[0].failure


KEYS = ["choices", "message", "content", "refusal", "finish_reason", "usage", "prompt_tokens", "completion_tokens"]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["length", 10**400]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=3), inner, max_size=5),
    max_leaves=20,
)
MESSAGES = st.fixed_dictionaries({}, optional={"content": st.text() | JSON, "refusal": JSON})
CHOICES = st.fixed_dictionaries({"message": MESSAGES | JSON}, optional={"finish_reason": JSON})
USAGES = st.fixed_dictionaries({"prompt_tokens": JSON, "completion_tokens": st.integers() | JSON})
ANSWERS = st.fixed_dictionaries({"choices": st.lists(CHOICES | JSON, min_size=1)}, optional={"usage": USAGES | JSON})


@given(ANSWERS | JSON)
def test_any_answer_is_a_completion_or_a_clear_error(answer: Any) -> None:
    try:
        completion = completion_of(answer, 1.0, 1.0)
    except ValueError:
        return
    assert bool(completion.text) != bool(completion.failure)
    assert bool(completion.failure) == bool(completion.code)
    completion.text.encode()


def test_an_engine_travels_without_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    with endpoint() as server:
        engine = OpenAIEngine(server.settings(key_variable="SOME_KEY"), Sampling(0.1))
        content = pickle.dumps(engine)
        assert KEY.encode() not in content
        other = pickle.loads(content)
        assert other.sampling == engine.sampling
        assert other.complete([ask("x")])[0].text == "echo x"
        monkeypatch.delenv("SOME_KEY")
        with pytest.raises(ConfigError, match="SOME_KEY is not set"):
            pickle.loads(content)


def test_names_tell_models_and_extra_fields_apart_but_not_hosts() -> None:
    names = [
        OpenAIEngine(HttpSettings(f"http://{h}/v1", m, extra=e)).name for h in "ab" for m in "mn" for e in ("", '{"top_k":1}')
    ]
    assert names[0] == "openai:m"
    assert names[:4] == names[4:]
    assert len(set(names)) == 4


def test_surprises_are_one_requests_failure() -> None:
    with endpoint(lambda words, *_: Act(body=said("\ud800 half a pair")) if words == "1" else None) as server:
        engine = OpenAIEngine(server.settings())
        no_form: Any = None  # a mistake of ours, which must not cost the others
        completions = engine.complete([ask("1"), ask("2", form=no_form), ask("3")])
    assert [c.code for c in completions] == ["", "unexpected", ""]
    assert completions[0].text.encode() == "\ufffd half a pair".encode()


WRONG = [
    {"base_url": "api.openai.com/v1"},
    {"base_url": "ftp://host/v1"},
    {"base_url": "https:///v1"},
    {"base_url": "http://[::1/v1"},
    {"base_url": "http://host:99999/v1"},
    {"base_url": "https://user:password@host/v1"},
    {"base_url": "https://host/v1?key=password"},
    {"model": ""},
    {"concurrency": 0},
    {"tries": 0},
    {"read_s": float("nan")},
    {"rest_s": -1.0},
    {"azure_api_version": "2024-10-21"},
    {"extra": "[1]"},
    {"extra": "{"},
]


@pytest.mark.parametrize("wrong", WRONG)
def test_settings_that_cannot_work_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        HttpSettings(**{"base_url": "http://host/v1", "model": "m", **wrong})
    assert "password" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["", "  ", "two words", "schlüssel"])
def test_a_key_that_cannot_be_sent_is_refused_at_once(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", key)
    with pytest.raises(ConfigError) as caught:
        OpenAIEngine(HttpSettings("http://host/v1", "m", "SOME_KEY"))
    assert caught.value.code == "key_missing"
    assert not key.strip() or key not in str(caught.value)


@pytest.mark.slow
@pytest.mark.ray
def test_it_works_within_a_ray_actor() -> None:
    import ray

    class Actor:
        def __init__(self, engine: OpenAIEngine) -> None:
            self.engine = engine

        async def complete(self, words: list[str]) -> list[str]:  # within the running loop of an asynchronous actor
            return [c.text for c in self.engine.complete([ask(w) for w in words])]

    with endpoint() as server:
        ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
        try:
            actor = ray.remote(Actor).remote(OpenAIEngine(server.settings()))
            words = [str(k) for k in range(50)]
            assert ray.get(actor.complete.remote(words)) == [f"echo {w}" for w in words]
        finally:
            ray.shutdown()


@pytest.mark.parametrize("status", [200, 500])
def test_an_answer_without_an_end_is_not_read(status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "text", max_answer_bytes=10_000)
    with endpoint(lambda *_: Act(status, said("x" * 100_000))) as server:
        (completion,) = OpenAIEngine(server.settings(tries=1)).complete([ask("a")])
    assert completion.code == "response_invalid"
    assert "at most 10,000 bytes (text.max_answer_bytes in STABLE_DATA_LIMITS)" in completion.failure


def test_a_compressed_answer_is_refused() -> None:
    """A few of its bytes could become gigabytes."""
    with endpoint(lambda *_: Act(200, gzip.compress(b"{}"), {"Content-Encoding": "gzip"})) as server:
        (completion,) = OpenAIEngine(server.settings(tries=1)).complete([ask("a")])
        assert server.headers[0]["Accept-Encoding"] == "identity"
    assert completion.code == "response_invalid"
    assert "compressed" in completion.failure


def test_a_failure_can_be_written_whatever_the_model_refused_with() -> None:
    found = completion_of({"choices": [{"message": {"content": None, "refusal": "no\ud800\x1b[2J"}}]})
    assert found.code == "reply_refused"
    assert found.failure.isprintable()
    found.failure.encode()
