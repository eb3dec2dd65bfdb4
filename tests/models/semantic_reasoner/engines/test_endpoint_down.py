"""An endpoint that is down, told from requests that fail alone by a question that is really asked."""

from dataclasses import replace

import pytest

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.openai_engine import OpenAIEngine
from tests.models.semantic_reasoner.engines.endpoint import Act, ask, closed_url, endpoint, error, no_waits


def test_an_endpoint_that_is_down_is_every_requests_failure_and_no_exception() -> None:
    with no_waits():
        completions = OpenAIEngine(HttpSettings(closed_url(), "m", tries=3)).complete([ask(str(k)) for k in range(1000)])
    assert {c.code for c in completions} == {"endpoint_down"}
    assert "is it running" in completions[0].failure
    assert "\n" not in completions[0].failure
    assert "not asked again for 60 s" in completions[-1].failure


def test_a_host_without_a_name_is_an_endpoint_that_is_down() -> None:
    (completion,) = OpenAIEngine(HttpSettings("http://no-such-host.invalid/v1", "m", tries=1)).complete([ask("x")])
    assert completion.code == "endpoint_down"


def test_few_requests_find_out_that_an_endpoint_is_down_and_the_next_that_it_is_back() -> None:
    up: list[bool] = []
    with endpoint(lambda *_: None if up else Act(drops=True)) as server:
        settings = server.settings(concurrency=4, tries=2)
        completions = OpenAIEngine(settings).complete([ask(str(k)) for k in range(300)])
        assert {c.code for c in completions} == {"endpoint_down"}
        # Four that were under way, and the questions that look: one for all that had failed by then.
        assert 2 + 2 <= server.tries.total() <= (4 + 4) * 2
        engine = OpenAIEngine(replace(settings, rest_s=0.0))
        assert {c.code for c in engine.complete([ask(f"again {k}") for k in range(5)])} == {"endpoint_down"}
        up.append(True)
        requests = [ask(f"at last {k}") for k in range(50)]
        assert [c.text for c in engine.complete(requests)] == [f"echo at last {k}" for k in range(50)]


@pytest.mark.parametrize(
    ("fault", "code", "words"),
    [
        (Act(500, error("boom")), "endpoint_error", "boom"),
        (Act(drops=True), "connection_failed", "is it running"),
        (Act(after_s=1.0), "endpoint_timeout", "read_s"),
    ],
    ids=["errors", "drops", "silence"],
)
def test_one_request_that_breaks_the_server_has_its_tries_and_the_others_go_on(fault: Act, code: str, words: str) -> None:
    with endpoint(lambda words, *_: fault if words == "13" else None) as server:
        completions = OpenAIEngine(server.settings(tries=4, read_s=0.5)).complete([ask(str(k)) for k in range(40)])
        assert [k for k, c in enumerate(completions) if c.failure] == [13]
        assert completions[13].code == code
        assert words in completions[13].failure
        assert server.tries["13"] == 4
        assert server.tries.total() == 4 + 39 + 1  # a question of another kind is asked: is it the endpoint, or the request?


def test_requests_that_fail_alone_are_no_endpoint_that_is_down_however_many_they_are() -> None:
    poison = {str(k) for k in range(0, 40, 4)}
    with endpoint(lambda words, *_: Act(500, error("boom")) if words in poison else None) as server:
        completions = OpenAIEngine(server.settings()).complete([ask(str(k)) for k in range(40)])
    assert {str(k): c.code for k, c in enumerate(completions) if c.failure} == dict.fromkeys(poison, "endpoint_error")


@pytest.mark.parametrize("death", [Act(503, error("no backend")), Act(after_s=1.0)], ids=["errors", "silence"])
def test_an_endpoint_that_dies_over_its_last_request_is_down(death: Act) -> None:
    with endpoint(lambda words, *_: death if server.tries.total() > 3 else None) as server:
        engine = OpenAIEngine(server.settings(concurrency=1, tries=2, read_s=0.2))
        assert [c.code for k in range(4) for c in engine.complete([ask(str(k))])] == ["", "", "", "endpoint_down"]
        assert engine.complete([ask("more")])[0].code == "endpoint_down"
        assert server.tries["more"] == 0


def test_a_spent_quota_is_every_requests_failure() -> None:
    with endpoint(lambda *_: Act(429, error("You exceeded your quota", code="insufficient_quota"))) as server:
        completions = OpenAIEngine(server.settings(concurrency=1)).complete([ask(str(k)) for k in range(9)])
        assert {c.code for c in completions} == {"quota_spent"}
        assert server.tries == {"0": 4}
    assert "add credit" in completions[0].failure
