"""A cache of completions on disk, so that the same request always has the same completion.

Each completion is a file, named by a hash of its request. Processes on several machines that share a file system write without
locks; a killed process leaves only a temporary file, and a broken file loses one completion. The first writer of an entry wins:
all others read its completion.
"""

import hashlib
import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import NoneType
from typing import Any, Protocol, runtime_checkable

from models.semantic_reasoner.engines.protocol import Completion, Engine, Request, Sampling, close_engine
from stable_data.errors import Notice, cannot_write
from stable_data.json_text import is_unicode

CACHE_VERSION = 1
"""Raised whenever the format of keys or entries changes, so that older entries are not found."""

_MAX_BYTES = 64 * 2**20  # of an entry
_MOST = 2**53  # of tokens, and of a cost
_TYPES: Mapping[str, tuple[type, ...]] = {
    "text": (str,),
    "prompt_tokens": (int, NoneType),
    "reply_tokens": (int, NoneType),
    "cost": (int, float, NoneType),
}


@runtime_checkable
class StreamingEngine(Protocol):
    """An engine that yields each completion when it arrives, so that it can be stored before the others are done."""

    def as_completed(self, requests: Sequence[Request]) -> Iterator[tuple[int, Completion]]:
        """Yields the completions when they arrive, each with the index of its request."""
        ...


class ResponseCache:
    """A folder of completions.

    Entries survive a killed process; a power cut may lose those of the last seconds. Failures are not stored.

    Args:
        folder: The folder, on a file system, not in an object store; created if it is missing.

    Attributes:
        notices: Broken entries, and those that could not be written.

    Raises:
        ConfigError: The folder cannot be created (``output_unwritable``).
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
        """Returns the key of a completion: 64 hex digits, a hash of the engine's name, the sampling and the whole request.

        Pictures count by their hashes; a request without pictures has the key that it had before there were any.
        """
        parts = [CACHE_VERSION, engine, asdict(sampling), list(request.messages), asdict(request.form), request.seed]
        parts += [[hashlib.sha256(picture).hexdigest() for picture in request.pictures]] if request.pictures else []
        return hashlib.sha256(json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

    def path(self, key: str) -> Path:
        """Returns the path of the entry of a key, whether or not it exists."""
        return self.folder / key[:2] / f"{key}.json"

    def read(self, key: str) -> Completion | None:
        """Returns the completion of a key; None if there is none, or a broken one, which gives a notice."""
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
            return _completion(json.loads(stream.read(_MAX_BYTES)), key)  # a longer file is cut, and then not valid JSON

    def store(self, key: str, completion: Completion) -> Completion:
        """Stores a completion unless it is a failure.

        Returns:
            The stored completion of the key: this one, or that of another process that was earlier.
        """
        if completion.failure:
            return completion
        path = self.path(key)
        temporary = path.with_name(f".{key}.{uuid.uuid4().hex}")
        try:
            path.parent.mkdir(exist_ok=True)
            temporary.write_bytes(_entry(key, completion))
            try:
                return self._link_or_read(temporary, path, key, completion)
            finally:
                temporary.unlink(missing_ok=True)
        except OSError as error:
            message = (
                f"{path} cannot be written ({error.strerror or error}); the completion is used, but requested again next time"
            )
            self.notices.append(Notice(key, "reason", "cache_unwritable", message))
            return completion

    def _link_or_read(self, temporary: Path, path: Path, key: str, completion: Completion) -> Completion:
        try:
            os.link(temporary, path)  # atomic, and never replaces an entry
        except OSError:  # an entry exists, or the file system has no links
            with suppress(OSError, ValueError, RecursionError):
                return replace(self._load(key), is_cached=False)  # since the engine was asked nevertheless
            temporary.replace(path)
        return completion


def _entry(key: str, c: Completion) -> bytes:
    fields = {"text": c.text, "prompt_tokens": c.prompt_tokens, "reply_tokens": c.reply_tokens, "cost": c.cost}
    return json.dumps({"key": key, "sum": _checksum(fields), **fields}).encode()


def _checksum(fields: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _completion(entry: Any, key: str) -> Completion:
    """The completion of an entry; a ValueError if its content is not what was written."""
    if not isinstance(entry, dict) or entry.pop("key", None) != key:
        raise ValueError("not an entry of this key")
    if entry.pop("sum", None) != _checksum(entry):
        raise ValueError("its content was changed")
    if entry.keys() != _TYPES.keys() or not all(type(entry[name]) in types for name, types in _TYPES.items()):
        raise ValueError("its content is no completion")  # whoever writes to the folder can state a sum that fits
    counts = entry["prompt_tokens"], entry["reply_tokens"], entry["cost"]
    if not (is_unicode(entry["text"]) and all(count is None or 0 <= count < _MOST for count in counts)):
        raise ValueError("its content has a number out of range, or text that is not UTF-8")
    return Completion(**entry, is_cached=True)


class CachedEngine:
    """An engine with a cache: only requests without an entry are sent to it.

    Equal requests are sent once. Completions of a :class:`StreamingEngine` are stored when each arrives, those of other engines
    when all are done.

    Args:
        engine: Any engine.
        cache: The cache.
        sampling: How the engine draws tokens, a part of the key.

    Attributes:
        name: Name of the engine.
        repeats: True: an entry always gives the same completion.
        notices: Notices of the cache.
    """

    repeats = True

    def __init__(self, engine: Engine, cache: ResponseCache, sampling: Sampling) -> None:
        self.name, self.engine, self.cache, self.sampling = engine.name, engine, cache, sampling
        self.notices = cache.notices

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Returns one completion for each request, in their order.

        A cached one has the tokens and the cost of its first request, so that rows are equal; ``is_cached`` states that they
        were not spent again.
        """
        keys = [self.cache.key(self.name, self.sampling, request) for request in requests]
        found = {key: self.cache.read(key) for key in keys}
        first: dict[str, int] = {}  # key -> index of the first request with it that has no entry
        for k, key in enumerate(keys):
            if found[key] is None:
                first.setdefault(key, k)
        for key, completion in self._ask(list(first), [requests[k] for k in first.values()]):
            found[key] = self.cache.store(key, completion)
        return [_as_duplicate(found[key]) if first.get(key, k) != k else _not_none(found[key]) for k, key in enumerate(keys)]

    def close(self) -> None:
        """Ends what the engine has started."""
        close_engine(self.engine)

    def _ask(self, keys: list[str], requests: list[Request]) -> Iterator[tuple[str, Completion]]:
        if not requests:
            return
        if isinstance(self.engine, StreamingEngine):
            for k, completion in self.engine.as_completed(requests):
                yield keys[k], completion
        else:
            yield from zip(keys, self.engine.complete(requests), strict=True)


def _not_none(completion: Completion | None) -> Completion:
    assert completion is not None
    return completion


def _as_duplicate(completion: Completion | None) -> Completion:
    """The completion of a request that equals an earlier one of the same call: it had no cost."""
    known = _not_none(completion)
    if known.failure:
        return replace(known, prompt_tokens=0, reply_tokens=0, cost=0.0)
    return replace(known, is_cached=True)
