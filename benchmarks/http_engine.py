"""The openai engine against a slow server: ``python -m benchmarks.http_engine [--requests N] [--json FILE]``.

Answers of 50 ms show the limit of the engine itself, answers of 500 ms its behaviour with a server as fast as a language model.

The server is a separate process on this machine; it counts how often each request arrives and is answered. Its own limit is
measured in the same run, by a client that only writes the same bytes to as many sockets and reads the answers.
"""

import argparse
import asyncio
import json
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.openai_engine import OpenAIEngine, request_fields
from models.semantic_reasoner.engines.protocol import Request, Sampling
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.prompt import ReasonerQuestion, messages
from stable_data.scene import Stage, Tabletop, TaskInfo

ANSWERS_S = (0.05, 0.5)
"""Durations of an answer, seconds."""

FAULTS = (b"too many", b"error", b"dropped", b"cut")
"""The faults of the first tries of a tenth of the requests, each equally often."""

_NUMBER = re.compile(rb"request (\d+) ")
_TABLE = Tabletop("desk", (1.2, 0.6))


@dataclass(frozen=True, slots=True)
class EndpointFigure:
    """The figures of one load.

    Attributes:
        answer_s: Duration of an answer, seconds.
        concurrency: Concurrent requests.
        faults: Share of the requests whose first try fails.
        requests: Number of requests.
        seconds: Time until the last completion.
        requests_per_second: Requests divided by seconds.
        tries_per_second: The same with faults and second tries.
        limit_per_second: The server's own limit, without faults.
        share: Tries a second divided by that limit.
        lost: Requests without their own reply, over all rounds.
        doubled: Requests that were answered more than once, over all rounds.
        milliseconds_of_processor: Processor time of the client for a request.
    """

    answer_s: float
    concurrency: int
    faults: float
    requests: int
    seconds: float
    requests_per_second: float
    tries_per_second: float
    limit_per_second: float
    share: float
    lost: int
    doubled: int
    milliseconds_of_processor: float


# --- the server ---------------------------------------------------------------------------------------------------------------


class Server:
    """Answers chat completions after a delay; the number of a request decides whether its first try fails."""

    def __init__(self, faults: float, answer_s: float) -> None:
        self.answer_s = answer_s
        self.every = round(len(FAULTS) / faults) if faults else 0
        self.tries: Counter[bytes] = Counter()
        self.answered: Counter[bytes] = Counter()

    async def talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serves one connection."""
        try:
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                if head.startswith(b"GET"):  # the counts; the next load starts at 0
                    doubled = sum(n > 1 for n in self.answered.values())
                    writer.write(_http(200, json.dumps([self.tries.total(), len(self.answered), doubled]).encode()))
                    self.tries.clear()
                    self.answered.clear()
                    continue
                body = await reader.readexactly(int(_length(head)))
                found = _NUMBER.search(body)
                assert found
                await asyncio.sleep(self.answer_s)
                if not self._answer(writer, found[1]):
                    break
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        writer.close()

    def _answer(self, writer: asyncio.StreamWriter, number: bytes) -> bool:
        """Writes an answer or a fault; returns whether the connection stays open."""
        self.tries[number] += 1
        kind = int(number) % self.every if self.every and self.tries[number] == 1 else len(FAULTS)
        fault = FAULTS[kind] if kind < len(FAULTS) else b""
        reply = json.dumps({"objects": [], "request": int(number), "more": "x" * 1500})
        choice = {"index": 0, "message": {"role": "assistant", "content": reply}, "finish_reason": "stop"}
        answer = json.dumps({"choices": [choice], "usage": {"prompt_tokens": 400, "completion_tokens": 500}}).encode()
        self.answered[number] += not fault
        if fault == b"dropped":
            return False
        if fault == b"cut":
            writer.write(_http(200, answer)[:-1000])
            return False
        faulty = {b"too many": _http(429, b"{}"), b"error": _http(500, b"oops")}
        writer.write(faulty.get(fault) or _http(200, answer))
        return True


def _length(head: bytes) -> bytes:
    found = re.search(rb"content-length: *(\d+)", head, re.IGNORECASE)
    assert found
    return found[1]


def _http(status: int, body: bytes) -> bytes:
    return b"HTTP/1.1 %d -\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n%s" % (status, len(body), body)


async def run_server(faults: float, answer_s: float) -> None:
    """Prints its port, then serves until it is killed."""
    server = await asyncio.start_server(Server(faults, answer_s).talk, "127.0.0.1", 0, backlog=2048)
    print(server.sockets[0].getsockname()[1], flush=True)
    await server.serve_forever()


@contextmanager
def served(faults: float, answer_s: float) -> Iterator[int]:
    """Runs a server in its own process, and gives its port."""
    command = [sys.executable, "-m", "benchmarks.http_engine", "--serve", str(faults), str(answer_s)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline())
        finally:
            process.kill()


# --- the clients --------------------------------------------------------------------------------------------------------------


def requests_to_send(number: int) -> list[Request]:
    """Returns requests about as long as those of the second stage."""
    form = ReplyGrammar.of_table(_TABLE)
    details = TaskInfo("y" * 800, "")
    texts = [f"request {k} is to make tea for three" for k in range(number)]
    return [Request(tuple(messages(ReasonerQuestion(text, _TABLE, Stage.TASK, details=details))), form) for text in texts]


async def bare(port: int, contents: list[bytes], concurrency: int) -> float:
    """Measures the requests a second of a client that only writes and reads."""
    waiting = iter(contents)

    async def work() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        for content in waiting:
            writer.write(content)
            head = await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(int(_length(head)))
        writer.close()

    start = time.perf_counter()
    await asyncio.gather(*(work() for _ in range(concurrency)))
    return len(contents) / (time.perf_counter() - start)


async def counts(port: int) -> tuple[int, int, int]:
    """Reads the server's counts since the last call: tries, answered requests, and requests answered more than once."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET /counts HTTP/1.1\r\n\r\n")
    tries, answered, doubled = json.loads(await reader.readexactly(int(_length(await reader.readuntil(b"\r\n\r\n")))))
    writer.close()
    return tries, answered, doubled


def ask(port: int, requests: list[Request], concurrency: int) -> tuple[float, float, int, int, int]:
    """Sends all requests once.

    Returns:
        Seconds, processor seconds of this process, tries, and the numbers of lost and doubled requests.
    """
    engine = OpenAIEngine(HttpSettings(f"http://127.0.0.1:{port}/v1", "m", concurrency=concurrency))
    engine.complete(requests[:1])
    asyncio.run(counts(port))
    start, processor = time.perf_counter(), time.process_time()
    completions = engine.complete(requests)
    seconds, processor = time.perf_counter() - start, time.process_time() - processor
    tries, answered, doubled = asyncio.run(counts(port))
    lost = sum(bool(c.failure) or json.loads(c.text)["request"] != k for k, c in enumerate(completions))
    assert lost or answered == len(requests), f"{answered} of {len(requests)} were answered"
    return seconds, processor, tries, lost, doubled


def measure(answer_s: float, concurrency: int, faults: float, requests: list[Request], rounds: int) -> EndpointFigure:
    """Measures one load: the best rounds of the bare client and of the engine, in turns."""
    bodies = [json.dumps({"messages": r.messages, "model": "m", **request_fields(r, Sampling())}).encode() for r in requests]
    contents = [b"POST /v1 HTTP/1.1\r\nContent-Length: %d\r\n\r\n%s" % (len(b), b) for b in bodies]
    limit, asked = 0.0, []
    with served(0.0, answer_s) as whole, served(faults, answer_s) as faulty:
        for _ in range(rounds):
            limit = max(limit, asyncio.run(bare(whole, contents, concurrency)))
            asked.append(ask(faulty, requests, concurrency))
    seconds, processor, tries, _, _ = min(asked)
    return EndpointFigure(
        answer_s=answer_s,
        concurrency=concurrency,
        faults=faults,
        requests=len(requests),
        seconds=round(seconds, 3),
        requests_per_second=round(len(requests) / seconds, 1),
        tries_per_second=round(tries / seconds, 1),
        limit_per_second=round(limit, 1),
        share=round(tries / seconds / limit, 3),
        lost=sum(lost for *_, lost, _ in asked),
        doubled=sum(doubled for *_, doubled in asked),
        milliseconds_of_processor=round(1e3 * processor / len(requests), 3),
    )


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=2000)
    parser.add_argument(
        "--rounds", type=int, default=3, help="rounds of each load; the best is shown, lost and doubled are summed"
    )
    parser.add_argument("--concurrency", type=int, nargs="+", default=[32, 200])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--serve",
        type=float,
        nargs=2,
        help="run as the server, with this share of faults and this duration of answers, seconds",
    )
    arguments = parser.parse_args()
    if arguments.serve is not None:
        asyncio.run(run_server(*arguments.serve))
    requests = requests_to_send(arguments.requests)
    short, long = ANSWERS_S
    # Long answers with low concurrency would take minutes.
    widths = [*((short, c) for c in arguments.concurrency), (long, max(arguments.concurrency))]
    loads = [(answer_s, at_once, faults) for answer_s, at_once in widths for faults in (0.0, 0.1)]
    figures = [measure(*load, requests, arguments.rounds) for load in loads]
    heads = ("answer s", "at once", "faults", "requests/s", "tries/s", "limit/s", "share", "lost", "doubled", "ms")
    print("".join(f"{head:>11}" for head in heads))
    for f in figures:
        rates = "".join(f"{rate:11.1f}" for rate in (f.requests_per_second, f.tries_per_second, f.limit_per_second))
        print(
            f"{f.answer_s:11}{f.concurrency:11}{f.faults:11.0%}{rates}{f.share:11.1%}{f.lost:11}{f.doubled:11}"
            f"{f.milliseconds_of_processor:11.3f}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(f) for f in figures], indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
