"""Objects as a language model reads and writes them: JSON in centimetres and whole degrees.

A reply is ``{"objects":[...]}``; an edit's reply names what goes first: ``{"remove":["mug_0"],"objects":[...]}``. Lengths have
one decimal, angles none, so that text and :class:`LayoutObject` are inverses of each other: what was rendered parses to the
same object, and what parsed renders to the same text.
"""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from stable_data.errors import SceneError
from stable_data.json_text import json_value
from stable_data.scene import SceneObject, Stage, Vec3
from stable_data.storage.json_schemas import LEAST_SIDE_CM, LONGEST_CM, MOST_ENTRIES

DECIMALS = 1
"""Decimals of a length in centimetres."""

LONGEST_REPLY = 2**18
"""Most bytes of a reply: a layout of 60 objects has about 20,000."""

_INSTANCE = re.compile(r"[^\W\d_]\w*?_[0-9]+")


@dataclass(frozen=True, slots=True)
class LayoutObject:
    """An object of a layout in the units of the text.

    Attributes:
        instance: ``<category>_<number>``, unique in its layout.
        description: Words that an asset is retrieved by.
        size_cm: Width, depth and height of its box before ``z_rotation``, tilt included, centimetres.
        position_cm: Centre of that box, centimetres, world frame.
        z_rotation_deg: Counter-clockwise seen from above, 0 faces the viewer, degrees in (-180, 180].
    """

    instance: str
    description: str
    size_cm: Vec3
    position_cm: Vec3
    z_rotation_deg: int

    @property
    def category(self) -> str:
        """What its instance says that it is."""
        return self.instance.rpartition("_")[0]

    def to_scene_object(self, stage: Stage | None = None) -> SceneObject:
        """The object in SI units, without an asset and without a support."""
        (w, d, h), (x, y, z) = self.size_cm, self.position_cm
        return SceneObject(
            self.instance,
            self.category,
            (x / 100, y / 100, z / 100),
            math.radians(self.z_rotation_deg),
            (w / 100, d / 100, h / 100),
            description=self.description,
            stage=stage,
        )


def layout_objects(objects: Iterable[SceneObject], known: Mapping[str, str] | None = None) -> tuple[LayoutObject, ...]:
    """Scene objects in the words of a layout, in their order.

    Args:
        objects: The objects; all of one layout, so that names stay unique.
        known: Names that some instances have already; see :func:`layout_names`. By default all are named here.

    Returns:
        One layout object each. Boxes are rounded to a millimetre, and no thinner than one.
    """
    objects = tuple(objects)
    names = layout_names(objects) if known is None else known
    return tuple(
        LayoutObject(
            names[o.instance],
            sanitise_words(o.description) or sanitise_words(o.category.replace("_", " ")) or "object",
            _in_cm(o.size, least=0.1),
            _in_cm(o.position),
            _whole_degrees(o.yaw),
        )
        for o in objects
    )


def layout_names(objects: Iterable[SceneObject]) -> dict[str, str]:
    """``<category>_<number>`` for each instance, numbered from 0 in the given order."""
    count: Counter[str] = Counter()
    names = {}
    for o in objects:
        category = _category_word(o.category)
        names[o.instance] = f"{category}_{count[category]}"
        count[category] += 1
    return names


def renumber_instances(objects: Iterable[LayoutObject], taken: Iterable[str]) -> tuple[LayoutObject, ...]:
    """Objects whose names are unique: one that is taken already gets the next number of its category that is free.

    Numbers say nothing but which is which, so a reply that counts wrongly loses nothing by it.

    Args:
        objects: The objects.
        taken: Names that others have.
    """
    used = set(taken)
    named = []
    untried: dict[str, Iterator[str]] = {}  # by category: numbers before these are taken
    for o in objects:
        if o.instance in used:
            numbers = untried.setdefault(o.category, _numbered(o.category))
            o = replace(o, instance=next(name for name in numbers if name not in used))
        used.add(o.instance)
        named.append(o)
    return tuple(named)


def _numbered(category: str) -> Iterator[str]:
    return (f"{category}_{n}" for n in itertools.count())


def _category_word(category: str) -> str:
    word = re.sub(r"\W+", "_", category.lower()).strip("_")
    return word if word and not word[0].isdigit() else f"object_{word}".rstrip("_")


def _in_cm(lengths: Vec3, least: float = -math.inf) -> Vec3:
    x, y, z = (max(least, round(100 * v, DECIMALS)) + 0.0 for v in lengths)
    return x, y, z


def _whole_degrees(yaw: float) -> int:
    return -((180 - round(math.degrees(yaw))) % 360) + 180


def sanitise_words(words: str) -> str:
    """Words from outside as one line that no chat template can mistake for its own marks."""
    return re.sub(r"<(?=[|/a-zA-Z])", "< ", " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", words).split()))


# --- text ---------------------------------------------------------------------------------------------------------------------


def render_objects(objects: Iterable[LayoutObject], removed: Sequence[str] | None = None) -> str:
    """The JSON text of a layout or a reply, without white space.

    Args:
        objects: The objects.
        removed: Of an edit, the instances that go; None: no edit.
    """
    head = "" if removed is None else f'"remove":{_json(list(removed))},'
    return f'{{{head}"objects":[{",".join(_render(o) for o in objects)}]}}'


def _render(o: LayoutObject) -> str:
    return (
        f'{{"instance":{_json(o.instance)},"description":{_json(o.description)},"size":{_numbers(o.size_cm)}'
        f',"position":{_numbers(o.position_cm)},"z_rotation":{o.z_rotation_deg}}}'
    )


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _numbers(values: Vec3) -> str:
    return f"[{','.join(f'{v:.{DECIMALS}f}' for v in values)}]"


@dataclass(frozen=True, slots=True)
class LayoutReply:
    """What a reply says.

    Attributes:
        objects: New objects, and those that are changed, in the order of the text.
        removed: Instances that go; empty but for edits.
    """

    objects: tuple[LayoutObject, ...]
    removed: tuple[str, ...] = ()


def parse_reply(text: str) -> LayoutReply:
    """The objects of a reply, which is in the form of ``schemas/layout_reply.schema.json``.

    Code fences, white space and words before the first brace are passed over, since models without constrained decoding add
    them; numbers may have any form that JSON allows and are rounded to the text's decimals.

    Args:
        text: A model's answer.

    Returns:
        Its objects.

    Raises:
        SceneError: It is too long (``reply_too_long``), no JSON (``reply_not_json``), or not in the form of a reply
            (``reply_malformed``).
    """
    num_bytes = len(text.encode("utf-8", "surrogatepass"))
    if num_bytes > LONGEST_REPLY:
        raise SceneError(f"reply has {num_bytes} bytes, expected at most {LONGEST_REPLY}; ask again", "reply_too_long")
    body = text[max(0, text.find("{")) :].rstrip().removesuffix("```")
    try:
        data = json_value(body)
    except ValueError as error:
        raise SceneError(f"reply is no JSON ({error}): {_shown(text)}; ask again", "reply_not_json") from error
    if not isinstance(data, dict) or not isinstance(data.get("objects"), list):
        raise SceneError(f'reply is {_shown(text)}, expected {{"objects":[...]}}', "reply_malformed")
    removed = data.get("remove", [])
    if not isinstance(removed, list) or not all(isinstance(name, str) for name in removed):
        raise SceneError(f'reply: "remove" is {_shown(str(removed))}, expected a list of instances', "reply_malformed")
    for key, entries in (("objects", data["objects"]), ("remove", removed)):
        if len(entries) > MOST_ENTRIES:
            raise SceneError(f'reply: "{key}" has {len(entries)} entries, expected at most {MOST_ENTRIES}', "reply_malformed")
    return LayoutReply(tuple(_parse(entry, k) for k, entry in enumerate(data["objects"])), tuple(removed))


def _parse(entry: Any, k: int) -> LayoutObject:
    if not isinstance(entry, dict):
        raise SceneError(f"reply: object {k} is {_shown(str(entry))}, expected a JSON object", "reply_malformed")
    instance, description = entry.get("instance"), entry.get("description")
    if not isinstance(instance, str) or not _INSTANCE.fullmatch(instance):
        raise SceneError(
            f'reply: object {k} has "instance" {_shown(str(instance))}, expected such as "mug_0"', "reply_malformed"
        )
    if not isinstance(description, str) or not sanitise_words(description):
        raise SceneError(f'reply: {instance} has "description" {_shown(str(description))}, expected words', "reply_malformed")
    size, position = _vector(entry, "size", instance), _vector(entry, "position", instance)
    if min(size) < LEAST_SIDE_CM:
        raise SceneError(f"reply: {instance} has size {size}, expected three lengths of 0.1 cm or more", "reply_malformed")
    angle: Any = entry.get("z_rotation")
    if not _is_number(angle):
        raise SceneError(f'reply: {instance} has "z_rotation" {_shown(str(angle))}, expected degrees', "reply_malformed")
    return LayoutObject(instance, sanitise_words(description), size, position, _whole_degrees(math.radians(float(angle))))


def _vector(entry: Mapping[str, Any], key: str, instance: str) -> Vec3:
    values = entry.get(key)
    if not isinstance(values, list) or len(values) != 3 or not all(map(_is_number, values)):
        raise SceneError(f"reply: {instance} has {key!r} {_shown(str(values))}, expected three numbers", "reply_malformed")
    x, y, z = (round(float(v), DECIMALS) + 0.0 for v in values)
    return x, y, z


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LONGEST_CM


def _shown(text: str) -> str:
    words = " ".join(text.split())
    return repr(words if len(words) <= 80 else f"{words[:77]}...")
