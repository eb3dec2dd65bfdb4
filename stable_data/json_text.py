"""Untrusted JSON, parsed with limits, and numbers that are read strictly and written so that they read back exactly."""

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.limits import LIMITS, at_most

_ENDS = ("\n", "\r")  # of a line
_NO_UTF8 = re.compile("[\udc80-\udcff]")  # what Python makes of bytes of file names that are not UTF-8


class ReadLog:
    """Collects the notices about one item; every message starts with the item's id.

    Attributes:
        item_id: The scene or asset.
        notices: Remarks on content that was used.
    """

    def __init__(self, item_id: str) -> None:
        self.item_id = item_id
        self.notices: list[Notice] = []

    def warn(self, code: str, message: str) -> None:
        """Adds a notice about a defect that has a fallback."""
        self.notices.append(Notice(self.item_id, "read", code, f"{self.item_id}: {message}"))

    def error(self, code: str, message: str) -> SceneError:
        """Returns the error to raise for a defect that has no fallback."""
        return SceneError(f"{self.item_id}: {message}", code)


def quote_value(value: object) -> str:
    """Returns a value as text for a message: bounded in length, on one line."""
    try:
        # A long value is cut first, because its whole repr would take long.
        text = repr(value[:9] if isinstance(value, (list, str)) and len(value) > 99 else value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, or containers nested too deep
        text = f"a huge {type(value).__name__}"
    return text if len(text) <= 99 else text[:96] + "..."


def read_bounded(path: Path, group: Any, name: str, log: ReadLog) -> bytes:
    """Reads a regular file of limited size.

    Args:
        path: The file.
        group: A group of :data:`stable_data.limits.LIMITS`.
        name: The field of it that limits the bytes.
        log: The log of the item that the file belongs to.

    Raises:
        SceneError: The file is missing, not a regular file, too big or unreadable.
    """
    if not path.is_file():
        raise log.error("file_missing", f"{path} is missing or not a regular file")
    max_bytes = getattr(group, name)
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)  # one more byte shows that the file is too big
    except OSError as error:
        raise log.error("file_unreadable", f"{path} cannot be read: {error.strerror}") from error
    if len(data) > max_bytes:
        raise log.error("file_too_big", f"{path} is larger, expected {at_most(group, name, 'bytes')}")
    return data


def parse_object(data: bytes | str, what: str, log: ReadLog, *, repeated_code: str | None = None) -> dict[str, Any]:
    """Parses the JSON object of a file.

    Args:
        data: The content; bytes are UTF-8.
        what: Its name in messages, such as ``layout.json``.
        log: The log of the item that the file belongs to.
        repeated_code: Code of the notice about a repeated key, whose first value is used; None: a repeated key is an error.

    Raises:
        SceneError: ``json_too_big``, ``json_not_utf8``, ``json_truncated``, ``json_invalid``, ``json_duplicate_key``,
            ``json_too_deep`` or ``json_not_object``.
    """
    text = _decode(data, what, log)

    def without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        entry = dict(pairs)
        if len(entry) < len(pairs):
            repeated, *others = (key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
            more = f" and {len(others)} more keys" if others else ""
            found = f"{what} gives key {quote_value(repeated)}{more} twice in one object"
            if repeated_code is None:
                raise log.error("json_duplicate_key", f"{found}; keep one of them")
            log.warn(repeated_code, f"{found}; the first value is used")
            entry = {}
            for key, value in pairs:
                entry.setdefault(key, value)
        return entry

    try:
        document = json.loads(text, object_pairs_hook=without_repeats)
    except json.JSONDecodeError as error:
        # An error at the end means that the rest of the file is missing.
        is_cut = error.pos >= len(text.rstrip()) or error.msg.startswith("Unterminated string")
        where = f"line {error.lineno} column {error.colno} (character {error.pos} of {len(text)})"
        code, hint = ("json_truncated", "is the file cut?") if is_cut else ("json_invalid", "expected JSON")
        raise log.error(code, f"{what} is not valid JSON at {where}: {error.msg}; {hint}") from None
    except RecursionError:
        raise log.error("json_too_deep", f"{what} {_too_deep()}") from None
    except SceneError:
        raise
    except ValueError as error:  # an integer of thousands of digits
        raise log.error("json_invalid", f"{what} is not valid JSON: {quote_value(str(error))}") from None
    if not isinstance(document, dict):
        raise log.error("json_not_object", f"{what} holds a {type(document).__name__} at its top level, expected an object")
    if _is_too_deep(document):
        raise log.error("json_too_deep", f"{what} {_too_deep()}")
    return document


def json_value(text: str) -> Any:
    """Parses a JSON text that is one of many items, such as a line of a file.

    Raises:
        ValueError: The text is not JSON, contains NaN, an integer of thousands of digits or text that is not UTF-8, has too many
            values, or nests too deep; the message is one line.
    """
    if is_cut(text):
        raise ValueError(f"it is longer, expected {at_most(LIMITS.text, 'max_line', 'characters')}")
    if _has_many_values(text):
        raise ValueError(_too_many())
    try:
        value = json.loads(text, parse_constant=_refuse_constant)
        is_deep = _is_too_deep(value)
    except RecursionError:
        is_deep = True
    if is_deep:
        raise ValueError(_too_deep())
    if ("\\ud" in text.lower() or not text.isascii()) and not is_unicode(value):
        raise ValueError("contains text that is not UTF-8")
    return value


def is_cut(line: str) -> bool:
    """Whether a line of :func:`bounded_lines` is cut."""
    return line.endswith("\0") and len(line) > LIMITS.text.max_line


def bounded_lines(path: Path, newline: str | None = None) -> Iterator[str]:
    """Reads a text file line by line, up to limits on its lines and on the length of one.

    Args:
        path: The file, UTF-8. Bytes that are not UTF-8 become lone surrogates, for which :func:`json_value` refuses a line.
        newline: As for ``open``.

    Yields:
        The lines with their ends. One that is too long is cut and ends with a null character, before it with a double quote if what
        is cut off has an odd number of these; the next one follows.

    Raises:
        OSError: The file cannot be read.
        ConfigError: It has too many lines (``too_many_lines``): each that is invalid is kept with its reason.
    """
    most, lines_left = LIMITS.text.max_line, LIMITS.text.max_lines
    with path.open(encoding="utf-8-sig", errors="surrogateescape", newline=newline) as stream:
        while line := stream.readline(most):
            if len(line) == most and not line.endswith(_ENDS):
                rest, num_quotes = line, 0
                while rest and not rest.endswith(_ENDS):
                    rest = stream.readline(most)
                    num_quotes += rest.count('"')
                line += '"' * (num_quotes % 2) + "\0"
            if not lines_left:
                raise too_many_lines(path)
            lines_left -= 1
            yield line


def too_many_lines(path: Path) -> ConfigError:
    """The error of a file of tasks or edits that has too many lines or rows."""
    most = at_most(LIMITS.text, "max_lines")
    return ConfigError(f"{path}: has more lines or rows, expected {most}; divide it", "too_many_lines")


def read_json(path: Path) -> Any:
    """Reads a JSON file of the project, such as a manifest, labels or statistics.

    Raises:
        OSError: It cannot be read.
        ValueError: It is too large or no JSON, or one of its objects has a key twice, of which no two readers need to choose the same
            value; as for :func:`json_value`, but NaN and infinities are read.
    """
    with path.open("rb") as file:
        return document_of(file.read(LIMITS.text.max_document_bytes + 1))


def document_of(content: bytes) -> Any:
    """Parses the content of a JSON file of the project; see :func:`read_json`.

    Raises:
        ValueError: As :func:`read_json`.
    """
    if len(content) > LIMITS.text.max_document_bytes:
        raise ValueError(f"it is larger, expected {at_most(LIMITS.text, 'max_document_bytes', 'bytes')}")
    text = content.decode("utf-8-sig")
    if _has_many_values(text):
        raise ValueError(_too_many())
    try:
        document = json.loads(text, object_pairs_hook=_without_repeats)
    except RecursionError:
        raise ValueError(_too_deep()) from None
    if _is_too_deep(document):
        raise ValueError(_too_deep())
    if "\\ud" in text.lower() and not is_unicode(document):
        raise ValueError("contains text that is not UTF-8")
    return document


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entry = dict(pairs)
    if len(entry) < len(pairs):
        repeated = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"gives key {quote_value(repeated)} twice in one object; keep one of them")
    return entry


def _too_deep() -> str:
    return f"nests deeper, expected {at_most(LIMITS.json, 'max_levels', 'levels')}"


def _too_many() -> str:
    return f"has more brackets and commas, expected {at_most(LIMITS.json, 'max_values')}; split it"


def _has_many_values(text: str) -> bool:
    # A value of two bytes becomes a Python object of 64 bytes, so the number of values bounds the memory for parsing.
    return text.count("{") + text.count("[") + text.count(",") > LIMITS.json.max_values


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"{constant} is not a JSON number")


def as_text(name: str) -> str:
    """The name of a file or folder as text that can be written: bytes that are not UTF-8 become ``%FF``."""
    return _NO_UTF8.sub(lambda found: f"%{ord(found[0]) & 0xFF:02X}", name)


def is_unicode(value: object) -> bool:
    """Whether all text of a string or of JSON content can be written as UTF-8: it contains no half of a surrogate pair.

    Python reads such halves from JSON escapes and from bytes that are not UTF-8, and every writer fails on them.
    """
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        return False
    return True


def _decode(data: bytes | str, what: str, log: ReadLog) -> str:
    """Returns text that has a limited number of values and can be encoded again."""
    try:
        text = data.decode("utf-8-sig") if isinstance(data, bytes) else data
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        message = f"{what} is not UTF-8: byte 0x{byte:02x} at offset {error.start}; save it as UTF-8"
        raise log.error("json_not_utf8", message) from None
    if _has_many_values(text):
        raise log.error("json_too_big", f"{what} {_too_many()}")
    # The text is parsed a second time only if it may contain half of a surrogate pair.
    if "\\ud" in text.lower() or not text.isascii():
        try:
            is_whole = is_unicode(json.loads(text))
        except (ValueError, RecursionError):
            is_whole = True  # parse_object reports this error
        if not is_whole:
            raise log.error("json_not_utf8", f"{what} holds half of a surrogate pair, expected whole characters")
    return text


def json_text(document: object, **style: Any) -> str:
    """Returns JSON of content that may come from a file; NaN and infinities, which JSON does not have, become null.

    ``style`` are further options of ``json.dumps``.
    """
    try:
        return json.dumps(document, ensure_ascii=False, allow_nan=False, **style)
    except ValueError:
        return json.dumps(_without_non_finite(document), ensure_ascii=False, allow_nan=False, **style)


def _without_non_finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _without_non_finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_non_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _is_too_deep(document: object) -> bool:
    """Whether containers nest deeper than the limit."""
    # Level by level, because recursion could overflow the stack.
    level: list[Any] = [document] if isinstance(document, (dict, list)) else []
    for _ in range(LIMITS.json.max_levels):
        level = [
            child
            for parent in level
            for child in (parent.values() if isinstance(parent, dict) else parent)
            if isinstance(child, (dict, list))
        ]
        if not level:
            return False
    return True


def numbers(value: object, count: int) -> tuple[float, ...] | None:
    """Returns a JSON list of ``count`` numbers as floats, possibly not finite; None for any other value.

    A boolean is not a number, and neither is a string of digits. An integer beyond the range of a double becomes infinite.
    """
    if not isinstance(value, (list, tuple)) or len(value) != count:
        return None
    floats = [number(item) for item in value]
    return None if None in floats else tuple(item for item in floats if item is not None)


def number(value: object) -> float | None:
    """Returns a JSON number as a float, possibly not finite; None for any other value."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):  # bool is a subclass of int
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def are_finite(values: Sequence[float] | None) -> bool:
    """Whether the values are given and all finite."""
    return values is not None and all(map(math.isfinite, values))


def exact_preimage(forward: Callable[[float], float], guess: float, target: float) -> float:
    """Returns the double near ``guess`` that ``forward`` maps to ``target`` exactly, or ``guess`` if there is none."""
    below = above = guess
    for _ in range(4):  # the rounding of a few operations moves a value by a few doubles at most
        for candidate in (below, above):
            if forward(candidate) == target:
                return candidate
        below, above = math.nextafter(below, -math.inf), math.nextafter(above, math.inf)
    return guess
