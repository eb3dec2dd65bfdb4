"""A circuit breaker: when an endpoint is down, a few requests find it out with all of their tries, and the others are told."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

from models.semantic_reasoner.engines.protocol import Completion


class CircuitBreaker:
    """Lets requests through while the endpoint answers.

    After some failures in a row, whatever they were, or one that is known to be the endpoint's, the endpoint is held to be
    down and the breaker is open: every request gets the last failure at once, as ``endpoint_down``. When its rest is over, one
    request is let through, and those that come meanwhile wait for what becomes of it.

    Args:
        after: Failures in a row that open it.
        rest_s: How long it stays open, seconds.
        clock: Seconds that never go back.
    """

    def __init__(self, after: int, rest_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._after, self._rest, self._clock = after, rest_s, clock
        self._changed = threading.Condition()
        self._in_a_row, self._failure, self._until, self._is_probed = 0, Completion(""), 0.0, False

    def enter(self) -> Completion | None:
        """Asks to be let through.

        Returns:
            None: go on, and call :meth:`leave` or :meth:`withdraw` afterwards; else the failure to answer with.
        """
        with self._changed:
            while self._in_a_row >= self._after:
                if self._clock() < self._until:
                    return self._failure
                if not self._is_probed:
                    self._is_probed = True
                    return None
                self._changed.wait()
            return None

    def leave(self, failure: Completion | None, *, is_sure: bool = False) -> Completion | None:
        """Says what became of a request that was let through.

        Args:
            failure: What would be every other request's failure, too; None: the endpoint answers.
            is_sure: Whether that is known, and not only likely.

        Returns:
            The failure, as ``endpoint_down`` where the endpoint is held to be down now.
        """
        with self._changed:
            self._in_a_row = 0 if failure is None else max(self._in_a_row + 1, self._after * is_sure)
            if failure is not None:
                told = f"{failure.failure}; not asked again for {self._rest:g} s"
                self._failure = replace(failure, failure=told, code="endpoint_down")
                self._until = self._clock() + self._rest
            self._is_probed = False
            self._changed.notify_all()
            return failure if failure is None or self._in_a_row < self._after else replace(failure, code="endpoint_down")

    def withdraw(self) -> None:
        """Says that a request that was let through was given up before anything became of it."""
        with self._changed:
            self._is_probed = False
            self._changed.notify_all()
