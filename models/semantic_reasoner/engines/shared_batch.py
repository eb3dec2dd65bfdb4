"""A running batch that requests of several threads enter as places become free."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from models.semantic_reasoner.engines.protocol import Completion, Request


class RunningBatch(Protocol):
    """Requests that are completed step by step."""

    @property
    def is_busy(self) -> bool:
        """Whether requests are open."""
        ...

    def add(self, number: int, request: Request) -> None:
        """Adds a request, which begins when there is a place."""
        ...

    def advance(self) -> list[tuple[int, Completion]]:
        """Makes one step and returns the completions that it ends, each with the number of its request."""
        ...


class SharedBatch:
    """Completes the requests of several threads in one running batch; a thread makes its steps while requests are open.

    Args:
        new_batch: Makes an empty batch. The memory of a batch is free again when no request is open.
    """

    def __init__(self, new_batch: Callable[[], RunningBatch]) -> None:
        self._new_batch = new_batch
        self._arrived: list[tuple[Request, Future[Completion]]] = []
        self._lock, self._is_running = threading.Lock(), False

    def submit(self, request: Request) -> Future[Completion]:
        """Adds a request; if all open ones are cancelled, their batch is given up."""
        future: Future[Completion] = Future()
        with self._lock:
            self._arrived.append((request, future))
            if not self._is_running:
                self._is_running = True
                threading.Thread(target=self._run, name="shared batch").start()
        return future

    def _run(self) -> None:
        open_: dict[int, Future[Completion]] = {}
        try:
            batch, count = self._new_batch(), 0
            while True:
                if open_ and all(future.cancelled() for future in open_.values()):
                    batch, open_ = self._new_batch(), {}
                with self._lock:
                    arrived, self._arrived = self._arrived, []
                    if not (arrived or batch.is_busy):
                        self._is_running = False
                        return
                for request, future in arrived:
                    open_[count] = future
                    batch.add(count, request)
                    count += 1
                for number, completion in batch.advance():
                    _give(open_.pop(number), completion)
        except BaseException as error:  # noqa: BLE001 - the threads that wait raise it
            with self._lock:
                arrived, self._arrived, self._is_running = self._arrived, [], False
            for future in (*open_.values(), *(future for _, future in arrived)):
                _give(future, error)


def _give(future: Future[Completion], found: Completion | BaseException) -> None:
    if not future.set_running_or_notify_cancel():
        return
    if isinstance(found, BaseException):
        future.set_exception(found)
    else:
        future.set_result(found)
