"""What a reply may look like, as a JSON Schema and as a grammar for constrained decoding.

Both say the same but for the length of descriptions: the keys and their order, lengths with one decimal, no white space, and
limits that follow from the table: a position is on it, nothing is larger than its diagonal or higher than :data:`HIGHEST_CM`.
What needs geometry (overlaps, supports) is for the checks.

That a reply has what its instruction asks for, in any order and among other things, is no grammar of a size that could be
used: it would have to tell every subset apart. An engine asks :meth:`ReplyGrammar.lacking` when a reply would end, and goes on
    under
:meth:`ReplyGrammar.grammar_after`, which has one of what is lacking come next.
"""

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from models.semantic_reasoner.language.required_objects import ObjectRequirement
from models.semantic_reasoner.text.reply_json import parse_reply
from stable_data.errors import SceneError
from stable_data.json_text import is_unicode
from stable_data.scene import Tabletop

HIGHEST_CM = 200.0
"""No object reaches higher, centimetres."""

MOST_OBJECTS = 60
"""Most objects of one reply."""

MOST_NAMES = 1000
"""Most instances that an edit may take away: with twice as many the grammar is beyond what llguidance follows."""

CATEGORY = re.compile("[a-z][a-z0-9_]*")
"""What a category looks like in the name of an instance."""

_LETTER = r'[^\s"\\<\x00-\x1f\x7f]'


@dataclass(frozen=True, slots=True)
class ReplyGrammar:
    """The form of the replies to one request.

    Attributes:
        width_cm: Extent of the table along x, centimetres.
        depth_cm: Along y.
        edits: Whether a reply may take objects away.
        names: Instances of the layout, which an edit may change or take away; :data:`MOST_NAMES` at most, of any characters.
        at_least: Fewest objects.
        at_most: Most objects.
        asks: What must be among the objects.
        binds: Whether an answer is this JSON alone; else the model says what it likes around it, and thinks if it does.
    """

    width_cm: float
    depth_cm: float
    edits: bool = False
    names: tuple[str, ...] = ()
    at_least: int = 0
    at_most: int = MOST_OBJECTS
    asks: tuple[ObjectRequirement, ...] = ()
    binds: bool = True

    def __post_init__(self) -> None:
        """Refuses names that no grammar can hold."""
        if len(self.names) > MOST_NAMES:
            raise SceneError(
                f"layout to be edited has {len(self.names)} objects, expected at most {MOST_NAMES}; edit a part",
                "too_many_names",
            )
        if not is_unicode(self.names):
            raise SceneError("layout to be edited has a name that is no UTF-8; rename the object", "name_invalid")

    @classmethod
    def of_table(cls, table: Tabletop, **more: Any) -> "ReplyGrammar":
        """The form of layouts on a table."""
        width, depth = (round(100 * s, 1) for s in table.size_xy)
        return cls(width, depth, **more)

    @property
    def longest_cm(self) -> float:
        """Largest side of an object, centimetres: the table's diagonal."""
        return math.ceil(10 * math.hypot(self.width_cm, self.depth_cm)) / 10

    def schema(self) -> dict[str, Any]:
        """JSON Schema for endpoints, with only the keywords of OpenAI's strict mode: lengths of strings are none of them.

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
        """Lark grammar as llguidance reads it: the text of :func:`models.semantic_reasoner.text.reply_json.render_objects`."""
        return _grammar(replace(self, asks=()))

    def lacking(self, text: str) -> tuple[str, ...] | None:
        """What a whole reply still has to have.

        Args:
            text: A reply in this form.

        Returns:
            The categories of which one must come, any at all where there are none; None where nothing is lacking, or nothing
            more may come.
        """
        if not self.asks:
            return None
        categories = [o.category for o in parse_reply(text).objects]
        if len(categories) >= self.at_most:
            return None
        unmet = [asked for asked in self.asks if not asked.is_met_by(categories)]
        named = tuple(dict.fromkeys(c for asked in unmet for c in asked.categories))
        return named if unmet else None

    def grammar_after(self, start: str, categories: tuple[str, ...], at_most: int) -> str:
        """Lark grammar of what follows where a reply must not end yet.

        Args:
            start: What is to be written first.
            categories: The next object is of one of these; of any where there are none.
            at_most: Most objects that may come.
        """
        return _grammar_after(replace(self, asks=(), at_most=at_most), start, categories)


def _triple(bounds: Iterable[tuple[float, float]]) -> dict[str, Any]:
    # One range for all three where an endpoint does not know prefixItems.
    limits = list(bounds)
    return {
        "type": "array",
        "items": {"type": "number", "minimum": min(b[0] for b in limits), "maximum": max(b[1] for b in limits)},
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


def _grammar_after(form: ReplyGrammar, start: str, categories: tuple[str, ...]) -> str:
    more = f'("," entry){{0,{form.at_most - 1}}}' if form.at_most > 1 else ""
    first, names = "entry", []
    if categories:
        one_of = "|".join(_literal(_json(category)[1:-1]) for category in categories)
        first, names = "asked", [f"ASKED: ({one_of}) /_[0-9]{{1,2}}/", _entry("asked", "ASKED")]
    return _with_entries(form, [f'start: {_literal(start)} {first} {more} "]}}"', *names])


def _literal(text: str) -> str:
    """A text as a string of the grammar, which has the escapes of JSON."""
    return json.dumps(text)


def _json(text: str) -> str:
    """A text as replies have it, see :func:`models.semantic_reasoner.text.reply_json.render_objects`."""
    return json.dumps(text, ensure_ascii=False)


def _entry(rule: str, name: str) -> str:
    return (
        rf'{rule}: "{{\"instance\":\"" {name} "\",\"description\":\"" WORDS "\",\"size\":[" SIDE "," SIDE "," TALL'
        r' "],\"position\":[" X "," Y "," Z "],\"z_rotation\":" ANGLE "}"'
    )


def _with_entries(form: ReplyGrammar, rules: list[str]) -> str:
    longest, highest = _up_to(form.longest_cm, 1), _up_to(HIGHEST_CM, 1)
    return "\n".join(
        [
            # Else what must come next is spelt with the tokenizer's words for that much alone, and longer tokens are lost.
            '%llguidance {"no_forcing": true}',
            *rules,
            _entry("entry", "NAME"),
            r"NAME: /[a-z][a-z_]{0,40}_[0-9]{1,2}/",
            # A bound on their length, as the schema has, would triple what the grammar costs; the longest reply bounds them
            # too.
            rf"WORDS: /{_LETTER}+( {_LETTER}+)*/",
            f"SIDE: /{longest}/",
            f"TALL: /{highest}/",
            f"X: /{_up_to(form.width_cm)}/",
            f"Y: /{_up_to(form.depth_cm)}/",
            f"Z: /{_up_to(HIGHEST_CM)}/",
            r"ANGLE: /-?(1[0-7][0-9]|[1-9][0-9]|[1-9])|0|180/",
        ]
    )


def _up_to(most: float, least_tenths: int = 0) -> str:
    """A pattern for the numbers with one decimal from 0, or one tenth, up to ``most``, in their one spelling."""
    whole, rest = divmod(math.floor(10 * most + 1e-6), 10)
    first = least_tenths if whole == 0 else 0
    parts = [rf"{whole}\.[{first}-{rest}]"]
    if whole > 0:
        parts.append(rf"0\.[{least_tenths}-9]")
    if whole > 1:
        parts.append(rf"({_whole_up_to(whole - 1)})\.[0-9]")
    return "|".join(parts)


def _whole_up_to(most: int) -> str:
    """A pattern for the whole numbers from 1 to ``most``, without leading zeros."""
    digits = str(most)
    parts = ["[1-9]" + "[0-9]" * (size - 1) for size in range(1, len(digits))]
    for place, digit in enumerate(digits):  # alike up to here, and smaller here
        low, high = int(place == 0), int(digit) - 1
        if low <= high:
            parts.append(digits[:place] + f"[{low}-{high}]" + "[0-9]" * (len(digits) - place - 1))
    return "|".join([*parts, digits])
