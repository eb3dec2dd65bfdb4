"""An endpoint of chat completions that does what a test tells it to, and counts."""

import json
import socket
import struct
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from unittest.mock import patch

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Engine, Request
from models.semantic_reasoner.replies.grammar import ReplyGrammar

FORM = ReplyGrammar(120.0, 60.0)


def ask(words: str, seed: int = 0, form: ReplyGrammar = FORM) -> Request:
    return Request(({"role": "user", "content": words},), form, seed)


@dataclass(frozen=True)
class Act:
    """What a try gets: JSON (or other bytes) with a status, after a while; or no answer at all."""

    status: int = 200
    body: Any = None
    headers: Mapping[str, str] = field(default_factory=dict)
    after_s: float = 0.0
    drops: bool = False
    cuts: bool = False
    drips_s: float = 0.0


def words_of(content: Any) -> str:
    """The text of a message, without its pictures."""
    return content if isinstance(content, str) else "".join(part.get("text", "") for part in content)


def said(content: str | None, **more: Any) -> dict[str, Any]:
    """A chat completion."""
    choice = {"index": 0, "message": {"role": "assistant", "content": content}, "finish_reason": "stop"}
    return {"choices": [choice], "usage": {"prompt_tokens": 20, "completion_tokens": 5}, **more}


def error(message: str, **more: Any) -> dict[str, Any]:
    return {"error": {"message": message, **more}}


Plan = Callable[[str, int, dict[str, Any]], Act | None]
"""By the words of the last message, the number of the try (from 0) and the body; None: an echo."""


class Endpoint(ThreadingHTTPServer):
    daemon_threads, block_on_close, request_queue_size = True, False, 1024

    def __init__(self, plan: Plan) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.plan, self.lock = plan, threading.Lock()
        self.tries: Counter[str] = Counter()
        self.answered: Counter[str] = Counter()
        self.bodies: list[dict[str, Any]] = []
        self.headers: list[Message] = []
        self.paths: list[str] = []
        self.moments: dict[str, list[float]] = defaultdict(list)
        self.under_way = self.most_under_way = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1"

    def settings(self, **more: Any) -> HttpSettings:
        return HttpSettings(**{"base_url": self.url, "model": "m", "read_s": 20.0, "tries": 4, **more})

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class Handler(BaseHTTPRequestHandler):
    protocol_version, wbufsize, disable_nagle_algorithm = "HTTP/1.1", -1, True
    server: Endpoint

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        words = words_of(body["messages"][-1]["content"])
        s = self.server
        with s.lock:
            number = s.tries[words]
            s.tries[words] += 1
            s.bodies.append(body)
            s.headers.append(self.headers)
            s.paths.append(self.path)
            s.moments[words].append(time.monotonic())
            s.under_way += 1
            s.most_under_way = max(s.most_under_way, s.under_way)
        act = s.plan(words, number, body) or Act(body=said(f"echo {words}"))
        time.sleep(act.after_s)
        with s.lock:
            s.under_way -= 1
            s.answered[words] += act.status == 200 and not (act.drops or act.cuts) and isinstance(act.body, dict)
        self.answer(act)

    def answer(self, act: Act) -> None:
        if act.drops:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset
            self.close_connection = True
            return
        content = act.body if isinstance(act.body, bytes) else json.dumps(act.body).encode()
        self.send_response(act.status)
        for key, value in {"Content-Length": str(len(content)), **act.headers}.items():
            self.send_header(key, value)
        self.end_headers()
        if act.cuts:
            content, self.close_connection = content[: len(content) // 2], True
        step = 1 if act.drips_s else max(1, len(content))
        for at in range(0, len(content), step):
            self.wfile.write(content[at : at + step])
            self.wfile.flush()
            time.sleep(act.drips_s)

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def endpoint(plan: Plan = lambda words, number, body: None) -> Iterator[Endpoint]:
    server = Endpoint(plan)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        with no_waits():
            yield server
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def no_waits() -> Iterator[None]:
    """The client's own waits between tries are of milliseconds."""
    with patch("openai._base_client.INITIAL_RETRY_DELAY", 0.01), patch("openai._base_client.MAX_RETRY_DELAY", 0.05):
        yield


def answers_of(engine: Engine, form: ReplyGrammar = FORM) -> Plan:
    """A plan by which an engine answers, one request at a time, all in one form."""
    lock = threading.Lock()

    def plan(words: str, number: int, body: dict[str, Any]) -> Act:
        with lock:
            (found,) = engine.complete([Request(tuple(body["messages"]), form, body["seed"])])
        if found.code == "prompt_too_long":
            return Act(400, error(found.failure, code="context_length_exceeded"))
        usage = {"prompt_tokens": found.prompt_tokens, "completion_tokens": found.reply_tokens}
        answer = said(found.text, usage=usage)
        answer["choices"][0]["finish_reason"] = "length" if found.code == "reply_cut" else "stop"
        return Act(body=answer)

    return plan


def closed_url() -> str:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{s.getsockname()[1]}/v1"
