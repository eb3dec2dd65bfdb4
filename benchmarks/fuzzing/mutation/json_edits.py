"""Edits of JSON documents as trees; also of the text, for what a tree cannot hold."""

import copy
import json
from collections.abc import Iterator, Sequence
from random import Random
from typing import Any, TypeAlias

from benchmarks.fuzzing.mutation.odd_values import near_number, odd_text, odd_value

_Slot: TypeAlias = tuple[Any, Any]  # a container, and a key or index of it

_RAW = "@raw:"
_TWICE = "@twice@"  # end of a key that becomes equal to another one
_MOST_SLOTS = 3000
_RAW_VALUES = (
    *(
        "NaN",
        "-Infinity",
        "1e999",
        "-0",
        "1E400",
        "9" * 5000,
        '"\\ud83d"',
        '"\\udc00\\ud800"',
        "0.1e-400",
        "00",
        "'a'",
        "{a:1}",
        "",
    ),
    *("[" * 3000 + "]" * 3000, '{"a":' * 2000 + "0" + "}" * 2000, "[" * 900 + "0" + "]" * 900, "/*x*/0", "0//x\n"),
)
_DEPTHS = (1, 2, 10, 70, 400)


def edited_json(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes | None:
    """Returns a JSON document with one edit of its tree; None if it is no JSON.

    Args:
        content: The document.
        rng: Chooses the edit.
        donors: Documents from which values are copied.
        words: Words of the grammar.
    """
    try:
        document = [json.loads(content)]
    except (ValueError, RecursionError):
        return None
    edit_tree(document, rng, [d for d in map(_loaded, donors[:8]) if d is not None] if rng.random() < 0.15 else (), words)
    return _dumped(document[0])


def _loaded(content: bytes) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return None


def _dumped(document: Any) -> bytes:
    text = json.dumps(document, separators=(",", ":"))
    parts = text.split(f'"{_RAW}')
    text = parts[0] + "".join(_RAW_VALUES[int(part.partition("@")[0])] + part.partition('"')[2] for part in parts[1:])
    return text.replace(_TWICE, "").encode()


def edit_tree(document: list[Any], rng: Random, donors: Sequence[Any] = (), words: Sequence[str] = ()) -> None:
    """Makes one edit in a tree of lists, dicts and plain values.

    Args:
        document: A list that has the tree as its only item.
        rng: Chooses the edit.
        donors: Trees from which values are copied.
        words: Words of the grammar.
    """
    slots = list(_slots(document))
    parent, key = rng.choice(slots)
    value = parent[key]
    kind = rng.random()
    if kind < 0.22:
        numbers = [(p, k) for p, k in slots if isinstance(p[k], (int, float)) and not isinstance(p[k], bool)]
        if numbers:
            parent, key = rng.choice(numbers)
            parent[key] = near_number(parent[key], rng)
            return
    if kind < 0.5:
        parent[key] = odd_value(rng, words) if rng.random() < 0.93 else f"{_RAW}{rng.randrange(len(_RAW_VALUES))}@"
    elif kind < 0.6:
        _remove(document, parent, key)
    elif kind < 0.7:
        _repeat(parent, key, rng)
    elif kind < 0.77:
        _rename(parent, key, slots, rng, words)
    elif kind < 0.86:
        other = rng.choice(slots)
        parent[key] = copy.deepcopy(other[0][other[1]])
    elif kind < 0.92 and donors:
        there = list(_slots([rng.choice(donors)]))
        other = rng.choice(there)
        parent[key] = copy.deepcopy(other[0][other[1]])
    elif kind < 0.96:
        parent[key] = _wrapped(value, rng)
    else:
        parent[key] = _of_other_type(value, rng, words)


def _slots(document: list[Any]) -> Iterator[_Slot]:
    """The places of a tree, level by level, the first few thousand."""
    level: list[Any] = [document]
    count = 0
    while level:
        below: list[Any] = []
        for container in level:
            for key in container if isinstance(container, dict) else range(len(container)):
                yield container, key
                count += 1
                if count >= _MOST_SLOTS:
                    return
                if isinstance(container[key], (dict, list)) and container[key]:
                    below.append(container[key])
        level = below


def _remove(document: list[Any], parent: Any, key: Any) -> None:
    if parent is document:
        document[0] = None
    else:
        del parent[key]


def _repeat(parent: Any, key: Any, rng: Random) -> None:
    """Repeats an item of a list, or gives an object a key twice."""
    value = parent[key]
    if isinstance(parent, list) and len(parent) + 1 < 5000:
        parent[key:key] = [copy.deepcopy(value) for _ in range(rng.choice((1, 1, 2, 10, 100, 600)))]
    elif isinstance(parent, dict) and isinstance(key, str):
        parent[f"{key}{_TWICE}"] = rng.choice((value, odd_value(rng)))


def _rename(parent: Any, key: Any, slots: Sequence[_Slot], rng: Random, words: Sequence[str]) -> None:
    keys = [k for p, k in slots if isinstance(p, dict)]
    if isinstance(parent, dict):
        new = rng.choice(keys) if keys and rng.random() < 0.6 else odd_text(rng, words)
        parent[new] = parent.pop(key)
    elif len(parent) > 1:
        rng.shuffle(parent)


def _wrapped(value: Any, rng: Random) -> Any:
    for _ in range(rng.choice(_DEPTHS)):
        value = [value] if rng.random() < 0.7 else {"a": value}
    return value


def _of_other_type(value: Any, rng: Random, words: Sequence[str]) -> Any:
    if isinstance(value, (int, float)):
        return rng.choice((str(value)[:400], bool(value), [value], {"value": value}))
    if isinstance(value, str):
        return rng.choice(
            (value + odd_text(rng, words), value.upper(), value[::-1], [value], value[: len(value) // 2], 0, {value: value})
        )
    if isinstance(value, list):
        return rng.choice((dict(enumerate(map(str, value))), value[:1], value[::-1], len(value), value * 2, None))
    if isinstance(value, dict):
        return rng.choice(
            (list(value.values()), list(value), len(value), dict.fromkeys(value), dict(list(value.items())[::-1]))
        )
    return odd_value(rng, words)


def edited_json_lines(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes | None:
    """Returns JSON lines with one edit of one line; None if the line is no JSON."""
    lines = content.splitlines() or [b""]
    k = rng.randrange(len(lines))
    changed = edited_json(lines[k], rng, [line for donor in donors[:4] for line in donor.splitlines()[:4]], words)
    if changed is None:
        return None
    lines[k] = changed
    if rng.random() < 0.1:
        lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
    return b"\n".join(lines) + b"\n"
