"""Reads the conditions that the sentences and actions of a task info state, such as ``The mug is in the bowl.`` and ``Pick(Mug)``.

MesaTask's task infos have no other goal. The sentences of :mod:`stable_data.instructions` have the same forms.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence

from stable_data.condition import BY_HEIGHT, BY_SIZE, HAND_OVER_REGION, NAME_SEPARATOR, ConditionKind, GoalCondition
from stable_data.errors import GoalError
from stable_data.instructions.naming import ObjectNamer
from stable_data.instructions.wording.vocabulary import answers_to
from stable_data.instructions.wording.words import category_words, singular, type_words
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.scene import TABLE, RelationKind, Scene, TaskInfo
from stable_data.scene_graph.relations import SceneGraph
from stable_data.tasks.regions import DIRECTIONS

K = ConditionKind

_COUNTS = "two|three|four|five|six|seven|eight|nine|ten"
_ALL = re.compile(rf"^(?:both(?: the)?|all(?: the)?(?: (?:{_COUNTS}))?|(?:the )?(?:{_COUNTS}))\s+(?:of the )?")
_ARTICLE = re.compile(r"^(?:the|a|an|one|its|your|my)\s+")

_SIDES = {
    "left of": K.LEFT_OF,
    "right of": K.RIGHT_OF,
    "in front of": K.IN_FRONT_OF,
    "behind": K.BEHIND,
}
_BE = r"(?:is|are|stands?|lies?|sits?|rests?)(?: now)?"
_HOW = r"inside|in(?! front of)|on top of|on"
_SIDE = r"(?:to the |on the )?(?P<side>left|right)(?: side)? of|(?P<other_side>in front of|behind)"
_TOWARDS = {"front edge": "front", "back edge": "back", "left edge": "left", "right edge": "right"}

Handler = Callable[["GoalSentences", "re.Match[str]"], Iterator[GoalCondition]]


class ObjectResolver:
    """Finds the instances that words of a task info mean.

    Args:
        scene: The scene at the start.
        graph: Its scene graph.
        task_objects: The task objects; they have priority.
    """

    def __init__(self, scene: Scene, graph: SceneGraph, task_objects: Sequence[str]) -> None:
        self._scene, self._graph, self._objects = scene, graph, {o.instance: o for o in scene.objects}
        self._wanted = [name for name in task_objects if name in self._objects]
        self._names: dict[str, set[str]] = {}
        namer = ObjectNamer(scene, graph)
        for o in scene.objects:
            for name in namer.names(o.instance):
                self._names.setdefault(name.words.lower(), set()).add(o.instance)

    def several(self, words: str) -> tuple[str, ...]:
        """The instances of a list such as ``the mug, the bowl and both plates``.

        Raises:
            GoalError: ``goal_unresolved``.
        """
        parts = [part for part in re.split(r",\s*(?:and\s+)?|\s+and\s+", words.strip()) if part]
        if len(parts) > 1 and not self._is_name(words):
            return tuple(dict.fromkeys(name for part in parts for name in self._alike(part)))
        return self._alike(words.strip())

    def _is_name(self, words: str) -> bool:
        """Whether words with ``and`` or a comma are the name or the category of an object."""
        lower = " ".join(words.lower().split())
        noun = singular(type_words(_ARTICLE.sub("", lower)))
        return lower in self._names or any(category_words(o.category) == noun for o in self._objects.values())

    def one(self, words: str) -> str:
        """The instance of a noun phrase or type.

        Raises:
            GoalError: ``goal_unresolved``: there is none, or there are several.
        """
        found = self.several(words)
        if len(found) == 1:
            return found[0]
        raise self._error(words, f"means {len(found)} objects ({', '.join(found)}), expected one")

    def by_size(self, names: Sequence[str], *, is_height: bool) -> list[str]:
        """Instances by their volume or their height, the smallest first."""
        sizes = {name: self._objects[name].size for name in names}
        return sorted(names, key=lambda name: sizes[name][2] if is_height else math.prod(sizes[name]))

    def contents(self, name: str, kind: ConditionKind) -> list[str]:
        """The objects that are in or on an instance at the start."""
        return [o for o in self._objects if self._graph.has_edge(o, name, key=RelationKind(str(kind)))]

    def _alike(self, words: str) -> tuple[str, ...]:
        lower = " ".join(words.lower().split())
        if len(exact := self._names.get(lower, set())) == 1:
            return tuple(exact)
        asks_all = _ALL.match(lower)
        noun = lower[asks_all.end() :] if asks_all else _ARTICLE.sub("", lower)
        if words in self._objects:
            return (words,)
        found = self._of_noun(noun if " " in words or words.islower() else words)
        if not found:
            raise self._error(words, "is no object of the scene")
        if len(found) > 1 and not asks_all:
            raise self._error(words, f"means {len(found)} objects ({', '.join(found)}), expected one")
        return tuple(found)

    def _of_noun(self, noun: str) -> list[str]:
        """Objects of a noun or type: task objects first, by their whole category first."""
        words = singular(type_words(noun))
        if not words:
            return []
        tests: tuple[Callable[[str], bool], ...] = (
            lambda category: category_words(category) == words,
            lambda category: _ends_alike(category_words(category), words),
            lambda category: answers_to(category, " ".join(type_words(noun))),
        )
        for names in (self._wanted, list(self._objects)):
            for test in tests:
                if found := [name for name in names if test(self._objects[name].category)]:
                    return found
        return []

    def _error(self, words: str, found: str) -> GoalError:
        return GoalError(
            f"{self._scene.scene_id}: {words!r} in the goal {found}; write conditions with instances into the task info",
            "goal_unresolved",
        )


def _ends_alike(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Whether the longer of two nouns ends with the shorter one."""
    short, long = sorted((one, other), key=len)
    return bool(short) and long[-len(short) :] == short


class GoalSentences:
    """Reads the goal of a task info.

    Args:
        task: The task info.
        resolver: Finds its objects.
        is_container: Whether an instance is a container.
    """

    def __init__(self, task: TaskInfo, resolver: ObjectResolver, is_container: Callable[[str], bool]) -> None:
        self._task, self._resolver, self._is_container = task, resolver, is_container

    def conditions(self) -> tuple[GoalCondition, ...]:
        """The conditions that its sentences state; those of its actions if it has no sentences.

        Raises:
            GoalError: ``goal_not_checkable``: a sentence or action has no checkable form; ``goal_unresolved``.
        """
        for words in (*self._task.goal, *self._task.action_sequence):
            if len(words) > LIMITS.text.max_instruction:  # the time of the forms grows with the third power of the length
                raise not_checkable(words, f"it is longer, expected {at_most(LIMITS.text, 'max_instruction', 'characters')}")
        for action in self._task.action_sequence:
            if _UNCHECKABLE.match(action):
                raise not_checkable(action, "no state of the scene shows that it was done")
        found = [c for sentence in self._task.goal for c in self.of_sentence(sentence)]
        if not found:
            found = list(self._of_actions())
        return tuple(dict.fromkeys(found))

    def of_sentence(self, sentence: str) -> tuple[GoalCondition, ...]:
        """The conditions that one sentence states.

        Raises:
            GoalError: ``goal_not_checkable`` or ``goal_unresolved``.
        """
        text = " ".join(sentence.strip().rstrip(".").split())
        text = text[:1].lower() + text[1:]
        failure: GoalError | None = None
        for pattern, handler in _FORMS:
            if (match := pattern.fullmatch(text)) is None:
                continue
            try:
                return tuple(handler(self, match))
            except GoalError as error:  # another form may read the words in another way
                failure = failure or error
        raise failure or not_checkable(sentence, "its form is unknown")

    def _each(self, words: str, kind: ConditionKind, target: str = "", *, negated: bool = False) -> Iterator[GoalCondition]:
        return (GoalCondition(name, kind, target, is_negated=negated) for name in self._resolver.several(words))

    # --- forms of sentences ---

    def _held(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.HELD)

    def _handed_over(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.HELD, HAND_OVER_REGION)

    def _on_table(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.ON, TABLE)

    def _in_or_on(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.IN if m["how"].startswith("in") else K.ON, self._resolver.one(m["b"]))

    def _not_in_or_on(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        kind = K.IN if m["how"].startswith("in") else K.ON
        return self._each(m["a"], kind, self._resolver.one(m["b"]), negated=True)

    def _nothing_in_or_on(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        yield GoalCondition(self._resolver.one(m["b"]), K.EMPTY, "in" if m["how"].startswith("in") else "on")

    def _stacked(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        below = self._resolver.one(m["b"])
        for name in self._resolver.several(m["a"]):
            yield GoalCondition(name, K.ON, below)
            below = name

    def _aside(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        target = self._resolver.one(m["b"])
        side = m["other_side"] or f"{m['side']} of"
        for name in self._resolver.several(m["a"]):
            yield GoalCondition(name, _SIDES[side], target)
            if m["close"]:
                yield GoalCondition(name, K.BESIDE, target)

    def _beside(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.BESIDE, self._resolver.one(m["b"]))

    def _between(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        ends = self._resolver.several(m["b"])
        if len(ends) != 2:
            raise not_checkable(m[0], f"{len(ends)} objects have a place between them, expected two")
        return self._each(m["a"], K.BETWEEN, NAME_SEPARATOR.join(ends))

    def _at_cell(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.AT, f"{m['row']}_{m['column']}".replace("rear", "back"))

    def _at_middle(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.AT, "middle_middle")

    def _at_part(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.AT, m["part"])

    def _at_half(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.AT, f"{m['part']}_half")

    def _at_edge(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.AT, f"{m['part']}_edge")

    def _where_was(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.AT, self._resolver.one(m["b"]))

    def _off_edge(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.APART, f"{m['part']}_edge")

    def _apart(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        pair = self._resolver.several(m["a"])
        if len(pair) != 2:
            raise not_checkable(m[0], f"{len(pair)} objects are to be apart, expected two")
        yield GoalCondition(pair[0], K.APART, pair[1])

    def _moved(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        direction = m["part"]
        stated = m["cm"]
        for name in self._resolver.several(m["a"]):
            distance = float(stated) / 100 if stated else self._pushed(name, direction)
            yield GoalCondition(name, K.MOVED, direction, distance)

    def _pushed(self, name: str, direction: str) -> float | None:
        """The distance of the push of an object among the actions, metres."""
        for action in self._task.action_sequence:
            m = _PUSH.fullmatch(action.strip())
            if m and m["way"].strip() == direction and self._resolver.one(m["a"]) == name:
                return float(m["cm"]) / 100
        return None

    def _upright(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._each(m["a"], K.UPRIGHT)

    def _faces(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        words = re.sub(r"^the ", "", m["b"])
        target = _TOWARDS.get(words) or self._resolver.one(m["b"])
        return self._each(m["a"], K.FACING, target)

    def _group(self, kind: ConditionKind, words: str) -> Iterator[GoalCondition]:
        names = self._resolver.several(words)
        if len(names) < 2:
            raise not_checkable(words, "one object is arranged, expected several")
        yield GoalCondition(NAME_SEPARATOR.join(names), kind)

    def _row(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        yield from self._group(K.IN_A_ROW, m["a"])
        if m["what"]:
            is_height = m["what"] in ("lowest", "shortest", "tallest")
            least_is_left = (m["what"] in ("largest", "tallest")) == (m["end"] == "right")
            names = self._resolver.by_size(self._resolver.several(m["a"]), is_height=is_height)
            measure = (BY_HEIGHT if is_height else BY_SIZE) if least_is_left else ""
            yield GoalCondition(NAME_SEPARATOR.join(names if least_is_left else names[::-1]), K.ORDERED, measure)

    def _contents(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        kinds = [K.IN if m[how].startswith("in") else K.ON for how in ("how", "there")]
        target = self._resolver.one(m["c"])
        names = self._resolver.contents(self._resolver.one(m["b"]), kinds[0])
        if not names:
            raise not_checkable(m[0], "nothing is there at the start")
        return (GoalCondition(name, kinds[1], target) for name in names)

    def _even(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._group(K.EVEN, m["a"])

    def _together(self, m: re.Match[str]) -> Iterator[GoalCondition]:
        return self._group(K.TOGETHER, m["a"])

    # --- actions ---

    def _of_actions(self) -> Iterator[GoalCondition]:
        """The conditions of the actions, each object at its last place."""
        places: dict[str, list[GoalCondition]] = {}
        picked = None
        for action in self._task.action_sequence:
            m = re.fullmatch(r"\s*(\w+)\((.*)\)\s*", action)
            if m is None:
                raise not_checkable(action, "its form is unknown")
            verb, argument = m[1], m[2].strip()
            if verb == "Pick":
                picked = self._resolver.one(argument)
                places[picked] = [GoalCondition(picked, K.HELD)]
            elif verb == "Push" and (push := _PUSH.fullmatch(action.strip())):
                name = self._resolver.one(push["a"])
                places[name] = [GoalCondition(name, K.MOVED, push["way"].strip(), float(push["cm"]) / 100)]
            elif verb in ("PlaceOn", "PlaceAt") and picked is not None:
                places[picked] = list(self._of_place(verb, argument, picked, action))
            else:
                raise not_checkable(action, "no state of the scene shows that it was done")
        return (c for conditions in places.values() for c in conditions)

    def _of_place(self, verb: str, place: str, picked: str, action: str) -> Iterator[GoalCondition]:
        if type_words(place) == (TABLE,):
            yield GoalCondition(picked, K.ON, TABLE)
        elif re.fullmatch(r"(?:in front of )?(?:the )?camera", place.lower()):
            yield GoalCondition(picked, K.HELD)
        elif re.fullmatch(r"(?:in )?(?:the )?hand of .+", place.lower()):
            yield GoalCondition(picked, K.HELD, HAND_OVER_REGION)
        elif verb == "PlaceOn":
            target = self._resolver.one(place)
            yield GoalCondition(picked, K.IN if self._is_container(target) else K.ON, target)
        elif m := re.fullmatch(rf"(?:(?:in|inside|into) (?P<inside>.+)|(?:on|onto) (?P<top>.+)|(?:{_SIDE}) (?P<b>.+))", place):
            if words := m["inside"] or m["top"]:
                yield GoalCondition(picked, K.IN if m["inside"] else K.ON, self._resolver.one(words))
            else:
                yield GoalCondition(picked, _SIDES[m["other_side"] or f"{m['side']} of"], self._resolver.one(m["b"]))
        elif m := re.fullmatch(r"next to (.+)", place):
            yield GoalCondition(picked, K.BESIDE, self._resolver.one(m[1]))
        elif m := re.fullmatch(r"(front|back|middle)[ _](left|middle|right)", place.lower()):
            yield GoalCondition(picked, K.AT, f"{m[1]}_{m[2]}")
        elif place.lower() in ("middle", "centre", "center"):
            yield GoalCondition(picked, K.AT, "middle_middle")
        elif m := re.fullmatch(r"(left|right|front|back)( side| edge)?", place.lower()):
            yield GoalCondition(picked, K.AT, f"{m[1]}_edge" if m[2] == " edge" else m[1])
        else:
            raise not_checkable(action, "its place is unknown")


def not_checkable(words: str, reason: str) -> GoalError:
    """Returns the error for a sentence or action that cannot be checked."""
    return GoalError(f"{quote_value(words)} cannot be checked ({reason}); leave the task out", "goal_not_checkable")


_UNCHECKABLE = re.compile(r"\s*(?!Pick\b|PlaceOn\b|PlaceAt\b|Push\b)\w+\(|.*\(above .*\)")
_PUSH = re.compile(r"Push\((?P<a>[^,]+),(?P<way>[^,]+),\s*(?P<cm>\d+(?:\.\d+)?)\s*\)")
_WAY = "|".join(DIRECTIONS)


def _form(pattern: str, handler: Handler) -> tuple[re.Pattern[str], Handler]:
    return re.compile(pattern), handler


_S = GoalSentences
_FORMS: tuple[tuple[re.Pattern[str], Handler], ...] = (
    _form(rf"(?P<a>.+?) {_BE} held (?:above the table|up in front of the camera)", _S._held),
    _form(r"the person in front of the table holds (?P<a>.+)", _S._handed_over),
    _form(rf"(?P<a>.+?) {_BE} on the table", _S._on_table),
    _form(rf"(?P<a>.+?) {_BE} in the (?P<row>front|back|rear) (?P<column>left|right) corner(?: of the table)?", _S._at_cell),
    _form(rf"(?P<a>.+?) {_BE} in the (?:middle|centre|center) of the table", _S._at_middle),
    _form(rf"(?P<a>.+?) {_BE} (?:at|on) the (?P<part>{_WAY})(?: side)? of the table", _S._at_part),
    _form(rf"(?P<a>.+?) {_BE} on the (?P<part>left|right) half of the table", _S._at_half),
    _form(rf"(?P<a>.+?) {_BE} (?:within reach )?at the (?P<part>{_WAY}) edge(?: of the table)?", _S._at_edge),
    _form(rf"(?P<a>.+?) {_BE} where (?P<b>.+?) (?:was|were)", _S._where_was),
    _form(rf"(?P<a>.+?) {_BE} well away from the (?P<part>{_WAY}) edge", _S._off_edge),
    _form(
        rf"(?P<a>.+?) {_BE} (?:(?P<cm>\d+(?:\.\d+)?) cm )?(?:farther|further) (?:to|towards?) the (?P<part>{_WAY})(?: edge)?"
        r"(?: than before)?",
        _S._moved,
    ),
    _form(r"there is a clear gap between (?P<a>.+)", _S._apart),
    _form(rf"(?P<a>.+?) {_BE} (?:not|no longer) (?P<how>{_HOW}) (?P<b>.+)", _S._not_in_or_on),
    _form(rf"nothing of (?P<a>.+?) {_BE} (?P<how>{_HOW}) (?P<b>.+)", _S._not_in_or_on),
    _form(rf"nothing {_BE} (?P<how>{_HOW}) (?P<b>.+)", _S._nothing_in_or_on),
    _form(rf"(?P<a>.+?) {_BE} stacked on (?P<b>.+)", _S._stacked),
    _form(rf"(?P<a>.+?) {_BE} (?:{_SIDE}) (?P<b>.+?)(?P<close>, close to (?:it|them))?", _S._aside),
    _form(rf"(?P<a>.+?) {_BE} (?:next to|beside|close to) (?P<b>.+)", _S._beside),
    _form(rf"(?P<a>.+?) {_BE} between (?P<b>.+)", _S._between),
    _form(r"(?P<a>.+?) stands? upright", _S._upright),
    _form(r"(?P<a>.+?) faces? (?P<b>.+)", _S._faces),
    _form(
        rf"(?P<a>.+?) {_BE} in (?:one|another|a) row"
        r"(?:, the (?P<what>smallest|largest|lowest|shortest|tallest) on the (?P<end>left|right))?",
        _S._row,
    ),
    _form(rf"what (?:was|were) (?P<how>{_HOW}) (?P<b>.+?) {_BE} (?P<there>{_HOW}) (?P<c>.+)", _S._contents),
    _form(rf"(?P<a>.+?) {_BE} equally spaced from left to right", _S._even),
    _form(r"(?P<a>.+?) stand close together", _S._together),
    _form(rf"(?P<a>.+?) {_BE} (?P<how>{_HOW}) (?P<b>.+)", _S._in_or_on),
)
"""The forms of sentences, tried in this order."""
