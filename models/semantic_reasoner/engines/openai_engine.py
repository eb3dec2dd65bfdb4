"""The ``openai`` engine: sends requests to any endpoint of OpenAI's chat completions through the ``openai`` client.

The client retries requests, with growing waits or those that the endpoint requests, and reads proxies from the environment. The
engine refuses redirects, so that a request and its key reach no other host, and limits the number of concurrent requests.
"""

import asyncio
import base64
import math
import re
import secrets
import threading
import time
import weakref
from collections.abc import AsyncIterator, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import httpx2
import openai

from models.semantic_reasoner.engines.http_settings import CONNECT_SECONDS, HttpSettings
from models.semantic_reasoner.engines.protocol import OFF, Completion, Request, Sampling
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, one_line
from stable_data.limits import LIMITS, at_most
from stable_data.totals import total

AMBIGUOUS = ("connection_failed", "endpoint_error", "endpoint_timeout", "request_refused")
"""Codes of failures that either the endpoint or a single request may cause."""

_ADVICE = {
    "certificate_refused": "name the file of its authority in SSL_CERT_FILE, if that is trusted",
    "connection_failed": "is it running, and is base_url right?",
    "endpoint_error": "look at the endpoint's log",
    "endpoint_timeout": "raise read_s or total_s, or lower concurrency",
    "key_refused": "check the key ({key_variable}) and what it may use",
    "model_unknown": "check base_url, which usually ends in /v1, and model",
    "prompt_too_long": "shorten it, or use a model that reads more",
    "quota_spent": "add credit or use another key",
    "rate_limited": "lower concurrency, or raise tries",
    "redirect_refused": "set base_url to the endpoint's real address, if that is trusted",
    "request_refused": "null in extra leaves out a field that the endpoint does not accept",
    "response_invalid": "is base_url that of an OpenAI-compatible endpoint?",
    "unexpected": "please report it",
}
"""What to do, by code."""

_NO_SIGHT = ", or the model reads no pictures"  # a further cause of a refusal, if the request has some

_STATUSES = {401: "key_refused", 403: "key_refused", 404: "model_unknown", 408: "endpoint_timeout", 409: "endpoint_error"}
_LONE_SURROGATE = re.compile("[\ud800-\udfff]")


class OpenAIEngine:
    """An engine for OpenAI-compatible endpoints.

    A server error, a timeout, a broken connection or a refusal may be due to a single request. The engine then sends a short
    question. If that fails too, the endpoint is down, and all requests fail with the same message for ``rest_s``.

    Args:
        settings: The endpoint.
        sampling: How tokens are drawn; ``top_k`` is not a field of the protocol, see ``extra`` in the settings.

    Attributes:
        name: ``openai:<model>``, and a hash of ``extra`` if it is set. It has no host, so that a cache holds for other hosts.
        repeats: False: to endpoints a seed is a hint.

    Raises:
        ConfigError: The key is missing (``key_missing``), or the environment's proxies or certificates cannot be used
            (``config_invalid``).
    """

    repeats = False

    def __init__(self, settings: HttpSettings, sampling: Sampling | None = None) -> None:
        self.settings, self.sampling = settings, sampling or Sampling()
        self.name = f"openai:{settings.model}" + (f"+{content_id(settings.extra_fields())[:8]}" if settings.extra else "")
        self._key = settings.read_key()
        self._client = _client(settings, self._key)
        self._slots, self._probe_lock = asyncio.Semaphore(settings.concurrency), asyncio.Lock()
        self._last_probe, self._is_down = -math.inf, False
        self._off_completion, self._off_until = Completion(""), -math.inf
        self._loop = asyncio.new_event_loop()  # on its own thread, since the caller may run a loop itself
        threading.Thread(target=_run, args=(self._loop,), name=self.name, daemon=True).start()
        weakref.finalize(self, _close, self._loop, self._client)

    def __reduce__(self) -> tuple[type["OpenAIEngine"], tuple[HttpSettings, Sampling]]:
        return type(self), (self.settings, self.sampling)  # another process reads the key from its own environment

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order."""
        found = dict(self.as_completed(requests))
        return [found[k] for k in range(len(requests))]

    def as_completed(self, requests: Sequence[Request]) -> Iterator[tuple[int, Completion]]:
        """Yields the completions when they arrive, each with the index of its request.

        If the iterator is closed before its end, the other requests are cancelled.
        """
        futures = {asyncio.run_coroutine_threadsafe(self._answer(r), self._loop): k for k, r in enumerate(requests)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()

    async def _answer(self, request: Request) -> Completion:
        """Never raises; checks after a failure whether the endpoint is down."""
        async with self._slots:
            if time.monotonic() < self._off_until:
                return self._off_completion
            try:
                completion = await self._ask(request)
                if completion.code in AMBIGUOUS and await self._is_endpoint_down(request.form.binds):
                    failure = f"{completion.failure}; a short question was not answered either"
                    completion = replace(completion, failure=failure, code="endpoint_down")
            except Exception as error:  # noqa: BLE001 - one request fails, the others continue
                return self._failure("unexpected", f"unexpected {type(error).__name__}: {error}")
            if completion.code in OFF:
                self._off_completion = replace(
                    completion, failure=f"{completion.failure}; not asked again for {self.settings.rest_s:g} s"
                )
                self._off_until = time.monotonic() + self.settings.rest_s
            return completion

    async def _is_endpoint_down(self, binds: bool) -> bool:
        """Whether a short question is not answered; requests that failed before its answer share the result."""
        failed_at = time.monotonic()
        async with self._probe_lock:
            if self._last_probe < failed_at:
                # A random number, so that a cache in front of the endpoint cannot answer.
                words = f"Leave the table empty. This is question {secrets.randbelow(10**9)}."
                found = await self._ask(Request(({"role": "user", "content": words},), ReplyGrammar(100.0, 60.0, binds=binds)))
                self._last_probe, self._is_down = time.monotonic(), found.code in (*OFF, *AMBIGUOUS)
            return self._is_down

    async def _ask(self, request: Request) -> Completion:
        s, messages = self.settings, sent_messages(request)
        fields = request_fields(request, self.sampling) | s.extra_fields()
        sent_fields = {key: value for key, value in fields.items() if value is not None}
        try:
            async with asyncio.timeout(s.total_s):
                create = self._client.chat.completions.with_raw_response.create
                answer = (await create(model=s.model, messages=messages, extra_body=sent_fields)).http_response
        except TimeoutError:
            return self._failure("endpoint_timeout", f"no answer within {s.total_s:g} s")
        except _UnreadableAnswer as error:
            return self._failure("response_invalid", str(error))
        except openai.APIError as error:
            code, what = failure_reason(error)
            return self._failure(code, what, _NO_SIGHT if request.pictures and code == "request_refused" else "")
        try:
            found = completion_of(answer.json(), s.prompt_price, s.reply_price)
        except (ValueError, RecursionError) as error:
            return self._failure("response_invalid", f"answer is not a chat completion ({error})")
        return replace(found, text=self._without_key(found.text), failure=self._without_key(found.failure))

    def _failure(self, code: str, what: str, more: str = "") -> Completion:
        advice = _ADVICE[code].format(key_variable=self.settings.key_variable or "key_variable names none") + more
        line = f"{self.name}: {self.settings.base_url}: {first_line(self._without_key(what))}; {advice}"
        return Completion("", failure=line, code=code)

    def _without_key(self, words: str) -> str:
        return words.replace(self._key, "***") if self._key else words


def _client(settings: HttpSettings, key: str) -> openai.AsyncOpenAI:
    try:
        more: dict[str, Any] = {
            "timeout": openai.Timeout(settings.read_s, connect=CONNECT_SECONDS),
            "max_retries": settings.tries - 1,
            "default_headers": {"Accept-Encoding": "identity"},
            "http_client": openai.DefaultAsyncHttpxClient(follow_redirects=False, event_hooks={"response": [_bound_answer]}),
        }
        if version := settings.azure_api_version:
            return openai.AsyncAzureOpenAI(azure_endpoint=settings.base_url, api_version=version, api_key=key, **more)
        return openai.AsyncOpenAI(base_url=settings.base_url, api_key=key or "none", **more)
    except (ImportError, OSError, ValueError) as error:
        message = f"a client for {settings.base_url} cannot be made ({first_line(str(error))})"
        raise ConfigError(f"{message}; check the proxies and SSL_CERT_FILE of the environment", "config_invalid") from error


class _UnreadableAnswer(openai.OpenAIError):
    """An answer that is not read. The client passes this error on, and does not ask again."""


class _BoundedStream(httpx2.AsyncByteStream):
    """The body of an answer, up to the limit: an endpoint could send one without an end."""

    def __init__(self, stream: httpx2.AsyncByteStream) -> None:
        self._stream = stream

    async def __aiter__(self) -> AsyncIterator[bytes]:
        size = 0
        async for chunk in self._stream:
            size += len(chunk)
            if size > LIMITS.text.max_answer_bytes:
                raise _UnreadableAnswer(f"the answer is larger, expected {at_most(LIMITS.text, 'max_answer_bytes', 'bytes')}")
            yield chunk

    async def aclose(self) -> None:
        await self._stream.aclose()


async def _bound_answer(answer: httpx2.Response) -> None:
    """Bounds the body of an answer before it is read; nobody asked for a compressed one, which could become very large."""
    assert isinstance(answer.stream, httpx2.AsyncByteStream)
    answer.stream = _BoundedStream(answer.stream)
    if answer.headers.get("Content-Encoding", "identity") != "identity":
        raise _UnreadableAnswer("the answer is compressed, expected plain JSON")


def _run(loop: asyncio.AbstractEventLoop) -> None:
    loop.run_forever()
    loop.close()


def _close(loop: asyncio.AbstractEventLoop, client: openai.AsyncOpenAI) -> None:
    asyncio.run_coroutine_threadsafe(client.close(), loop).add_done_callback(lambda _: loop.call_soon_threadsafe(loop.stop))


def sent_messages(request: Request) -> list[Any]:
    """Returns the messages of a request as an endpoint expects them: pictures are data URLs in the first message of the user."""
    found: list[Any] = list(request.messages)
    if request.pictures:
        place = next(k for k, message in enumerate(request.messages) if message["role"] == "user")
        urls = (f"data:image/png;base64,{base64.b64encode(picture).decode()}" for picture in request.pictures)
        parts = [
            {"type": "text", "text": found[place]["content"]},
            *({"type": "image_url", "image_url": {"url": u}} for u in urls),
        ]
        found[place] = {**found[place], "content": parts}
    return found


def request_fields(request: Request, sampling: Sampling) -> dict[str, Any]:
    """Returns the fields of a request except ``model`` and ``messages``."""
    fields: dict[str, Any] = {
        "max_tokens": sampling.max_tokens,
        "temperature": sampling.temperature,
        "top_p": sampling.top_p,
        "seed": request.seed % 2**63,  # endpoints accept signed 64-bit integers
    }
    if request.form.binds:
        schema = {"name": request.form.name, "strict": True, "schema": request.form.schema()}
        fields["response_format"] = {"type": "json_schema", "json_schema": schema}
    return fields


def completion_of(answer: Any, prompt_price: float = 0.0, reply_price: float = 0.0) -> Completion:
    """Reads the completion from an answer with status 200.

    Args:
        answer: The JSON of the answer.
        prompt_price: Price of a million tokens read.
        reply_price: Price of a million tokens written.

    Returns:
        The completion; a cut, filtered, refused or empty reply is a failure, with its cost.

    Raises:
        ValueError: The answer is not a chat completion.
    """
    match answer:
        case {"choices": [{"message": {**message}, **choice}, *_]}:
            content: Any = message.get("content") or ""
        case _:
            raise ValueError("it has no choices[0].message")
    if not isinstance(content, str):
        raise ValueError(f"choices[0].message.content is {type(content).__name__}, expected text")
    text = _LONE_SURROGATE.sub("\ufffd", content)  # which UTF-8 cannot encode
    usage = answer.get("usage")
    counts = [usage.get(key) if isinstance(usage, dict) else None for key in ("prompt_tokens", "completion_tokens")]
    read, written = (c if type(c) is int and 0 <= c < 2**53 else None for c in counts)
    failure, code = "", ""
    if choice.get("finish_reason") == "length":
        failure, code = "reply was cut at max_tokens; raise it", "reply_cut"
    elif choice.get("finish_reason") == "content_filter":
        failure, code = "reply was held back by the endpoint's content filter; reword the instruction", "reply_filtered"
    elif refusal := message.get("refusal"):
        failure, code = f"model refused: {first_line(str(refusal))}; reword the instruction", "reply_refused"
    elif not text.strip():
        failure, code = "reply is empty; ask again with another seed", "reply_empty"
    priced = ((read, prompt_price), (written, reply_price))
    cost = total(0.0 if not price else None if count is None else count * price / 1e6 for count, price in priced)
    return Completion("" if failure else text, read, written, failure, code, cost=cost)


def failure_reason(error: openai.APIError) -> tuple[str, str]:
    """Returns the code of a failure and its description."""
    if not isinstance(error, openai.APIStatusError):
        cause = f"{type(error.__cause__).__name__}: {error.__cause__}"
        if isinstance(error, openai.APITimeoutError):
            return "endpoint_timeout", f"silent for too long ({cause})"
        return "certificate_refused" if "CERTIFICATE_VERIFY_FAILED" in cause else "connection_failed", cause
    status = error.status_code
    if 300 <= status < 400:
        return "redirect_refused", f"redirects to {urlsplit(error.response.headers.get('location', '')).netloc or 'nowhere'}"
    # Endpoints nest their messages differently.
    detail = (isinstance(error.body, dict) and (error.body.get("message") or error.body.get("detail"))) or error.body
    what = f"status {status} ({detail or error.message})"
    if status == 429:
        return "quota_spent" if "insufficient_quota" in (error.code, error.type) else "rate_limited", what
    if error.code == "context_length_exceeded":
        return "prompt_too_long", what
    return _STATUSES.get(status, "endpoint_error" if status >= 500 else "request_refused"), what


def first_line(words: str) -> str:
    """Returns text from outside as one line of at most 300 characters."""
    return one_line(" ".join(words.split())[:300])
