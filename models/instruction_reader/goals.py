"""The goal that an instruction states, as conditions between instances of a scene.

A wrong goal is worse than none: an instruction that also asks for something that no state of the scene shows, such as pouring tea, has
no conditions. Nor has one that asks to hand something over or to show it, and for something else too: which comes first, and whether
the hand is free then, a reading does not tell.
"""

import re
from collections.abc import Iterator, Mapping

from models.instruction_reader.reading import InstructionReading, MentionedRelation
from stable_data.condition import HAND_OVER_REGION, NAME_SEPARATOR, ConditionKind, GoalCondition
from stable_data.tasks.unseen_actions import unseen_action

K = ConditionKind

_KINDS = {"in": K.IN, "on": K.ON, "near": K.BESIDE}
_SIDES = {"left": (K.LEFT_OF, K.RIGHT_OF, "left", "right"), "front": (K.IN_FRONT_OF, K.BEHIND, "front", "behind")}
"""A direction of a reading: its kind, the opposite kind, and the word of each."""

_SURE = 0.8
"""Least probability of a relation of the goal; a less likely one makes the goal unknown."""

_BEFORE = 40  # characters before a mention in which the word of its direction is looked for

_HAND_OVER = re.compile(
    r"\b(?:hand|pass|give|bring|fetch|get)\s+(?:it |that |this )?(?:to )?(?:me|us)\b(?! (?:a|some|one) )|\blet (?:me|us) have\b(?! a )"
    r"|\bhand(?:ing)? (?:over|.{1,40} over\b)"
    r"|\b(?:hand|pass|give|bring) [^.;]{1,80}(?<! closer)(?<! nearer)(?<! close)(?<! near)(?<! next) to (?:me|us|the person)\b"
)
"""Words that ask to bring something to the user."""

_SHOW = re.compile(
    r"\bshow (?:it |that |this )?(?:to )?me\b(?! (?:where|how|what|which)\b)|\bto the camera\b"
    r"|\b(?:let me have a )?closer look\b|\bhold (?:it|.{1,40}) up for me\b"
)
"""Words that ask to hold something up."""

_UNSTATED = re.compile(
    r"\b(?:hand|pass|give|bring|fetch|show|get|let|throw|toss|serve)\s+(?:it |them |that |this )?(?:to )?(?:me|us|him|her|them|mum|dad)\b"
    r"|\bhand(?:ing)? (?:over|.{1,40} over\b)|\b(?:hand|pass|give) .{1,40} to (?:me|us|him|her)\b"
    r"|\b(?:separate|line up|space|sort|tidy)\b"
    r"|(?:^|[.;,:]|\band|\bthen|\bto|\byou|\bplease)\s*(?:please )?(?:stack|show)\b"
    r"|\bup to the camera\b|\bcloser look\b|\bhold .{1,30} (?:steady|still)\b"
)
"""Further words that ask for what no condition of this module states."""

_PICK = re.compile(r"\b(?:pick|lift|grab|grasp|raise|hold)\b")
_REMOVE = re.compile(
    r"\b(?:take|lift|remove|get|pull|fish|dig|fetch|move|shift|clear|pick|off|out)\b.*\b(?:out|off|from|away)\b"
    r"|\bremove\b|\b(?:out of|off)\b"
)
_EMPTY = re.compile(r"\b(?:empty|clear)\b|\beverything\b|\bwhatever\b|\bwhat is\b")
_SWAP = re.compile(r"\b(?:swap|exchange|trade|change) (?:the |round |around |over |their |places\b|positions\b)|\bswap\b")
_SLIDE = re.compile(
    r"\b(?:push|slide|nudge|shift|move)\b[^.;]*\b(?:to|towards?) the (?P<way>left|right|front|back)\b"
    r"(?! (?:side|edge|corner|half|part|third|end|hand|of|left|right)|-hand)"
)
_CORNERS = frozenset({"front_left", "front_right", "back_left", "back_right"})
_LENGTH = re.compile(r"(\d+(?:\.\d+)?) ?(?:cm|centimet\w+)\b")


def conditions_of_reading(reading: InstructionReading, instruction: str, names: Mapping[int, str]) -> tuple[GoalCondition, ...]:
    """Returns the conditions that hold when an instruction is done; none if not all that it asks for can be stated.

    Args:
        reading: The reading of the instruction.
        instruction: The instruction.
        names: The instance of each mentioned object; objects that were not found are missing.
    """
    text = " ".join(instruction.lower().replace("’", "'").split())
    is_handed, is_shown = _HAND_OVER.search(text) is not None, _SHOW.search(text) is not None
    rest = _SHOW.sub(" ", _HAND_OVER.sub(" ", text))
    if unseen_action(rest) is not None or _UNSTATED.search(rest):
        return ()
    goal = _Goal(reading, text, instruction, names)
    if is_handed and is_shown:  # one thing is handed over, and another one shown
        return ()
    if is_handed or is_shown:
        return goal.held(HAND_OVER_REGION if is_handed else "")
    return goal.conditions()


class _Goal:
    """The goal of one reading."""

    def __init__(self, reading: InstructionReading, text: str, instruction: str, names: Mapping[int, str]) -> None:
        self._reading, self._text, self._instruction, self._names = reading, text, instruction, names

    def conditions(self) -> tuple[GoalCondition, ...]:
        """All conditions; none if one of them names an object that was not found."""
        if _SWAP.search(self._text):
            return self._swapped()
        objects, slide = self._reading.objects, _SLIDE.search(self._text)
        if slide is not None and not self._reading.goal and not any(o.goal_region for o in objects):
            movers = [k for k, o in enumerate(objects) if o.is_taken] or list(range(len(objects)))
            return (self._slid(self._names[movers[0]], slide),) if len(movers) == 1 and movers[0] in self._names else ()
        found = [*self._relations(), *self._regions(), *self._emptied(), *self._taken()]
        return () if None in found else tuple(dict.fromkeys(c for c in found if c is not None))

    def held(self, region: str) -> tuple[GoalCondition, ...]:
        """That the one object that the instruction asks for is held, in a region if one is given; none if it asks for more."""
        objects = self._reading.objects
        taken = [k for k, o in enumerate(objects) if o.is_taken]
        asks_more = self._reading.goal or any(o.goal_region or o.is_filled for o in objects)
        if asks_more or _SWAP.search(self._text) or _SLIDE.search(self._text):
            return ()
        if len(taken) != 1 or taken[0] not in self._names:
            return ()
        return (GoalCondition(self._names[taken[0]], K.HELD, region),)

    def _condition(self, subject: int, kind: ConditionKind, *targets: int) -> GoalCondition | None:
        names = [self._names.get(k) for k in (subject, *targets)]
        known = [name for name in names if name is not None]
        if len(known) < len(names) or len(set(known)) < len(names):
            return None
        return GoalCondition(known[0], kind, NAME_SEPARATOR.join(known[1:]))

    def _swapped(self) -> tuple[GoalCondition, ...]:
        names = list(self._names.values())
        if len(self._reading.objects) != 2 or len(set(names)) != 2:
            return ()
        return tuple(GoalCondition(a, K.AT, b) for a, b in (names, names[::-1]))

    def _relations(self) -> Iterator[GoalCondition | None]:
        ends: dict[int, list[int]] = {}
        for r in self._reading.goal:
            if r.score < _SURE:
                yield None
            elif r.kind == "between":
                ends.setdefault(r.subject, []).append(r.target)
            elif r.kind in _KINDS:
                yield self._condition(r.subject, _KINDS[r.kind], r.target)
            elif r.kind in _SIDES:
                kind, opposite, *_ = _SIDES[r.kind]
                is_subject = self._is_subject_moved(r)
                mover, other = (r.subject, r.target) if is_subject else (r.target, r.subject)
                yield self._condition(mover, kind if is_subject else opposite, other)
            else:
                yield None
        for subject, targets in ends.items():
            yield self._condition(subject, K.BETWEEN, *targets) if len(targets) == 2 else None

    def _is_subject_moved(self, r: MentionedRelation) -> bool:
        """Whether the subject of a direction is what moves: the word of its direction stands before the target."""
        _, _, word, opposite = _SIDES[r.kind]
        ends = ((r.target, word, True), (r.subject, opposite, False))
        near = [
            (start - at, is_subject)
            for number, said, is_subject in ends
            for start, _ in self._reading.objects[number].mentions
            if (at := self._instruction.lower().rfind(said, max(0, start - _BEFORE), start)) >= 0
        ]
        if near:
            return min(near)[1]
        if (word in self._text) != (opposite in self._text):  # "put the clock in front of it"
            return word in self._text
        first = [min((s for s, _ in self._reading.objects[k].mentions), default=0) for k in (r.subject, r.target)]
        return first[0] <= first[1]

    def _regions(self) -> Iterator[GoalCondition | None]:
        slide = _SLIDE.search(self._text)
        for k, o in enumerate(self._reading.objects):
            if not o.goal_region:
                continue
            if k not in self._names:
                yield None
            elif slide is not None and slide["way"] in o.goal_region.split("_"):
                yield self._slid(self._names[k], slide)
            elif not any(r.subject == k and r.kind in ("in", "on") for r in self._reading.goal):
                region = self._region(o.goal_region)
                is_corner = "corner" not in self._text or region in _CORNERS
                yield GoalCondition(self._names[k], K.AT, region) if is_corner else None

    def _slid(self, name: str, slide: re.Match[str]) -> GoalCondition:
        length = _LENGTH.search(self._text)
        return GoalCondition(name, K.MOVED, slide["way"], float(length[1]) / 100 if length and float(length[1]) > 0 else None)

    def _region(self, cell: str) -> str:
        """The part of the table that the words mean: a reading only has ninths."""
        row, column = cell.split("_")
        sides = [part for part in (row, column) if part != "middle"]
        if len(sides) != 1 or re.search(
            rf"\b(?:middle|centre|center)\b[^.;]{{0,20}}\b{sides[0]}\b|\b{sides[0]} middle\b", self._text
        ):
            return cell
        side = "front" if sides == ["front"] else sides[0]
        if re.search(rf"\b(?:{side}|near)[- ](?:hand )?edge\b|\bedge\b", self._text) or (
            side == "front" and "reach" in self._text
        ):
            return f"{side}_edge"
        return f"{side}_half" if re.search(rf"\b{side}[- ](?:hand )?half\b", self._text) else side

    def _emptied(self) -> Iterator[GoalCondition | None]:
        """Containers whose unnamed contents go, with no place stated for them."""
        if _EMPTY.search(self._text):
            for k, o in enumerate(self._reading.objects):
                if o.is_filled:
                    yield GoalCondition(self._names[k], K.EMPTY) if k in self._names else None

    def _taken(self) -> Iterator[GoalCondition | None]:
        """Objects that are to be taken, with no place stated: out of or off another one, or into the gripper."""
        placed = {r.subject for r in self._reading.goal}
        for k, o in enumerate(self._reading.objects):
            if not o.is_taken or o.goal_region or k in placed:
                continue
            place = next((r for r in self._reading.start if r.subject == k and r.kind in ("in", "on")), None)
            if k not in self._names:
                yield None
            elif place is not None and _REMOVE.search(self._text):
                found = self._condition(k, _KINDS[place.kind], place.target)
                yield None if found is None else GoalCondition(found.subject, found.kind, found.target, is_negated=True)
            elif _PICK.search(self._text):
                yield GoalCondition(self._names[k], K.HELD)
            else:
                yield None
