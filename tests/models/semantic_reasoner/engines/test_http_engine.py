"""The openai engine against servers that misbehave: nothing is lost, nothing is doubled, and what is said helps."""

import asyncio
import ipaddress
import pickle
import ssl
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from models.semantic_reasoner.engines import http_engine
from models.semantic_reasoner.engines.http_engine import HttpEngine, seconds_to_wait
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Completion, Sampling
from stable_data.errors import ConfigError
from tests.models.semantic_reasoner.engines.endpoint import FORM, Act, ask, closed_url, endpoint, error, said

KEY = "sk-very/secret-0123456789"


FAULTS = {
    0: [Act(429, error("slow down"))],
    1: [Act(429, error("slow down"), {"Retry-After": "1"})],
    2: [Act(500, b"<html>oops</html>"), Act(503, error("busy"))],
    3: [Act(body=said("too late"), after_s=1.2)],  # the client reads for half a second
    4: [Act(drops=True), Act(drops=True)],
    5: [Act(body=b'{"choices": [')],
    6: [Act(body=said("half"), cuts=True)],
    7: [Act(body={"error": {"message": "upstream"}}), Act(409, error("conflict")), Act(408, b"")],
}
"""What the first tries of a request get, by its number; others get none."""


def test_of_200_requests_at_once_none_is_lost_and_none_doubled() -> None:
    faults = {f"request {k}": FAULTS.get(k % 16, []) for k in range(200)}
    with endpoint(lambda words, number, _: faults[words][number] if number < len(faults[words]) else None) as server:
        settings = server.settings(concurrency=200, read_s=0.5)
        completions = HttpEngine(settings).complete([ask(words) for words in faults])
        assert completions == [Completion(f"echo {words}", 20, 5) for words in faults]
        assert server.tries == {words: 1 + len(acts) for words, acts in faults.items()}
        late = {words for words, acts in faults.items() if acts == FAULTS[3]}  # answered, but nobody listened any more
        useless = {words for words, acts in faults.items() if acts[:1] == FAULTS[7][:1]}
        assert {words: n for words, n in server.answered.items() if words not in late | useless} == {
            words: 1 for words in faults if words not in late | useless
        }
        asked_to_wait = [server.moments[words] for words, acts in faults.items() if acts == FAULTS[1]]
        assert len(asked_to_wait) == 13
        assert all(second - first >= 1.0 for first, second in asked_to_wait)


def test_no_more_requests_are_under_way_than_allowed() -> None:
    with endpoint(lambda *_: Act(body=said("x"), after_s=0.01)) as server:
        engine = HttpEngine(server.settings(concurrency=7))
        assert len(engine.complete([ask(str(k)) for k in range(100)])) == 100
        assert 1 < server.most_under_way <= 7


def test_no_requests_are_no_completions() -> None:
    assert HttpEngine(HttpSettings(closed_url(), "m")).complete([]) == []


def test_what_is_asked_for_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", f" {KEY}\n")
    with endpoint() as server:
        settings = server.settings(key_variable="SOME_KEY", extra='{"top_k": 50}')
        HttpEngine(settings, Sampling(0.3, 0.8, 40, 123)).complete([ask("hello", seed=2**63 + 7)])
        (body,), (headers,) = server.bodies, server.headers
    asked = {key: body[key] for key in ("model", "temperature", "top_p", "max_tokens", "seed", "top_k")}
    assert asked == {"model": "m", "temperature": 0.3, "top_p": 0.8, "max_tokens": 123, "seed": 7, "top_k": 50}
    assert body["messages"] == [{"role": "user", "content": "hello"}]
    assert body["response_format"]["type"] == "json_schema"
    assert body["response_format"]["json_schema"]["strict"] is True
    assert headers["Authorization"] == f"Bearer {KEY}"


@pytest.mark.parametrize("status", [401, 400, 500, 200])
def test_the_key_is_in_no_message_whatever_the_endpoint_says(status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    body = said(f"your key is {KEY}") if status == 200 else error(f"json_schema: bad key {KEY}")
    with endpoint(lambda *_: Act(status, body)) as server:
        engine = HttpEngine(server.settings(key_variable="SOME_KEY", tries=1))
        (completion,) = engine.complete([ask("x")])
    seen = f"{completion} {engine.notices} {engine!r} {engine.name} {engine.settings} {pickle.dumps(engine)!r}"
    assert "***" in seen
    assert KEY not in seen
    assert KEY.replace("/", "\\/") not in seen


def test_the_key_is_in_no_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    with endpoint(
        lambda w, n, body: Act(400, error(f"json_schema with {KEY}")) if "response_format" in body else None
    ) as server:
        engine = HttpEngine(server.settings(key_variable="SOME_KEY"))
        assert engine.complete([ask("x")])[0].text == "echo x"
    (notice,) = engine.notices
    assert "json_schema with ***" in notice.message


REFUSED = [
    (401, "key_refused", "check the key (key_variable names none)"),
    (403, "key_refused", "check the key"),
    (404, "model_unknown", "ends in /v1"),
    (400, "request_refused", "too long a prompt"),
    (418, "request_refused", "status 418"),
]


@pytest.mark.parametrize(("status", "code", "words"), REFUSED)
def test_what_cannot_pass_is_not_tried_again_and_says_what_to_do(status: int, code: str, words: str) -> None:
    with endpoint(lambda *_: Act(status, error("too long a\nprompt"))) as server:
        (completion,) = HttpEngine(server.settings()).complete([ask("x")])
        assert server.tries == {"x": 1}
    assert completion.code == code
    assert words in completion.failure
    assert server.url in completion.failure
    assert "\n" not in completion.failure
    assert completion.text == ""


def test_a_spent_quota_is_not_tried_again() -> None:
    with endpoint(lambda *_: Act(429, error("You exceeded your quota", code="insufficient_quota"))) as server:
        (completion,) = HttpEngine(server.settings()).complete([ask("x")])
        assert (completion.code, server.tries["x"]) == ("quota_spent", 1)


def test_a_longer_wait_than_there_is_time_for_is_not_begun() -> None:
    with endpoint(lambda *_: Act(429, error("later"), {"Retry-After": "3600"})) as server:
        (completion,) = HttpEngine(server.settings()).complete([ask("x")])
        assert (completion.code, server.tries["x"]) == ("rate_limited", 1)
    assert "3600 s" in completion.failure


@pytest.mark.parametrize(("settings", "code"), [({"read_s": 0.1}, "endpoint_timeout"), ({"total_s": 0.3}, "endpoint_timeout")])
def test_silence_and_answers_that_drip_are_left(settings: dict[str, float], code: str) -> None:
    act = Act(body=said("x" * 1000), drips_s=0.02) if "total_s" in settings else Act(body=said("x"), after_s=0.5)
    with endpoint(lambda *_: act) as server:
        (completion,) = HttpEngine(server.settings(tries=2, **settings)).complete([ask("x")])
    assert completion.code == code


def test_a_redirect_is_refused_and_its_target_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    with endpoint() as other, endpoint(lambda *_: Act(307, b"", {"Location": f"{other.url}/chat/completions?a=b"})) as server:
        (completion,) = HttpEngine(server.settings(key_variable="SOME_KEY")).complete([ask("x")])
        assert (completion.code, server.tries["x"], other.tries.total()) == ("redirect_refused", 1, 0)
        assert f"127.0.0.1:{other.server_address[1]}" in completion.failure
    assert "base_url" in completion.failure


def test_proxies_of_the_environment_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    with endpoint() as proxy, endpoint() as server:
        for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
            monkeypatch.setenv(name, proxy.url)
        assert HttpEngine(server.settings()).complete([ask("x")])[0].text == "echo x"
        assert proxy.tries.total() == 0


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
        (completion,) = HttpEngine(settings).complete([ask("x")])
        assert completion.code == "certificate_refused"
        assert "SSL_CERT_FILE" in completion.failure
        assert not server.tries
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        assert HttpEngine(settings).complete([ask("x")])[0].text == "echo x"


def takes(*kinds: str) -> Any:
    def plan(words: str, number: int, body: dict[str, Any]) -> Act | None:
        kind = body.get("response_format", {}).get("type", "none")
        return (
            None
            if kind in kinds
            else Act(400, error(f"'response_format.type' must be one of {kinds}", param="response_format"))
        )

    return plan


@pytest.mark.parametrize(("taken", "num_refused"), [("json_schema", 0), ("json_object", 1), ("none", 2)])
def test_a_schema_is_left_where_the_endpoint_takes_none_once_and_with_a_notice(taken: str, num_refused: int) -> None:
    with endpoint(takes(taken)) as server:
        engine = HttpEngine(server.settings(concurrency=1, tries=1))
        assert [c.text for c in engine.complete([ask("a"), ask("b")])] == ["echo a", "echo b"]
        assert [c.text for c in engine.complete([ask("c")])] == ["echo c"]
        assert server.tries == {"a": 1 + num_refused, "b": 1, "c": 1}
    assert [n.code for n in engine.notices] == ["response_format_refused"] * (num_refused > 0)
    assert all("from now on" in n.message for n in engine.notices)


def test_many_threads_that_are_refused_at_once_take_one_step() -> None:
    with endpoint(takes("json_object")) as server:
        engine = HttpEngine(server.settings(concurrency=16))
        assert not [c for c in engine.complete([ask(str(k)) for k in range(64)]) if c.failure]
        assert {body.get("response_format", {}).get("type") for body in server.bodies} == {"json_schema", "json_object"}
    assert len(engine.notices) == 1


def test_one_request_that_is_refused_for_its_words_changes_nothing_for_the_others() -> None:
    with endpoint(lambda words, *_: Act(400, error("bad grammar in messages")) if words == "bad" else None) as server:
        engine = HttpEngine(server.settings(concurrency=1))
        assert [c.code for c in engine.complete([ask("bad"), ask("good")])] == ["request_refused", ""]
        assert server.bodies[-1]["response_format"]["type"] == "json_schema"
    assert not engine.notices


def test_a_model_that_takes_other_fields_gets_those() -> None:
    def plan(words: str, number: int, body: dict[str, Any]) -> Act | None:
        if "max_tokens" in body:
            message = (
                "Unsupported parameter: 'max_tokens' is not supported with this model. Use 'max_completion_tokens' instead."
            )
            return Act(400, error(message, param="max_tokens", code="unsupported_parameter"))
        if "temperature" in body:
            message = "'temperature' does not support 0.7 with this model."
            return Act(400, error(message, param="temperature", code="unsupported_value"))
        return None

    with endpoint(plan) as server:
        engine = HttpEngine(server.settings(tries=1), Sampling(max_tokens=99))
        assert engine.complete([ask("x")])[0].text == "echo x"
        last = server.bodies[-1]
    assert last["max_completion_tokens"] == 99
    assert {"max_tokens", "temperature"}.isdisjoint(last)
    assert {"top_p", "seed", "response_format"} <= set(last)
    assert [n.code for n in engine.notices] == ["max_tokens_refused", "temperature_refused"]


def test_too_long_a_reply_for_the_model_is_no_unknown_field() -> None:
    message = "'max_tokens' or 'max_completion_tokens' is too large: 4096. This model's maximum context length is 2048 tokens."
    with endpoint(lambda *_: Act(400, {"object": "error", "message": message, "code": 400})) as server:
        engine = HttpEngine(server.settings())
        (completion,) = engine.complete([ask("x")])
        assert server.tries == {"x": 1}
    assert "maximum context length" in completion.failure
    assert not engine.notices


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
        engine = HttpEngine(server.settings(prompt_price=2.0, reply_price=8.0))
        (completion,) = engine.complete([ask("x")])
        assert server.tries == {"x": 1}
    assert (completion.text, completion.code) == ("", code)
    assert completion.failure
    assert (completion.prompt_tokens, completion.reply_tokens) == (20, 5)
    assert completion.cost == pytest.approx((20 * 2 + 5 * 8) / 1e6)


def test_costs_are_counted_by_the_million() -> None:
    with endpoint(lambda *_: Act(body=said("x", usage={"prompt_tokens": 1000, "completion_tokens": 3000}))) as server:
        (completion,) = HttpEngine(server.settings(prompt_price=2.5, reply_price=10.0)).complete([ask("x")])
    assert completion == Completion("x", 1000, 3000, cost=0.0325)


def test_an_endpoint_that_says_no_tokens_is_used() -> None:
    with endpoint(lambda *_: Act(body=said("x", usage=None))) as server:
        assert HttpEngine(server.settings(prompt_price=1.0)).complete([ask("x")]) == [Completion("x")]


def test_it_works_within_a_running_event_loop() -> None:
    with endpoint() as server:

        async def main() -> list[Completion]:
            return HttpEngine(server.settings()).complete([ask("x")])

        assert [c.text for c in asyncio.run(main())] == ["echo x"]


def test_what_is_not_under_way_is_not_sent_once_nobody_listens() -> None:
    with endpoint(lambda *_: Act(body=said("x"), after_s=0.05)) as server:
        found = HttpEngine(server.settings(concurrency=2)).as_completed([ask(str(k)) for k in range(500)])
        assert next(found)[1].text == "x"
        del found
        sent = server.tries.total()
        time.sleep(0.5)  # in which twenty more would be sent
        assert server.tries.total() <= sent + 4


def test_giving_up_in_a_wait_ends_it_and_leaves_the_engine_as_it_was() -> None:
    with endpoint(lambda words, *_: None if words in "ab" else Act(drops=True)) as server:
        engine = HttpEngine(server.settings(first_wait_s=30.0, longest_wait_s=30.0, give_up_after=1))
        found = engine.as_completed([ask("a"), ask("waits")])
        assert next(found)[1].text == "echo a"
        del found
        assert engine.complete([ask("b")])[0].text == "echo b"


def test_the_last_try_is_not_followed_by_a_wait() -> None:
    with endpoint(lambda *_: Act(429, error("later"), {"Retry-After": "3600"})) as server:
        (completion,) = HttpEngine(server.settings(tries=1)).complete([ask("x")])
    assert completion.code == "rate_limited"
    assert "after 1 tries" in completion.failure
    assert "no time" not in completion.failure


def test_an_answer_without_end_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_engine, "MAX_BYTES", 10_000)
    with endpoint(lambda words, *_: Act(body=said("x" * 10_001)) if words == "long" else None) as server:
        long, short = HttpEngine(server.settings(tries=2)).complete([ask("long"), ask("short")])
        assert server.tries["long"] == 2
    assert long.code == "response_invalid"
    assert "10,000 bytes" in long.failure
    assert short.text == "echo short"


def test_an_engine_travels_without_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", KEY)
    with endpoint() as server:
        engine = HttpEngine(server.settings(key_variable="SOME_KEY"), Sampling(0.1))
        content = pickle.dumps(engine)
        assert KEY.encode() not in content
        other = pickle.loads(content)
        assert other.sampling == engine.sampling
        assert other.complete([ask("x")])[0].text == "echo x"
        monkeypatch.delenv("SOME_KEY")
        with pytest.raises(ConfigError, match="SOME_KEY is not set"):
            pickle.loads(content)


def test_another_sampling_of_the_same_endpoint() -> None:
    with endpoint() as server:
        HttpEngine(server.settings()).with_sampling(Sampling(temperature=0.0)).complete([ask("x")])
        assert server.bodies[0]["temperature"] == 0.0


def test_names_tell_models_and_extra_fields_apart_but_not_hosts() -> None:
    names = [
        HttpEngine(HttpSettings(f"http://{h}/v1", m, extra=e)).name for h in "ab" for m in "mn" for e in ("", '{"top_k":1}')
    ]
    assert names[0] == "openai:m"
    assert names[:4] == names[4:]
    assert len(set(names)) == 4


def test_surprises_are_one_requests_failure() -> None:
    with endpoint(lambda words, *_: Act(body=said("\ud800 half a pair")) if words == "1" else None) as server:
        engine = HttpEngine(server.settings())
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
    {"first_wait_s": -1.0},
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
        HttpEngine(HttpSettings("http://host/v1", "m", "SOME_KEY"))
    assert caught.value.code == "key_missing"
    assert not key.strip() or key not in str(caught.value)


def test_how_long_to_wait() -> None:
    assert [seconds_to_wait(x) for x in ("7", " 0 ", "-3", "", "soon", "Wed, 21 Oct 2015 07:28:00 GMT")] == [7, 0, 0, 0, 0, 0]
    assert seconds_to_wait("Wed, 21 Oct 2099 07:28:00 GMT") > 1e9


def test_the_form_is_kept_for_our_own_server() -> None:
    with endpoint() as server:
        HttpEngine(server.settings()).complete([ask("x")])
        HttpEngine(server.settings(sends_form=True)).complete([ask("x")])
        assert "stable_data" not in server.bodies[0]
        assert server.bodies[1]["stable_data"]["form"]["width_cm"] == FORM.width_cm


@pytest.mark.slow
@pytest.mark.ray
def test_it_works_within_a_ray_actor() -> None:
    import ray

    class Actor:
        def __init__(self, engine: HttpEngine) -> None:
            self.engine = engine

        async def complete(self, words: list[str]) -> list[str]:  # within the running loop of an asynchronous actor
            return [c.text for c in self.engine.complete([ask(w) for w in words])]

    with endpoint() as server:
        ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
        try:
            actor = ray.remote(Actor).remote(HttpEngine(server.settings()))
            words = [str(k) for k in range(50)]
            assert ray.get(actor.complete.remote(words)) == [f"echo {w}" for w in words]
        finally:
            ray.shutdown()
