"""A small server that puts any engine behind ``/v1/chat/completions``: one model for many processes, and an endpoint for tests.

Requests that come together are answered in one batch. Replies have the form that the request carries in our own field; without
it, as near as its schema tells (:func:`.chat_protocol.request_of`). It knows no keys: it is for this machine.

``python -m models.semantic_reasoner.engines.chat_server --engine embedded --port 8000`` serves one until it is interrupted
(docs/propose.md).
"""

import json
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from typing import Annotated, Any, Protocol, runtime_checkable

import typer

from models.semantic_reasoner.engines.chat_protocol import answer_body, error_body, one_line, request_of
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Completion, Engine, Request, Sampling
from models.semantic_reasoner.engines.registry import EngineSettings, load_engine
from stable_data.cli import with_clear_errors
from stable_data.errors import ConfigError

MAX_BYTES = 4 * 2**20
"""Longest request."""

_CLOSED = Completion("", failure="server is closing; ask again", code="server_closing")


@runtime_checkable
class Resampling(Protocol):
    """An engine that can draw otherwise than it was made to."""

    def with_sampling(self, sampling: Sampling) -> Engine:
        """The same engine with other draws."""
        ...


@dataclass(slots=True)
class _Waiting:
    """A request that waits for its batch."""

    request: Request
    sampling: Sampling
    answered: threading.Event = field(default_factory=threading.Event)
    completion: Completion = _CLOSED


class Batcher:
    """Collects requests of many threads and has an engine answer them together, on a thread of its own.

    Args:
        engine: The engine; one that has ``with_sampling`` draws as each request asks, another as it was made to.
        sampling: How it draws where a request does not say.
        most: Largest batch.
        wait_s: How long the first request of a batch waits for others, seconds.

    Attributes:
        sizes: Of the batches so far.
    """

    def __init__(self, engine: Engine, sampling: Sampling, most: int, wait_s: float) -> None:
        self.engine, self.sampling, self.most, self.wait_s = engine, sampling, most, wait_s
        self.sizes: list[int] = []
        self._engines: dict[Sampling, Engine] = {}
        self._queue: queue.SimpleQueue[_Waiting | None] = queue.SimpleQueue()
        self._lock, self._is_closed = threading.Lock(), False
        self._thread = threading.Thread(target=self._run, name="batches", daemon=True)
        self._thread.start()

    def complete(self, request: Request, sampling: Sampling) -> Completion:
        """The completion of a request, when its batch is done."""
        waiting = _Waiting(request, sampling if isinstance(self.engine, Resampling) else self.sampling)
        with self._lock:
            if self._is_closed:
                return _CLOSED
            self._queue.put(waiting)
        waiting.answered.wait()
        return waiting.completion

    def close(self) -> None:
        """Answers what waits, and ends."""
        with self._lock:
            self._is_closed = True
            self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        is_open = True
        while is_open:
            batch: list[_Waiting] = []
            until = float("inf")
            while len(batch) < self.most:
                try:
                    waiting = self._queue.get(timeout=max(0.0, until - time.monotonic()) if batch else None)
                except queue.Empty:
                    break
                if waiting is None:
                    is_open = False
                    break
                until = min(until, time.monotonic() + self.wait_s)
                batch.append(waiting)
            for sampling in dict.fromkeys(w.sampling for w in batch):
                self._answer([w for w in batch if w.sampling == sampling], sampling)

    def _answer(self, batch: list[_Waiting], sampling: Sampling) -> None:
        self.sizes.append(len(batch))
        try:
            completions: Sequence[Completion] = self._engine(sampling).complete([w.request for w in batch])
            assert len(completions) == len(batch), f"{len(completions)} completions of {len(batch)} requests"
        except Exception as error:  # noqa: BLE001 - what nobody foresaw is one batch lost, not the server
            failed = Completion("", failure=one_line(f"unexpected {type(error).__name__}: {error}"), code="unexpected")
            completions = [failed] * len(batch)
        for waiting, completion in zip(batch, completions, strict=True):
            waiting.completion = completion
            waiting.answered.set()

    def _engine(self, sampling: Sampling) -> Engine:
        if sampling == self.sampling or not isinstance(self.engine, Resampling):
            return self.engine
        if sampling not in self._engines:
            self._engines[sampling] = self.engine.with_sampling(sampling)
        return self._engines[sampling]


class ChatServer(ThreadingHTTPServer):
    """The server; :func:`serve` starts it.

    Attributes:
        batcher: What answers.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 1024

    def __init__(self, address: tuple[str, int], batcher: Batcher) -> None:
        super().__init__(address, _Handler)
        self.batcher, self.numbers = batcher, count()

    @property
    def url(self) -> str:
        """What clients take as their base URL."""
        return f"http://{self.server_address[0]!s}:{self.server_address[1]}/v1"

    @property
    def model(self) -> str:
        """Name under which the engine is served."""
        return self.batcher.engine.name

    def settings(self, **more: Any) -> HttpSettings:
        """Settings of a client of this server."""
        return HttpSettings(self.url, self.model, **{"sends_form": True, **more})

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away or fell silent is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


@contextmanager
def serve(
    engine: Engine,
    host: str = "127.0.0.1",
    port: int = 0,
    *,
    sampling: Sampling | None = None,
    max_batch: int = 64,
    max_wait_s: float = 0.01,
) -> Iterator[ChatServer]:
    """Serves an engine while the context is open.

    Args:
        engine: The engine.
        host: Address to listen on. Whoever reaches it may ask, so another than this machine's own is for networks that you
            trust.
        port: 0 takes a free one; see ``url`` of what is given.
        sampling: How the engine draws where a request does not say; the defaults, if None.
        max_batch: Largest batch.
        max_wait_s: How long a request waits for others to share its batch, seconds.

    Yields:
        The server.

    Raises:
        ConfigError: The address cannot be had (``address_unusable``).
    """
    batcher = Batcher(engine, sampling or Sampling(), max_batch, max_wait_s)
    try:
        server = ChatServer((host, port), batcher)
    except OSError as error:
        batcher.close()
        message = f"{host}:{port} cannot be listened on ({error.strerror or error}); choose another address, or port 0"
        raise ConfigError(message, "address_unusable") from error
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), name="chat_server", daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        batcher.close()


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "stable-data", ""
    wbufsize = -1  # an answer leaves in one piece: in several, the other side's delayed acknowledgements would hold it up
    disable_nagle_algorithm = True
    timeout = 300.0  # of a client that says nothing, seconds
    server: ChatServer

    def do_GET(self) -> None:
        """``/v1/models``."""
        if self.path != "/v1/models":
            return self._say(404, error_body(f"{self.path} is not served, expected /v1/models", "not_found", "not_found"))
        model = {"id": self.server.model, "object": "model", "created": 0, "owned_by": "stable-data"}
        return self._say(200, {"object": "list", "data": [model]})

    def do_POST(self) -> None:
        """``/v1/chat/completions``."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MAX_BYTES:
            self.close_connection = True  # the body is not read
            what = f"expected a Content-Length of at most {MAX_BYTES:,}"
            return self._say(413, error_body(what, "invalid_request_error", "request_too_long"))
        content = self.rfile.read(int(length))
        if self.path != "/v1/chat/completions":
            what = f"{self.path} is not served, expected /v1/chat/completions"
            return self._say(404, error_body(what, "not_found", "not_found"))
        try:
            body = json.loads(content)
            request, sampling = request_of(body, self.server.batcher.sampling)
        except (ValueError, RecursionError) as error:
            return self._say(400, error_body(one_line(str(error)), "invalid_request_error", "request_invalid"))
        if body.get("model") != self.server.model:
            what = f"model {body.get('model')!r:.80} is not served, expected {self.server.model}"
            return self._say(404, error_body(what, "invalid_request_error", "model_not_found"))
        completion = self.server.batcher.complete(request, sampling)
        if completion is _CLOSED:
            self.close_connection = True
            return self._say(503, error_body(completion.failure, "server_error", completion.code))
        answer = answer_body(completion, self.server.model, next(self.server.numbers), int(time.time()))
        return self._say(422 if completion.failure else 200, answer)

    def _say(self, status: int, body: dict[str, Any]) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Says nothing: prompts are nobody's business, and tests are quiet."""


@with_clear_errors
def main(
    engine: Annotated[
        str, typer.Option(help="embedded, transformers:FOLDER, vllm:FOLDER, openai:MODEL or scripted:FILE.")
    ] = "embedded",
    host: Annotated[
        str, typer.Option(help="Address to listen on; whoever reaches it may ask, so another only in a network that you trust.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0 takes a free one.")] = 8000,
    temperature: Annotated[float, typer.Option(help="Of the draws of a model in this process.")] = Sampling().temperature,
    max_tokens: Annotated[int, typer.Option(help="Longest reply.")] = Sampling().max_tokens,
    max_batch: Annotated[int, typer.Option(help="Most requests that are answered together.")] = 64,
    max_wait_ms: Annotated[float, typer.Option(help="How long a request waits for others to share its batch.")] = 10.0,
    base_url: Annotated[str, typer.Option(help="Of the endpoint behind openai:MODEL.")] = "",
    cache: Annotated[str, typer.Option(help="Folder that keeps completions; empty keeps none.")] = "",
) -> None:
    """Serves one engine to many processes until it is interrupted.

    Status 0: interrupted. 2: could not start.
    """
    if max_batch < 1 or max_wait_ms < 0 or not 0 <= port < 65536:
        found = f"max-batch is {max_batch}, max-wait-ms {max_wait_ms}, port {port}"
        raise ConfigError(f"{found}, expected at least 1, at least 0, and 0 to 65535", "config_invalid")
    sampling = Sampling(temperature=temperature, max_tokens=max_tokens)
    chosen = EngineSettings(engine, sampling, num_slots=max_batch, cache=cache)
    loaded = load_engine(replace(chosen, http=HttpSettings(base_url, "default")) if base_url else chosen)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    with serve(loaded, host, port, sampling=sampling, max_batch=max_batch, max_wait_s=max_wait_ms / 1000) as server:
        typer.echo(
            f"{server.url} serves {server.model}: --engine openai:{server.model} --set engine.http.base_url={server.url} "
            "--set engine.http.sends_form=true"
        )
        sys.stdout.flush()
        stopped.wait()


if __name__ == "__main__":
    typer.run(main)
