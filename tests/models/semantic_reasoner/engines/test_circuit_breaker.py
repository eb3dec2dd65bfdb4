"""The circuit breaker, by a clock of the test."""

import threading

from models.semantic_reasoner.engines.circuit_breaker import CircuitBreaker
from models.semantic_reasoner.engines.protocol import Completion

DOWN = Completion("", failure="down", code="endpoint_down")


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def opened(clock: Clock) -> CircuitBreaker:
    breaker = CircuitBreaker(3, 10.0, clock)
    for _ in range(3):
        assert breaker.enter() is None
        breaker.leave(DOWN)
    return breaker


def test_failures_in_a_row_open_it_and_the_failure_is_everyones() -> None:
    told = opened(Clock()).enter()
    assert told is not None
    assert told.code == "endpoint_down"
    assert told.failure == "down; not asked again for 10 s"


def test_whatever_the_failures_were_the_endpoint_is_down_then() -> None:
    breaker = CircuitBreaker(2, 10.0, Clock())
    found = []
    for code in ("endpoint_timeout", "endpoint_error"):
        assert breaker.enter() is None
        found.append(breaker.leave(Completion("", failure=code, code=code)))
    assert [c and (c.failure, c.code) for c in found] == [
        ("endpoint_timeout", "endpoint_timeout"),
        ("endpoint_error", "endpoint_down"),
    ]
    told = breaker.enter()
    assert told is not None
    assert (told.failure, told.code) == ("endpoint_error; not asked again for 10 s", "endpoint_down")


def test_an_answer_in_between_keeps_it_closed() -> None:
    breaker = CircuitBreaker(3, 10.0, Clock())
    for outcome in (DOWN, DOWN, None, DOWN, DOWN):
        assert breaker.enter() is None
        breaker.leave(outcome)
    assert breaker.enter() is None


def test_after_its_rest_one_looks_and_the_others_wait_for_what_it_finds() -> None:
    for found in (None, DOWN):
        clock = Clock()
        breaker = opened(clock)
        clock.now = 10.0
        assert breaker.enter() is None
        others: list[Completion | None] = []
        threads = [threading.Thread(target=lambda b=breaker, o=others: o.append(b.enter())) for _ in range(4)]
        for thread in threads:
            thread.start()
        threads[0].join(0.05)
        assert not others
        breaker.leave(found)
        for thread in threads:
            thread.join()
        assert len(others) == 4
        assert {o is None for o in others} == {found is None}


def test_who_looked_and_gave_up_lets_another_look() -> None:
    clock = Clock()
    breaker = opened(clock)
    clock.now = 11.0
    assert breaker.enter() is None
    breaker.withdraw()
    assert breaker.enter() is None
