"""The ``openai`` engine: any endpoint that speaks OpenAI's chat completions, asked by threads that share a pool of connections.

Every request is tried again, after waits that grow, while there is hope: too many requests, errors of the server, broken
connections, silence, answers that are no JSON. Only the host that the settings name is talked to: redirects are refused,
proxies and passwords of the environment are not looked at. The key is read from the environment and goes into one header and
nowhere else.
"""

import json
import math
import queue
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import urllib3
from urllib3.exceptions import HTTPError, ReadTimeoutError, SSLError

from models.semantic_reasoner.engines.chat_protocol import (
    COMPLETION_FAILED,
    SPELLINGS,
    Fields,
    completion_of,
    error_of,
    one_line,
    refused_field,
    request_body,
    tokens_of,
)
from models.semantic_reasoner.engines.circuit_breaker import CircuitBreaker
from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import OFF, Completion, Request, Sampling
from stable_data.content_id import content_id
from stable_data.errors import Notice

MAX_BYTES = 16 * 2**20
"""Longest answer."""

DOUBTFUL = ("endpoint_error", "endpoint_timeout")
"""Codes of failures that the endpoint may be to blame for, or one request alone that breaks it or takes too long."""

_DO = {
    "certificate_refused": "name the file of its authority in SSL_CERT_FILE, if that is trusted",
    "key_refused": "check the key ({key_variable}) and what it may use",
    "model_unknown": "check base_url, which mostly ends in /v1, and model",
    "quota_spent": "add credit or use another key",
    "redirect_refused": "set base_url to where the endpoint really is, if that is trusted",
    "request_refused": "change what the endpoint objects to",
    "endpoint_down": "is it running, and is base_url right?",
    "endpoint_error": "look at the endpoint's log",
    "endpoint_timeout": "raise read_s, or lower concurrency",
    "rate_limited": "lower concurrency, or raise tries and total_s",
    "abandoned": "ask again",
    "response_invalid": "is base_url that of an OpenAI-compatible endpoint?",
}
"""What to do, by code."""


@dataclass(frozen=True, slots=True)
class _Answer:
    """What came back for a try."""

    status: int
    headers: Mapping[str, str]
    body: Any


class _Hopeless(Exception):  # noqa: N818 - no error, but how a try ended
    """A request that failed for good."""

    def __init__(self, code: str, what: str) -> None:
        super().__init__(what)
        self.code, self.what = code, what


class _Hopeful(_Hopeless):
    """A try that failed; another may not."""

    def __init__(self, code: str, what: str, wait_s: float = 0.0) -> None:
        super().__init__(code, what)
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True)
class _Look:
    """When it was last known whether the endpoint answers, and whether it did."""

    at: float = -math.inf
    answers: bool = False


class HttpEngine:
    """Asks an OpenAI-compatible endpoint.

    An error of the server or silence may be the doing of one request. So the request that was answered last is asked again:
    where that is not answered either, the endpoint is down. While nothing has been answered yet, as many failures in a row as
    ``give_up_after`` say so.

    Args:
        settings: The endpoint.
        sampling: How it is to draw; ``top_k`` is no word of the protocol, see ``extra`` in the settings.

    Attributes:
        name: ``openai:<model>``, and a mark of ``extra`` where there is one. The host is left out, so that a cache outlives it.
        repeats: False: endpoints take a seed as a hint.
        notices: What the endpoint does not take, and was left out.

    Raises:
        ConfigError: The key is missing (``key_missing``).
    """

    repeats = False

    def __init__(self, settings: HttpSettings, sampling: Sampling | None = None) -> None:
        self.settings, self.sampling = settings, sampling or Sampling()
        self.name = f"openai:{settings.model}" + (f"+{content_id(settings.extra_fields())[:8]}" if settings.extra else "")
        self.notices: list[Notice] = []
        self._key = settings.read_key()
        self._url = f"{settings.base_url.rstrip('/')}/chat/completions"
        # A pool is of one host, so no other can be asked; threads that wait between tries need no connection.
        self._pool = urllib3.connection_from_url(settings.base_url, maxsize=settings.concurrency, block=False)
        self._slots = threading.BoundedSemaphore(settings.concurrency)
        self._breaker = CircuitBreaker(settings.give_up_after, settings.rest_s)
        self._answered: Request | None = None
        self._look, self._looking = _Look(), threading.Lock()
        self._spelt = {name: ways[0] for name, ways in SPELLINGS.items()}
        self._spelling = threading.Lock()

    def __reduce__(self) -> tuple[type["HttpEngine"], tuple[HttpSettings, Sampling]]:
        return type(self), (self.settings, self.sampling)  # in another process the key comes from its own environment

    def with_sampling(self, sampling: Sampling) -> "HttpEngine":
        """An engine of the same endpoint that draws otherwise."""
        return HttpEngine(self.settings, sampling)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order."""
        found = dict(self.as_completed(requests))
        return [found[k] for k in range(len(requests))]

    def as_completed(self, requests: Sequence[Request]) -> Iterator[tuple[int, Completion]]:
        """The completions as they come, each with the index of its request.

        Where the iterator is left before its end, requests that are not under way are not sent.
        """
        waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
        done: queue.SimpleQueue[tuple[int, Completion]] = queue.SimpleQueue()
        stopped = threading.Event()
        for index in range(len(requests)):
            waiting.put(index)

        def work() -> None:
            while not stopped.is_set():
                try:
                    index = waiting.get_nowait()
                except queue.Empty:
                    return
                done.put((index, self._complete_one(requests[index], stopped)))

        # Twice as many threads as slots: while some wait for their next try, others are sent.
        for _ in range(min(2 * self.settings.concurrency, len(requests))):
            threading.Thread(target=work, name=self.name, daemon=True).start()
        try:
            for _ in requests:
                yield done.get()
        finally:
            stopped.set()

    def _complete_one(self, request: Request, stopped: threading.Event) -> Completion:
        """Never raises, and tells the circuit breaker what became of the request."""
        if failure := self._breaker.enter():
            return failure
        try:
            completion = self._try(request, stopped)
        except Exception as error:  # noqa: BLE001 - what nobody foresaw is one request lost, the others go on
            self._breaker.withdraw()
            return self._failure("unexpected", f"unexpected {type(error).__name__}: {error}", "please report it")
        if completion.code == "abandoned":
            self._breaker.withdraw()
            return completion
        if completion.code in DOUBTFUL:
            answers = self._still_answers(stopped)
            if answers is None:
                hint = (
                    f"nothing was answered before; {self.settings.give_up_after} in a row (give_up_after) mean that it is down"
                )
                completion = replace(completion, failure=f"{completion.failure}; {hint}")
            return self._breaker.leave(None if answers else completion, is_sure=answers is False) or completion
        if not completion.failure:
            self._answered = request
        return self._breaker.leave(completion if completion.code in OFF else None) or completion

    def _still_answers(self, stopped: threading.Event) -> bool | None:
        """Whether the endpoint answers again what it answered last; None: it has answered nothing yet, or nobody waits for it.

        One thread asks; those whose requests have failed by the time that it knows take what it found.
        """
        failed_at = time.monotonic()
        with self._looking:
            if self._look.at > failed_at:
                return self._look.answers
            if self._answered is None:
                return None
            # Of another seed: what stands before the endpoint may keep answers and outlive it.
            code = self._try(replace(self._answered, seed=self._answered.seed + 1), stopped).code
            if code == "abandoned":
                return None
            self._look = _Look(time.monotonic(), code not in (*OFF, *DOUBTFUL))
            return self._look.answers

    def _try(self, request: Request, stopped: threading.Event) -> Completion:
        """Sends a request until it is answered, hopeless, or has used up its tries or its time."""
        s, until = self.settings, 0.0
        last = _Hopeless("abandoned", "nobody waits for it any more")
        for tried in range(1, s.tries + 1):
            try:
                with self._slots:
                    if stopped.is_set():
                        break
                    until = until or time.monotonic() + s.total_s  # waiting for the first slot is no fault of the endpoint
                    return self._send(request, until)
            except _Hopeful as miss:
                last = miss
                if tried == s.tries:
                    break
                longest = min(s.longest_wait_s, s.first_wait_s * 2.0 ** (tried - 1))
                wait = miss.wait_s + float(np.random.default_rng().uniform(0.0, s.first_wait_s if miss.wait_s else longest))
                if time.monotonic() + wait >= until:
                    asked = f"; it asks to wait {miss.wait_s:.0f} s" if miss.wait_s else ""
                    return self._failure(miss.code, f"{miss.what} (after {tried} tries, no time for more{asked})")
                if stopped.wait(wait):
                    last = _Hopeless("abandoned", f"nobody waits for it any more, after {miss.what}")
                    break
            except _Hopeless as miss:
                return self._failure(miss.code, miss.what)
        return self._failure(last.code, f"{last.what} (after {tried} tries)")

    def _failure(self, code: str, what: str, do: str = "") -> Completion:
        do = do or _DO[code].format(key_variable=self.settings.key_variable or "key_variable names none")
        return Completion("", failure=f"{self.name}: {self._url}: {one_line(self._without_key(what))}; {do}", code=code)

    def _without_key(self, words: str) -> str:
        return words.replace(self._key, "***") if self._key else words

    def _send(self, request: Request, until: float) -> Completion:
        """One try; a field that the endpoint does not take is said otherwise, from now on if that is what helped."""
        spelt, refused = dict(self._spelt), dict[str, str]()
        while True:
            body = request_body(self.settings.model, request, self.sampling, spelt, with_form=self.settings.sends_form)
            answer = self._post(body | self.settings.extra_fields(), until)
            if answer.status in (400, 422):
                error = error_of(answer.body)
                name = refused_field(error)
                if name and error["type"] != COMPLETION_FAILED and spelt[name] != SPELLINGS[name][-1]:
                    refused.setdefault(
                        name, f"does not take {spelt[name]} ({one_line(self._without_key(error['message']), 160)})"
                    )
                    spelt[name] = SPELLINGS[name][SPELLINGS[name].index(spelt[name]) + 1]
                    continue
            elif 200 <= answer.status < 300:
                self._remember({name: (spelt[name], why) for name, why in refused.items()})
            return self._completion(answer)

    def _remember(self, found: Mapping[str, tuple[str, str]]) -> None:
        """Keeps how fields are said from now on, and notes why, once."""
        with self._spelling:
            for name, (now, why) in found.items():
                if SPELLINGS[name].index(now) > SPELLINGS[name].index(self._spelt[name]):
                    self._spelt[name] = now
                    what = f"{name} is sent as {now} from now on" if now else f"{name} is left out from now on"
                    self.notices.append(Notice(self.name, "reason", f"{name}_refused", f"{self._url} {why}: {what}"))

    def _completion(self, answer: _Answer) -> Completion:
        """What an answer says.

        Raises:
            _Hopeless: It is a refusal.
            _Hopeful: It is a failure that may pass.
        """
        status = answer.status
        if 200 <= status < 300:
            try:
                completion = completion_of(answer.body, self.settings.prompt_price, self.settings.reply_price)
            except ValueError as flaw:
                raise _Hopeful("response_invalid", str(flaw)) from flaw
            return replace(completion, text=self._without_key(completion.text), failure=self._without_key(completion.failure))
        if 300 <= status < 400:
            raise _Hopeless(
                "redirect_refused", f"redirects to {urlsplit(answer.headers.get('location', '')).netloc or 'nowhere'}"
            )
        error = error_of(answer.body)
        what = f"status {status}" + (f" ({error['message']})" if error["message"] else "")
        if error["type"] == COMPLETION_FAILED:
            return Completion("", *tokens_of(answer.body), self._without_key(error["message"]), error["code"])
        if status == 429 and "insufficient_quota" in (error["code"], error["type"]):
            raise _Hopeless("quota_spent", what)
        if status in (408, 409, 429) or status >= 500:
            code = {408: "endpoint_timeout", 429: "rate_limited"}.get(status, "endpoint_error")
            raise _Hopeful(code, what, seconds_to_wait(answer.headers.get("retry-after", "")))
        raise _Hopeless({401: "key_refused", 403: "key_refused", 404: "model_unknown"}.get(status, "request_refused"), what)

    def _post(self, body: Fields, until: float) -> _Answer:
        """Sends a body once.

        Raises:
            _Hopeful: No answer came, or one that is no JSON.
            _Hopeless: The endpoint is not who it says it is.
        """
        headers = {"Content-Type": "application/json", "Accept": "application/json", "User-Agent": "stable-data"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        left = max(0.1, until - time.monotonic())
        timeout = urllib3.Timeout(connect=min(self.settings.connect_s, left), read=min(self.settings.read_s, left))
        try:
            response = self._pool.urlopen(
                "POST",
                urlsplit(self._url).path,
                json.dumps(body).encode(),
                headers,
                retries=False,
                redirect=False,
                timeout=timeout,
                preload_content=False,
            )
            content = _read(response, until)
        except ReadTimeoutError as error:
            raise _Hopeful("endpoint_timeout", f"silent for {timeout.read_timeout:g} s") from error
        except SSLError as error:
            if "CERTIFICATE_VERIFY_FAILED" in str(error):
                raise _Hopeless("certificate_refused", f"{error}") from error
            raise _Hopeful("endpoint_down", f"{type(error).__name__}: {error}") from error
        except (HTTPError, OSError) as error:
            raise _Hopeful("endpoint_down", f"{type(error).__name__}: {error}") from error
        try:
            return _Answer(response.status, response.headers, json.loads(content))
        except (ValueError, RecursionError) as error:
            if not 200 <= response.status < 300:  # servers on the way, such as gateways, answer errors in HTML
                return _Answer(response.status, response.headers, None)
            raise _Hopeful("response_invalid", f"answer is no JSON ({error})") from error


def _read(response: urllib3.BaseHTTPResponse, until: float) -> bytes:
    """The whole body; the connection goes back to its pool, or is closed where something went wrong."""
    content = b""
    try:
        while chunk := response.read1(2**16):  # what is there, so that a body that drips is seen to
            content += chunk
            if len(content) > MAX_BYTES:
                raise _Hopeful("response_invalid", f"answer has more than {MAX_BYTES:,} bytes")
            if time.monotonic() > until:
                raise _Hopeful("endpoint_timeout", "answer did not end in time")
    except BaseException:
        response.close()
        raise
    response.release_conn()
    return content


def seconds_to_wait(retry_after: str) -> float:
    """What a Retry-After header asks for, seconds: a number or a date; 0 where it is neither or in the past."""
    try:
        return max(0.0, float(int(retry_after)))
    except ValueError:
        pass
    try:
        date = parsedate_to_datetime(retry_after)
    except ValueError:
        return 0.0
    return max(0.0, (date.replace(tzinfo=date.tzinfo or UTC) - datetime.now(UTC)).total_seconds())
