"""What a language model proposes in Holodeck and I-Design: objects with sizes, and relations between them, but no poses."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from models.baselines.placement.candidates import floor_of
from models.baselines.placement.problem import CARRYING, Constraint, PlacementRelation
from models.semantic_reasoner.replies.checks import are_metres
from models.semantic_reasoner.replies.grammar import CATEGORY, HIGHEST_CM, MOST_OBJECTS
from models.semantic_reasoner.replies.json_form import JsonForm, closed_object
from models.semantic_reasoner.text.reply_json import LayoutObject, category_word, sanitise_words
from stable_data.errors import SceneError
from stable_data.json_text import number as float_of
from stable_data.json_text import quote_value
from stable_data.scene import TABLE, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.relations import CELLS, facing_of
from stable_data.scene_graph.support_tree import SupportTree

MOST_RELATIONS = 4 * MOST_OBJECTS
"""The largest number of relations in one reply."""

LONGEST_CM = 400.0
"""The largest side of an object, centimetres."""

FACINGS = tuple(facing_of(math.radians(45 * k)) for k in range(8))
"""The directions of ``face to``."""

_WORDS: Mapping[str, PlacementRelation] = {
    **{str(kind): kind for kind in PlacementRelation},
    "on top of": PlacementRelation.ON,
    "above": PlacementRelation.ON,
    "inside": PlacementRelation.IN,
    "inside of": PlacementRelation.IN,
    "to the left of": PlacementRelation.LEFT_OF,
    "to the right of": PlacementRelation.RIGHT_OF,
    "front of": PlacementRelation.IN_FRONT_OF,
    "in back of": PlacementRelation.BEHIND,
    "next to": PlacementRelation.NEAR,
    "beside": PlacementRelation.NEAR,
    "close to": PlacementRelation.NEAR,
    "adjacent to": PlacementRelation.NEAR,
    "around": PlacementRelation.NEAR,
    "aligned": PlacementRelation.ALIGNED_WITH,
    "center aligned": PlacementRelation.ALIGNED_WITH,
    "faces": PlacementRelation.FACING,
    "at": PlacementRelation.IS_AT,
}
"""The words of a relation that are read, without underscores and in small letters."""

_KEYS = ("subject", "relation", "target")
_CENTRE = {"center": "middle", "centre": "middle"}
_PLACES = frozenset(word for cell in CELLS for word in cell.split("_"))

OBJECTS_FORM = JsonForm.of(
    "objects",
    closed_object(
        {
            "objects": {
                "type": "array",
                "minItems": 1,
                "maxItems": MOST_OBJECTS,
                "items": closed_object(
                    {
                        "category": {"type": "string", "pattern": f"^{CATEGORY.pattern}$"},
                        "description": {"type": "string"},
                        "size": {
                            "type": "array",
                            "items": {"type": "number", "minimum": 0.1, "maximum": HIGHEST_CM},
                            "minItems": 3,
                            "maxItems": 3,
                        },
                        "number": {"type": "integer", "minimum": 1, "maximum": MOST_OBJECTS},
                    }
                ),
            }
        }
    ),
)
"""The form of a list of objects: sizes in centimetres."""

RELATIONS_FORM = JsonForm.of(
    "relations",
    closed_object(
        {
            "relations": {
                "type": "array",
                "maxItems": MOST_RELATIONS,
                "items": closed_object(
                    {
                        "subject": {"type": "string"},
                        "relation": {"type": "string", "enum": [str(kind) for kind in PlacementRelation]},
                        "target": {"type": "string"},
                    }
                ),
            }
        }
    ),
)
"""The form of a list of relations."""


@dataclass(frozen=True, slots=True)
class RelationText:
    """A relation as a language model wrote it; nothing is checked.

    Attributes:
        subject: The words for the subject.
        relation: The words for the relation.
        target: The words for the target.
    """

    subject: str
    relation: str
    target: str

    def __str__(self) -> str:
        """Returns ``subject relation target``."""
        return f"{self.subject} {self.relation} {self.target}"

    @property
    def kind(self) -> PlacementRelation | None:
        """The relation that the words name; None if they name none."""
        return _WORDS.get(" ".join(self.relation.lower().replace("_", " ").replace("-", " ").split()))

    @property
    def constraint(self) -> Constraint | None:
        """The relation with names in the usual form; None if its words name no relation, direction or cell."""
        kind = self.kind
        if kind is None:
            return None
        subject, target = _name(self.subject), _name(self.target)
        if kind is PlacementRelation.IS_AT:
            cell = _cell(target)
            return None if cell is None else Constraint(subject, kind, cell)
        if kind is PlacementRelation.FACE_TO:
            return Constraint(subject, kind, target) if target in FACINGS else None
        return Constraint(subject, kind, target)


def _name(words: str) -> str:
    """A name as objects have it: small letters and underscores, without an article."""
    return re.sub(r"\W+", "_", words.lower()).strip("_").removeprefix("the_")


def _cell(target: str) -> str | None:
    """The cell that words such as ``left``, ``center`` or ``back_left`` name; None if they name none."""
    words = {_CENTRE.get(word, word) for word in target.split("_")}
    if not words <= _PLACES:
        return None
    row = next((word for word in ("front", "back") if word in words), "middle")
    column = next((word for word in ("left", "right") if word in words), "middle")
    return f"{row}_{column}"


def read_objects(document: Any, table: Tabletop) -> tuple[LayoutObject, ...]:
    """Reads a list of objects.

    Args:
        document: The JSON.
        table: The table, whose size shows whether sizes are in centimetres.

    Returns:
        Each object, numbered from 0 within its category; their positions are 0.

    Raises:
        SceneError: It is no such list (``reply_malformed``), empty (``layout_empty``), too long (``too_many``), or in another unit
            (``unit``).
    """
    entries = document.get("objects") if isinstance(document, dict) else None
    if not isinstance(entries, list):
        raise SceneError('reply has no list "objects", expected {"objects":[...]}', "reply_malformed")
    if not entries:
        raise SceneError("reply has no object, expected at least one", "layout_empty")
    found: list[LayoutObject] = []
    count: Counter[str] = Counter()
    for k, entry in enumerate(entries):
        category, words, size, number = _read_object(entry, k)
        if len(found) + number > MOST_OBJECTS:
            total = sum(_number(e.get("number", 1)) for e in entries if isinstance(e, dict))
            raise SceneError(f"there are {total} objects; give at most {MOST_OBJECTS}", "too_many")
        for _ in range(number):
            found.append(LayoutObject(f"{category}_{count[category]}", words, size, (0.0, 0.0, 0.0), 0))
            count[category] += 1
    if are_metres(found, table):
        raise SceneError("no side is longer than the table in metres; give sizes in centimetres", "unit")
    return tuple(found)


def _read_object(entry: Any, k: int) -> tuple[str, str, Vec3, int]:
    if not isinstance(entry, dict):
        raise SceneError(f"object {k} is {quote_value(entry)}, expected a JSON object", "reply_malformed")
    category, words = entry.get("category"), entry.get("description")
    word = category_word(category) if isinstance(category, str) and category.strip()[:1].isalpha() else ""
    parts = word.split("_")  # not by a regular expression, which would take quadratic time
    while parts and parts[-1].isascii() and parts[-1].isdigit():
        parts.pop()
    word = "_".join(parts)
    if not CATEGORY.fullmatch(word):
        raise SceneError(f'object {k} has "category" {quote_value(category)}, expected a noun', "reply_malformed")
    description = sanitise_words(words) if isinstance(words, str) else ""
    size, number = entry.get("size"), _number(entry.get("number", 1))
    if not (isinstance(size, list) and len(size) == 3 and all(map(_is_side, size))):
        raise SceneError(
            f'object {k} ({word}) has "size" {quote_value(size)}, expected width, depth and height in centimetres',
            "reply_malformed",
        )
    if number < 1:
        raise SceneError(
            f'object {k} ({word}) has "number" {quote_value(entry.get("number"))}, expected at least 1', "reply_malformed"
        )
    width, depth, height = (max(0.1, round(float(side), 1)) for side in size)
    return word, description or word.replace("_", " "), (width, depth, height), number


def _number(value: Any) -> int:
    found = float_of(value)  # infinite for an integer beyond the range of a double
    return int(found) if found is not None and found.is_integer() else 0


def _is_side(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= LONGEST_CM


def read_relations(document: Any) -> tuple[RelationText, ...]:
    """Reads a list of relations, which may be empty; what they name is not checked.

    Raises:
        SceneError: It is no such list (``reply_malformed``), or too long (``too_many``).
    """
    entries = document.get("relations") if isinstance(document, dict) else None
    if not isinstance(entries, list):
        raise SceneError('reply has no list "relations", expected {"relations":[...]}', "reply_malformed")
    if len(entries) > MOST_RELATIONS:
        raise SceneError(f"there are {len(entries)} relations; give at most {MOST_RELATIONS}", "too_many")
    found = []
    for k, entry in enumerate(entries):
        words = [str(entry.get(key) or "").strip() for key in _KEYS] if isinstance(entry, dict) else []
        if not words or not all(words):
            raise SceneError(
                f'relation {k} is {quote_value(entry)}, expected {{"subject":...,"relation":...,"target":...}}',
                "reply_malformed",
            )
        found.append(RelationText(*map(sanitise_words, words)))
    return tuple(dict.fromkeys(found))


def stacked(objects: Sequence[SceneObject], constraints: Sequence[Constraint]) -> tuple[SceneObject, ...]:
    """Returns objects without places at the heights that their carriers give them, each with its support, all at one point.

    Retrieval then knows what holds something and what leans.
    """
    carriers = {c.subject: c for c in constraints if c.kind in CARRYING}
    supported = {
        o.instance: replace(o, support=carriers[o.instance].target if o.instance in carriers else TABLE) for o in objects
    }
    done: dict[str, SceneObject] = {}
    for name in SupportTree.of(supported.values()).bottom_up():
        o, bottom = supported[name], 0.0
        if name in carriers:
            base = done[carriers[name].target]
            bottom = base.top if carriers[name].kind is PlacementRelation.ON else floor_of(base)
        done[name] = o.moved((0.0, 0.0, bottom + o.size[2] / 2), 0.0)
    return tuple(done[o.instance] for o in objects)
