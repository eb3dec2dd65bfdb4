"""An endpoint that is down, told from requests that fail alone, by one that really is."""

from typing import Any

import pytest

from models.semantic_reasoner.engines.http_engine import HttpEngine
from models.semantic_reasoner.engines.http_settings import HttpSettings
from tests.models.semantic_reasoner.engines.endpoint import Act, ask, closed_url, endpoint, error


def test_an_endpoint_that_is_down_is_every_requests_failure_and_no_exception() -> None:
    engine = HttpEngine(HttpSettings(closed_url(), "m", first_wait_s=0.001, tries=3))
    completions = engine.complete([ask(str(k)) for k in range(1000)])
    assert {c.code for c in completions} == {"endpoint_down"}
    assert "is it running" in completions[0].failure


def test_a_host_without_a_name_is_an_endpoint_that_is_down() -> None:
    (completion,) = HttpEngine(HttpSettings("http://no-such-host.invalid/v1", "m", tries=1)).complete([ask("x")])
    assert completion.code == "endpoint_down"


def test_few_requests_find_out_that_an_endpoint_is_down_and_the_next_that_it_is_back() -> None:
    up: list[bool] = []
    with endpoint(lambda *_: None if up else Act(drops=True)) as server:
        settings = server.settings(concurrency=4, tries=2, give_up_after=3, rest_s=0.0)
        engine = HttpEngine(HttpSettings(**{**_fields(settings), "rest_s": 60.0}))
        assert {c.code for c in engine.complete([ask(str(k)) for k in range(300)])} == {"endpoint_down"}
        # Eight threads; those that went in before the third failure have all of their tries.
        assert 3 * 2 <= server.tries.total() <= (8 + 3) * 2
        engine = HttpEngine(settings)  # rests for no time: one request looks whether it is back, others wait for it
        assert {c.code for c in engine.complete([ask(f"again {k}") for k in range(5)])} == {"endpoint_down"}
        up.append(True)
        requests = [ask(f"at last {k}") for k in range(50)]
        assert [c.text for c in engine.complete(requests)] == [f"echo at last {k}" for k in range(50)]


def _fields(settings: HttpSettings) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in HttpSettings.__dataclass_fields__}


def test_one_request_that_breaks_the_server_has_its_tries_and_the_others_go_on() -> None:
    with endpoint(lambda words, *_: Act(500, error("boom")) if words == "13" else None) as server:
        completions = HttpEngine(server.settings(tries=4)).complete([ask(str(k)) for k in range(40)])
        assert [k for k, c in enumerate(completions) if c.failure] == [13]
        assert completions[13].code == "endpoint_error"
        assert "boom" in completions[13].failure
        assert "after 4 tries" in completions[13].failure
        assert server.tries["13"] == 4
        assert server.tries.total() == 4 + 39 + 1  # one of the answered is asked again: is it the endpoint, or the request?


def test_requests_that_fail_alone_are_no_endpoint_that_is_down_however_many_they_are() -> None:
    """They end last and together, after all of their tries, so many more in a row than ``give_up_after``."""
    poison = {str(k) for k in range(0, 40, 4)}
    with endpoint(lambda words, *_: Act(500, error("boom")) if words in poison else None) as server:
        completions = HttpEngine(server.settings(give_up_after=2)).complete([ask(str(k)) for k in range(40)])
    assert {str(k): c.code for k, c in enumerate(completions) if c.failure} == dict.fromkeys(poison, "endpoint_error")


@pytest.mark.parametrize("death", [Act(503, error("no backend")), Act(after_s=1.0)], ids=["errors", "silence"])
def test_an_endpoint_that_dies_over_its_last_request_is_down(death: Act) -> None:
    """Fewer failures than ``give_up_after``: what it answered before says so, for it is not answered any more."""
    with endpoint(lambda words, *_: death if server.tries.total() > 3 else None) as server:
        engine = HttpEngine(server.settings(concurrency=1, tries=2, read_s=0.2))
        assert [c.code for k in range(4) for c in engine.complete([ask(str(k))])] == ["", "", "", "endpoint_down"]
        assert engine.complete([ask("more")])[0].code == "endpoint_down"
        assert server.tries["more"] == 0


def test_before_the_first_answer_failures_in_a_row_say_that_it_is_down() -> None:
    with endpoint(lambda *_: Act(500, error("boom"))) as server:
        engine = HttpEngine(server.settings(tries=1, give_up_after=2))
        (one,), (two,) = (engine.complete([ask(words)]) for words in "ab")
    assert (one.code, two.code) == ("endpoint_error", "endpoint_down")
    assert "2 in a row (give_up_after)" in two.failure
