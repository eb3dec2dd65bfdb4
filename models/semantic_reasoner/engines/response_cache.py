"""Completions kept on disk, so that what an engine said once is what it says whenever it is asked the same again.

A completion is a file of its own, named by what it answers: many processes on many machines that share a file system write at
once without locks, a killed one leaves nothing but a file of no name that counts, and a broken file is one completion. Who
comes first stays: all get what lies on disk.
"""

import hashlib
import json
import os
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from models.semantic_reasoner.engines.protocol import Completion, Engine, Request, Sampling
from stable_data.errors import Notice, cannot_write

CACHE_VERSION = 1
"""Raised whenever keys or entries change: older ones are then not found."""

_MAX_BYTES = 64 * 2**20  # of an entry


@runtime_checkable
class StreamingEngine(Protocol):
    """An engine that tells of each completion as it comes, so that it can be kept before the others are done."""

    def as_completed(self, requests: Sequence[Request]) -> Iterator[tuple[int, Completion]]:
        """The completions as they come, each with the index of its request."""
        ...


class ResponseCache:
    """A folder of completions.

    Entries outlive a killed process; a power cut may cost those of the last seconds. Failures are not kept.

    Args:
        folder: Where they are; made if need be. File systems only, object stores are not.

    Attributes:
        notices: Entries that were broken, and those that could not be written.

    Raises:
        ConfigError: The folder cannot be made (``output_unwritable``).
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.notices: list[Notice] = []
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(str(self.folder), error) from error

    @staticmethod
    def key(engine: str, sampling: Sampling, request: Request) -> str:
        """What a completion is found by: 64 hex digits.

        Args:
            engine: Its name.
            sampling: How it draws.
            request: What it is asked; messages, form and seed count.
        """
        parts = [CACHE_VERSION, engine, asdict(sampling), list(request.messages), asdict(request.form), request.seed]
        return hashlib.sha256(json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

    def path(self, key: str) -> Path:
        """Where the entry of a key is, whether or not it is there."""
        return self.folder / key[:2] / f"{key}.json"

    def read(self, key: str) -> Completion | None:
        """The completion of a key; None where there is none, or a broken one, which is noted."""
        try:
            return self._load(key)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            message = f"{self.path(key)} cannot be used ({error}); the request is sent again"
            self.notices.append(Notice(key, "reason", "cache_entry_broken", message))
            return None

    def _load(self, key: str) -> Completion:
        with self.path(key).open("rb") as stream:
            return _completion(json.loads(stream.read(_MAX_BYTES)), key)

    def keep(self, key: str, completion: Completion) -> Completion:
        """Keeps a completion.

        Args:
            key: Its key.
            completion: It; a failure is not kept.

        Returns:
            What is kept under the key from now on: the completion, or what another process kept before.
        """
        if completion.failure:
            return completion
        path = self.path(key)
        aside = path.with_name(f".{key}.{uuid.uuid4().hex}")
        try:
            path.parent.mkdir(exist_ok=True)
            aside.write_bytes(_entry(key, completion))
            try:
                return self._put(aside, path, key, completion)
            finally:
                aside.unlink(missing_ok=True)
        except OSError as error:
            message = (
                f"{path} cannot be written ({error.strerror or error}); the completion is used, and paid for again next time"
            )
            self.notices.append(Notice(key, "reason", "cache_unwritable", message))
            return completion

    def _put(self, aside: Path, path: Path, key: str, completion: Completion) -> Completion:
        try:
            os.link(aside, path)  # whole or not at all, and never over what is there
        except OSError:  # something is there, or the file system has no links
            with suppress(OSError, ValueError, RecursionError):
                return replace(self._load(key), is_cached=False)  # this one was asked for nevertheless
            aside.replace(path)
        return completion


def _entry(key: str, c: Completion) -> bytes:
    fields = {"text": c.text, "prompt_tokens": c.prompt_tokens, "reply_tokens": c.reply_tokens, "cost": c.cost}
    return json.dumps({"key": key, "sum": _sum(fields), **fields}).encode()


def _sum(fields: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _completion(entry: Any, key: str) -> Completion:
    """The completion of an entry.

    Raises:
        ValueError: It is not what was written.
    """
    if not isinstance(entry, dict) or entry.pop("key", None) != key:
        raise ValueError("not an entry of this key")
    if entry.pop("sum", None) != _sum(entry):
        raise ValueError("its content was changed")
    return Completion(**entry, is_cached=True)


class CachedEngine:
    """An engine that is asked only what its cache does not know.

    Requests that are equal are asked once. Engines that tell of completions one by one have each kept as it comes, others have
    them kept when all are done.

    Args:
        engine: Any engine.
        cache: Where completions are kept.
        sampling: How the engine draws, a part of the key.

    Attributes:
        name: The engine's.
        repeats: True: what is kept is what is said.
        notices: Those of the cache.
    """

    repeats = True

    def __init__(self, engine: Engine, cache: ResponseCache, sampling: Sampling) -> None:
        self.name, self.engine, self.cache, self.sampling = engine.name, engine, cache, sampling
        self.notices = cache.notices

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion for each request, in their order.

        A replayed one has the tokens and the cost of the first time, so that rows are the same; ``is_cached`` says that they
        were not spent again.
        """
        keys = [self.cache.key(self.name, self.sampling, request) for request in requests]
        found = {key: self.cache.read(key) for key in keys}
        first: dict[str, int] = {}
        for k, key in enumerate(keys):
            if found[key] is None:
                first.setdefault(key, k)
        for key, completion in self._ask(list(first), [requests[k] for k in first.values()]):
            found[key] = self.cache.keep(key, completion)
        return [_again(found[key]) if first.get(key, k) != k else _known(found[key]) for k, key in enumerate(keys)]

    def _ask(self, keys: list[str], requests: list[Request]) -> Iterator[tuple[str, Completion]]:
        if not requests:
            return
        if isinstance(self.engine, StreamingEngine):
            for k, completion in self.engine.as_completed(requests):
                yield keys[k], completion
        else:
            yield from zip(keys, self.engine.complete(requests), strict=True)


def _known(completion: Completion | None) -> Completion:
    assert completion is not None
    return completion


def _again(completion: Completion | None) -> Completion:
    """Of a request that equals an earlier one of the same call: nothing was spent on it."""
    known = _known(completion)
    if known.failure:
        return replace(known, prompt_tokens=0, reply_tokens=0, cost=0.0)
    return replace(known, is_cached=True)
