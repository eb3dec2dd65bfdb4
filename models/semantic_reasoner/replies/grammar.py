"""The form of replies, as a JSON Schema and as a grammar for constrained decoding.

Both state the same except for the length of descriptions: the keys and their order, lengths with one decimal, no white space,
and limits from the table: positions are on it, and no object is larger than its diagonal or higher than :data:`HIGHEST_CM`.
The checks judge what needs geometry (overlaps, supports).

A grammar cannot require the objects of an instruction in any order among others: it would have a state for every subset, which
is too large. An engine calls :meth:`ReplyGrammar.lacking` when a reply would end, and continues with
:meth:`ReplyGrammar.grammar_after`, which requires one of the missing objects next.
"""

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from models.semantic_reasoner.text.reply_json import parse_reply
from stable_data.errors import SceneError
from stable_data.json_text import is_unicode
from stable_data.metrics.matching import RequiredObject, unmatched
from stable_data.scene import Tabletop

HIGHEST_CM = 200.0
"""The largest height of an object and of a position, centimetres."""

MOST_OBJECTS = 60
"""The largest number of objects in one reply."""

MOST_NAMES = 1000
"""The largest layout that can be edited, in instances; llguidance fails on a grammar with twice as many."""

CATEGORY = re.compile("[a-z][a-z0-9_]*")
"""The pattern of a category in the name of an instance."""

_LETTER = r'[^\s"\\<\x00-\x1f\x7f]'


@dataclass(frozen=True, slots=True)
class ReplyGrammar:
    """The form of the replies to one request.

    Attributes:
        width_cm: Extent of the table along x, centimetres.
        depth_cm: Along y.
        edits: Whether a reply may remove objects.
        names: Instances of the layout, which an edit may change or remove; :data:`MOST_NAMES` at most, of any characters.
        at_least: Smallest number of objects.
        at_most: Largest number of objects.
        asks: The objects that the reply must contain.
        binds: Whether an answer is this JSON alone; else any text may surround it, a chain of thought included.
    """

    width_cm: float
    depth_cm: float
    edits: bool = False
    names: tuple[str, ...] = ()
    at_least: int = 0
    at_most: int = MOST_OBJECTS
    asks: tuple[RequiredObject, ...] = ()
    binds: bool = True

    def __post_init__(self) -> None:
        """Refuses names that a grammar cannot contain."""
        if len(self.names) > MOST_NAMES:
            raise SceneError(
                f"layout to be edited has {len(self.names)} objects, expected at most {MOST_NAMES}; edit a part",
                "too_many_names",
            )
        if not is_unicode(self.names):
            raise SceneError("layout to be edited has a name that is not UTF-8; rename the object", "name_invalid")

    @classmethod
    def of_table(cls, table: Tabletop, **more: Any) -> "ReplyGrammar":
        """Returns the form of replies for a table."""
        width, depth = (round(100 * s, 1) for s in table.size_xy)
        return cls(width, depth, **more)

    @property
    def name(self) -> str:
        """The name of the form."""
        return "layout"

    @property
    def longest_cm(self) -> float:
        """Largest side of an object, centimetres: the table's diagonal."""
        return math.ceil(10 * math.hypot(self.width_cm, self.depth_cm)) / 10

    def schema(self) -> dict[str, Any]:
        """Returns the JSON Schema for endpoints, with the keywords of OpenAI's strict mode only: no lengths of strings.

        Every key is required and no other is allowed.
        """
        size = _triple([(0.1, self.longest_cm), (0.1, self.longest_cm), (0.1, HIGHEST_CM)])
        position = _triple([(0.0, self.width_cm), (0.0, self.depth_cm), (0.0, HIGHEST_CM)])
        entry = _closed(
            {
                "instance": {"type": "string", "pattern": f"^{CATEGORY.pattern}_[0-9]{{1,2}}$"},
                "description": {"type": "string"},
                "size": size,
                "position": position,
                "z_rotation": {"type": "integer", "minimum": -180, "maximum": 180},
            }
        )
        objects = {"type": "array", "items": entry, "minItems": self.at_least, "maxItems": self.at_most}
        removed = {"type": "array", "items": {"type": "string", "enum": list(self.names)}, "maxItems": len(self.names)}
        return _closed({**({"remove": removed} if self.edits and self.names else {}), "objects": objects})

    def grammar(self) -> str:
        """Returns the Lark grammar for llguidance of what :func:`models.semantic_reasoner.text.reply_json.render_objects` writes."""
        return _grammar(replace(self, asks=()))

    def lacking(self, text: str) -> tuple[str, ...] | None:
        """Finds the required objects that a complete reply lacks.

        Returns:
            The categories of which one must follow, empty if any category may; None if no object is missing, or no more objects
            are allowed.
        """
        if not self.asks:
            return None
        categories = [o.category for o in parse_reply(text).objects]
        if len(categories) >= self.at_most:
            return None
        unmet = unmatched(self.asks, categories)
        named = tuple(dict.fromkeys(c for asked in unmet for c in asked.categories))
        return named if unmet else None

    def grammar_after(self, start: str, categories: tuple[str, ...], at_most: int) -> str:
        """Returns the Lark grammar of the continuation of a reply that lacks objects.

        Args:
            start: The text that comes first.
            categories: The categories of the next object; empty allows any.
            at_most: The largest number of further objects.
        """
        more = f'("," entry){{0,{at_most - 1}}}' if at_most > 1 else ""
        first, names = "entry", []
        if categories:
            # Without quotation marks, since the category is only a part of the JSON string.
            one_of = "|".join(_literal(_json(category)[1:-1]) for category in categories)
            first, names = "asked", [f"ASKED: ({one_of}) /_[0-9]{{1,2}}/", _entry("asked", "ASKED")]
        return _with_entries(self, [f'start: {_literal(start)} {first} {more} "]}}"', *names])


def _triple(bounds: Iterable[tuple[float, float]]) -> dict[str, Any]:
    # One range for all three, since strict mode has no prefixItems.
    lows, highs = zip(*bounds, strict=True)
    return {
        "type": "array",
        "items": {"type": "number", "minimum": min(lows), "maximum": max(highs)},
        "minItems": 3,
        "maxItems": 3,
    }


def _closed(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


@lru_cache(maxsize=512)
def _grammar(form: ReplyGrammar) -> str:
    more = form.at_most - 1
    some = f'entry ("," entry){{{max(0, form.at_least - 1)},{more}}}' if more > 0 else "entry"
    listed = some if form.at_least else f"({some})?"
    removed = ""
    if form.edits:
        one_of = "|".join(_literal(_json(name)) for name in form.names)
        gone = f'(({one_of}) ("," ({one_of}))*)?' if form.names else ""
        removed = f'"\\"remove\\":[" {gone} "]," '
    return _with_entries(form, [f'start: "{{" {removed}"\\"objects\\":[" {listed} "]}}"'])


def _literal(text: str) -> str:
    """A text as a string of the grammar, whose escapes are those of JSON."""
    return json.dumps(text)


def _json(text: str) -> str:
    """A text as replies contain it, see :func:`models.semantic_reasoner.text.reply_json.render_objects`."""
    return json.dumps(text, ensure_ascii=False)


def _entry(rule: str, name: str) -> str:
    return (
        rf'{rule}: "{{\"instance\":\"" {name} "\",\"description\":\"" WORDS "\",\"size\":[" SIDE "," SIDE "," TALL'
        r' "],\"position\":[" X "," Y "," Z "],\"z_rotation\":" ANGLE "}"'
    )


def _with_entries(form: ReplyGrammar, rules: list[str]) -> str:
    longest, highest = _number_pattern(form.longest_cm, 1), _number_pattern(HIGHEST_CM, 1)
    return "\n".join(
        [
            # Else llguidance tokenizes forced text by itself, and never uses tokens that reach beyond that text.
            '%llguidance {"no_forcing": true}',
            *rules,
            _entry("entry", "NAME"),
            r"NAME: /[a-z][a-z_]{0,40}_[0-9]{1,2}/",
            # Without a bound on the length, which would triple the cost of the grammar; max_tokens bounds it too.
            rf"WORDS: /{_LETTER}+( {_LETTER}+)*/",
            f"SIDE: /{longest}/",
            f"TALL: /{highest}/",
            f"X: /{_number_pattern(form.width_cm)}/",
            f"Y: /{_number_pattern(form.depth_cm)}/",
            f"Z: /{_number_pattern(HIGHEST_CM)}/",
            r"ANGLE: /-?(1[0-7][0-9]|[1-9][0-9]|[1-9])|0|180/",
        ]
    )


def _number_pattern(most: float, least_tenths: int = 0) -> str:
    """A pattern for the numbers with one decimal from ``least_tenths`` (0 or 1) to ``most``, each with one spelling."""
    whole, rest = divmod(math.floor(10 * most + 1e-6), 10)  # 1e-6 against rounding, as in 10 * 59.9
    first = least_tenths if whole == 0 else 0
    parts = [rf"{whole}\.[{first}-{rest}]"]
    if whole > 0:
        parts.append(rf"0\.[{least_tenths}-9]")
    if whole > 1:
        parts.append(rf"({_integer_pattern(whole - 1)})\.[0-9]")
    return "|".join(parts)


def _integer_pattern(most: int) -> str:
    """A pattern for the whole numbers from 1 to ``most``, without leading zeros."""
    digits = str(most)
    parts = ["[1-9]" + "[0-9]" * (size - 1) for size in range(1, len(digits))]
    for place, digit in enumerate(digits):  # the same digits before this place, and a smaller one at it
        low, high = int(place == 0), int(digit) - 1
        if low <= high:
            parts.append(digits[:place] + f"[{low}-{high}]" + "[0-9]" * (len(digits) - place - 1))
    return "|".join([*parts, digits])
