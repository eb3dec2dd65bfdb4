"""An object store whose requests fail, are slow or are cut off at random: an S3 server behind a proxy, in a process of its own.

Which requests are hit follows from the seed and from the number of the request alone. What may happen to a request:

- failed: it is answered with status 500 or 503, or the connection is closed without an answer; the store never sees it.
- slow: it waits for one to five seconds.
- torn: the connection is cut in the middle of the body of the request, which the store then never sees; or in the middle of the
  answer, after the store has done what was asked.
"""

import multiprocessing
import random
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer
from typing import Any, Literal

import boto3

from benchmarks.faults.s3_server import s3_server, uri_of
from stable_data.atomic_files import write_file_atomically

BUCKET = "scenes"
_REFUSALS = ("500 Internal Server Error", "InternalError"), ("503 Slow Down", "SlowDown")
_SLOWEST_SECONDS = 5.0
_MOST_SECONDS = 120.0  # without a byte from a client or the server


@dataclass(frozen=True, slots=True)
class Rates:
    """How often requests are hit.

    Attributes:
        failed: Share of requests that fail.
        slow: Share of slow requests.
        torn: Share of requests that are cut off.
    """

    failed: float = 0.05
    slow: float = 0.02
    torn: float = 0.01


class FaultyStore:
    """A bucket on this machine that is kept in a folder from one session to the next.

    Args:
        folder: Folder of the objects; they are loaded now, and stored by :meth:`save`.
        seed: Chooses the requests that are hit.
        rates: How often they are.
    """

    def __init__(self, folder: Path, seed: int = 0, rates: Rates | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, folder, seed, rates or Rates()), daemon=True)
        self._process.start()
        theirs.close()
        self._place, self._proxy = self._pipe.recv()

    def uri(self, name: str) -> str:
        """The URI of a folder in the bucket whose requests are hit."""
        return uri_of(self._proxy, f"{BUCKET}/{name}")

    def calm_uri(self, name: str) -> str:
        """The URI of the same folder without faults."""
        return uri_of(self._place, f"{BUCKET}/{name}")

    def counts(self) -> dict[str, int]:
        """Number of requests, and of those that were hit, by kind."""
        return dict(self._asked("counts"))

    def save(self) -> None:
        """Stores all objects in the folder."""
        self._asked("save")

    def close(self) -> None:
        """Ends the store; what was not saved is lost."""
        with suppress(OSError, EOFError):
            self._asked("close")
        self._process.join()

    def _asked(self, what: Literal["counts", "save", "close"]) -> Any:
        self._pipe.send(what)
        return self._pipe.recv()


def _serve(pipe: Connection, folder: Path, seed: int, rates: Rates) -> None:
    """Runs the server and the proxy until ``close`` is asked for, or the other end of the pipe is gone."""
    with s3_server() as place:
        client = boto3.client(
            "s3",
            endpoint_url=f"http://{place}",
            region_name="us-east-1",
            aws_access_key_id="test",
            aws_secret_access_key="test",  # noqa: S106 - not secret
        )
        client.create_bucket(Bucket=BUCKET)
        saved = _loaded(client, folder)
        faults = _Faults(seed, rates)
        with _Proxy(place, faults) as proxy:
            threading.Thread(target=proxy.serve_forever, daemon=True).start()
            pipe.send((place, f"127.0.0.1:{proxy.server_address[1]}"))
            asked = ""
            with suppress(EOFError):
                while asked != "close":
                    asked = pipe.recv()
                    if asked == "save":
                        saved = _stored(client, folder, saved)
                    pipe.send(dict(faults.counts))
            proxy.shutdown()


def _loaded(client: Any, folder: Path) -> dict[str, str]:
    """Puts the objects of a folder into the bucket; returns their entity tags by key."""
    found = {}
    for path in sorted(folder.rglob("*")) if folder.is_dir() else ():
        if path.is_file():
            key = path.relative_to(folder).as_posix()
            found[key] = str(client.put_object(Bucket=BUCKET, Key=key, Body=path.read_bytes())["ETag"])
    return found


def _stored(client: Any, folder: Path, saved: Mapping[str, str]) -> dict[str, str]:
    """Stores the objects that have changed, and deletes those that are gone; returns the entity tags by key."""
    found: dict[str, str] = {}
    for page in client.get_paginator("list_objects_v2").paginate(Bucket=BUCKET):
        found |= {entry["Key"]: str(entry["ETag"]) for entry in page.get("Contents", ()) if not entry["Key"].endswith("/")}
    for key in (key for key, tag in found.items() if saved.get(key) != tag):
        (folder / key).parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(folder / key, client.get_object(Bucket=BUCKET, Key=key)["Body"].read())
    for key in saved.keys() - found.keys():
        (folder / key).unlink(missing_ok=True)
    return found


@dataclass(slots=True)
class _Faults:
    """What happens to which request."""

    seed: int
    rates: Rates
    counts: Counter[str] = field(default_factory=lambda: Counter(requests=0, failed=0, slow=0, torn=0))
    lock: threading.Lock = field(default_factory=threading.Lock)

    def next(self) -> tuple[str, random.Random]:
        """The fault of the next request, or an empty word, and what chooses its details."""
        with self.lock:
            rng = random.Random(f"{self.seed} {self.counts['requests']}")  # noqa: S311 - faults, not secrets
            self.counts["requests"] += 1
            drawn, kind = rng.random(), ""
            for name, share in (("failed", self.rates.failed), ("slow", self.rates.slow), ("torn", self.rates.torn)):
                if 0 <= drawn < share:
                    kind = name
                    self.counts[name] += 1
                drawn -= share
            return kind, rng


class _Proxy(ThreadingTCPServer):
    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 128

    def __init__(self, place: str, faults: _Faults) -> None:
        super().__init__(("127.0.0.1", 0), _Request)
        host, _, port = place.rpartition(":")
        self.place, self.faults = (host, int(port)), faults

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing: a client may leave."""


class _Request(StreamRequestHandler):
    """One request; the connection then ends."""

    timeout = _MOST_SECONDS
    server: _Proxy

    def handle(self) -> None:
        head = self._head()
        if not head:
            return
        kind, rng = self.server.faults.next()
        names = {line.partition(b":")[0].strip().lower(): line.partition(b":")[2].strip() for line in head[1:]}
        if names.get(b"expect", b"").lower() == b"100-continue":
            self.wfile.write(b"HTTP/1.1 100 Continue\r\n\r\n")
        length = int(names.get(b"content-length", 0))
        tears_request = kind == "torn" and rng.random() < 0.5 and length > 1
        if tears_request:
            self.rfile.read(length // 2)
            self._cut()
            return
        body = self._chunks() if names.get(b"transfer-encoding", b"").lower() == b"chunked" else self.rfile.read(length)
        if kind == "failed":
            self._refuse(rng, is_head=head[0].startswith(b"HEAD"))
            return
        if kind == "slow":
            time.sleep(rng.uniform(1.0, _SLOWEST_SECONDS))
        answer = self._answer(head, body)
        if kind == "torn":
            self.wfile.write(answer[: len(answer) // 2])
            self._cut()
        else:
            self.wfile.write(answer)

    def _head(self) -> list[bytes]:
        """The lines of the head, the first of which is the request; none if the client has left."""
        lines: list[bytes] = []
        while (line := self.rfile.readline()) not in (b"\r\n", b"\n", b""):
            lines.append(line.rstrip(b"\r\n"))
        return lines

    def _chunks(self) -> bytes:
        """A body in chunks, as it was sent."""
        found = b""
        while True:
            line = self.rfile.readline()
            size = int(line.partition(b";")[0], 16)
            found += line
            if size:
                found += self.rfile.read(size + 2)
                continue
            while line not in (b"\r\n", b""):  # the trailer
                line = self.rfile.readline()
                found += line
            return found

    def _answer(self, head: list[bytes], body: bytes) -> bytes:
        """The answer of the server, as a whole."""
        kept = [line for line in head if line.partition(b":")[0].lower() not in (b"connection", b"expect")]
        with socket.create_connection(self.server.place, timeout=_MOST_SECONDS) as upstream:
            upstream.sendall(b"\r\n".join([*kept, b"Connection: close", b"", b""]) + body)
            parts = []
            while part := upstream.recv(1 << 16):
                parts.append(part)
        return b"".join(parts)

    def _refuse(self, rng: random.Random, *, is_head: bool) -> None:
        choice = rng.randrange(len(_REFUSALS) + 1)
        if choice == len(_REFUSALS):
            self._cut()
            return
        status, code = _REFUSALS[choice]
        body = f"<?xml version='1.0'?><Error><Code>{code}</Code><Message>try again later</Message></Error>"
        head = f"HTTP/1.1 {status}\r\nContent-Type: application/xml\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        self.wfile.write((head + ("" if is_head else body)).encode())

    def _cut(self) -> None:
        """Resets the connection."""
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.close()
