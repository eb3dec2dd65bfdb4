"""Plans an edit from the reading of its instruction: the reply of a reasoner that no edit was ever shown to.

What goes, comes, moves, is replaced, restyled or exchanged follows from the reading; which objects are meant, from
:mod:`models.semantic_reasoner.edit_planning.mention_resolution`. Places are free of other boxes where there is room; the correction
finds the exact ones. An instruction that states no change gives no plan.
"""

from collections.abc import Iterator, Mapping, Sequence, Set

from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.edit_planning.candidates import Candidates, adjectives_of, head_of
from models.semantic_reasoner.edit_planning.layout_plan import SIDES, LayoutPlan, Moves, look_words
from models.semantic_reasoner.edit_planning.mention_resolution import MentionResolver
from models.semantic_reasoner.edit_planning.spoken_changes import OTHER, PLACE, with_spoken_changes
from models.semantic_reasoner.edit_planning.turns import yaw_after_turn
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutReply
from stable_data.errors import SceneError
from stable_data.instructions.wording.words import singular

_SHOWN = 60  # characters of an instruction in a message

_LOOK = "look"
"""Kind of a relation whose target has the words of a new look before its noun."""

_NO_MOVES = frozenset({"replace", "style", _LOOK, "swap", PLACE})
"""Kinds of goals that state no relation of their subject to their target."""

Meanings = Mapping[int, Sequence[str]]
"""The instances that each number of the reading means."""


class EditPlanner:
    """Plans edits.

    Args:
        interpret: Interprets instructions.
        statistics: The usual sizes of categories.
    """

    def __init__(self, interpret: InstructionInterpreter, statistics: CategoryStatistics) -> None:
        self._interpret, self._statistics = interpret, statistics

    def __call__(self, question: ReasonerQuestion) -> LayoutReply:
        """Returns the reply to an edit.

        Raises:
            SceneError: The instruction states no change that is understood (``edit_unread``), an object that the edit needs is
                not in the layout (``object_missing``), or several fit (``ambiguous``).
        """
        text, lexicon = question.instruction, self._interpret.lexicon
        reading = with_spoken_changes(self._interpret(text, is_edit=True).reading, text, lexicon, self._is_detail)
        plan = LayoutPlan(question, self._statistics)
        objects, layout = reading.objects, list(plan.objects.values())
        candidates = Candidates(layout, lexicon, self._interpret.most_similar)
        resolver = MentionResolver(text, reading, layout, question.table, candidates)
        goals, needed, changed = _goals(reading, resolver)
        if not needed:
            raise _unread(text)
        meanings = resolver.resolve(needed, changed)
        goals = [_as_style(r, objects) for r in goals]
        for k in resolver.new:
            is_look = any(r.kind in ("style", _LOOK) and r.target == k for r in goals)
            if not is_look and (objects[k].categories or any((r.subject, r.kind) == (k, "replace") for r in goals)):
                meanings[k] = (plan.create(objects[k], text),)
        goals = plan.with_contents(_without_own(goals, meanings), meanings)
        _exchange(plan, goals, meanings)
        _restyle(plan, goals, meanings, objects)
        for k, o in enumerate(objects):
            for name in meanings.get(k, ()) if o.change == "remove" else ():
                plan.remove(name)
        _move(plan, goals, meanings, objects, resolver)
        reply = plan.reply()
        if not (reply.removed or reply.objects or plan.is_so):
            raise _unread(text)
        return reply

    def _is_detail(self, category: str, word: str) -> bool:
        """Whether descriptions of a category have a word, such as ``lid`` for jars."""
        known = self._statistics.categories.get(category)
        return known is not None and bool({word, *singular((word,))} & known.words.keys())


def _unread(text: str) -> SceneError:
    message = f"no change is understood in {text[:_SHOWN]!r}"
    return SceneError(f"{message}; say what goes, comes, moves, is replaced or gets another look", "edit_unread")


def _goals(reading: InstructionReading, resolver: MentionResolver) -> tuple[list[MentionedRelation], set[int], set[int]]:
    """The goals with their mover first, the numbers of the objects that they need, and of those that change."""
    acted = {k for k, o in enumerate(reading.objects) if o.change or o.goal_region}
    goals = [resolver.with_mover_first(r) for r in reading.goal if not _is_empty_look(r, reading.objects)]
    goals = list(_without_surroundings(goals, resolver, acted))
    if any(not resolver.is_idle(k) for k in acted | {r.subject for r in goals}):
        acted = {k for k in acted if not resolver.is_idle(k)}
        goals = [r for r in goals if not resolver.is_idle(r.subject)]
    goals += _elliptic(reading, resolver, goals, acted)
    needed = acted | {n for r in goals for n in (r.subject, r.target)}
    needed |= {r.target for r in reading.start if r.kind == OTHER and r.subject in needed}
    return goals, needed, acted | {r.subject for r in goals}


def _exchange(plan: LayoutPlan, goals: Sequence[MentionedRelation], meanings: Meanings) -> None:
    for r in goals:
        subjects, targets = meanings.get(r.subject, ()), meanings.get(r.target, ())
        if r.kind == "replace":
            for new, old in _pairs(meanings, r):
                plan.put_in_place(new, old, is_replaced=True)
        elif r.kind == "swap" and subjects and targets and subjects[0] < targets[0]:
            plan.exchange(subjects[0], targets[0])


def _restyle(
    plan: LayoutPlan, goals: Sequence[MentionedRelation], meanings: Meanings, objects: Sequence[MentionedObject]
) -> None:
    """Gives objects another look; of several that shall look alike, those that look so already stay."""
    looks: dict[str, dict[str, None]] = {}
    for r in goals:
        if r.kind in ("style", _LOOK):
            look = objects[r.target]
            is_alike = bool(set(look.categories) & set(objects[r.subject].categories))
            is_plain = is_alike and head_of(look.words) == singular((look.words.split()[-1],))[0]  # "white mugs"
            words = (is_plain and " ".join(adjectives_of(look))) or look.words
            looks.setdefault(words, {}).update(dict.fromkeys(meanings.get(r.subject, ())))
    for words, names in looks.items():
        for name in [n for n in names if not plan.has_look(n, words)] or names:
            plan.restyle(name, words)


def _move(
    plan: LayoutPlan,
    goals: Sequence[MentionedRelation],
    meanings: Meanings,
    objects: Sequence[MentionedObject],
    resolver: MentionResolver,
) -> None:
    """Moves objects; what takes the place of another one comes last, when that has left."""
    at_place = [pair for r in goals if r.kind == PLACE for pair in _pairs(meanings, r)]
    moves = plan.with_carriers(_moves(objects, goals, meanings, plan), resolver)
    moves = {name: wanted for name, wanted in moves.items() if name not in dict(at_place)}
    for name, wanted in _targets_first({n: w for n, w in moves.items() if not plan.comes_along(n, w, moves)}):
        plan.move(name, wanted)
    for mover, other in at_place:
        plan.put_in_place(mover, other, is_replaced=False)


def _pairs(meanings: Meanings, r: MentionedRelation) -> Iterator[tuple[str, str]]:
    return zip(meanings.get(r.subject, ()), meanings.get(r.target, ()), strict=False)


def _is_empty_look(r: MentionedRelation, objects: Sequence[MentionedObject]) -> bool:
    """Whether the words of a new look describe nothing, as in "much handier"."""
    words = objects[r.target].words
    return r.kind == "style" and not look_words(words) and yaw_after_turn(split_words(words), 0) is None


def _elliptic(
    reading: InstructionReading, resolver: MentionResolver, goals: Sequence[MentionedRelation], acted: Set[int]
) -> Iterator[MentionedRelation]:
    """Goals that are read as stated of the start, where they do not hold: "the mug in grey, the case behind it".

    Only an object of which nothing else is said moves so, and only in an edit of several changes.
    """
    said = acted | {r.subject for r in goals}
    for stated in reading.start if said else ():
        r = resolver.with_mover_first(stated)
        is_open = r.kind in SIDES and r.target in said and r.subject not in said | {t.target for t in goals}
        if is_open and resolver.is_certainly_not(r):
            yield r


def _without_own(goals: Sequence[MentionedRelation], meanings: Meanings) -> list[MentionedRelation]:
    """The goals without those of an object to itself, or to all of its kind ("the pens belong together, lay this one ...")."""
    return [
        r
        for r in goals
        if r.kind in _NO_MOVES or not meanings.get(r.subject) or not set(meanings[r.subject]) <= set(meanings.get(r.target, ()))
    ]


def _without_surroundings(
    goals: Sequence[MentionedRelation], resolver: MentionResolver, acted: Set[int]
) -> Iterator[MentionedRelation]:
    """The goals without those to unknown things around the table, where the edit says more of the same object."""
    known = [r for r in goals if not resolver.is_unknown(r.target)]
    placed = acted | {r.subject for r in known}
    return (r for r in goals if r in known or r.subject not in placed)


def _as_style(r: MentionedRelation, objects: Sequence[MentionedObject]) -> MentionedRelation:
    """A replacement by objects of the same kind, as in "the napkins by white ones", as a new look of the old ones."""
    new, old = objects[r.subject], objects[r.target]
    if r.kind != "replace" or len(new.words.split()) < 2 or not set(new.categories) & set(old.categories):
        return r
    if set(new.categories) != set(old.categories) and head_of(new.words) != head_of(old.words):
        return r  # "the cube by a building block"
    return MentionedRelation(r.target, _LOOK, r.subject, r.score)


def _moves(
    objects: Sequence[MentionedObject],
    goals: Sequence[MentionedRelation],
    meanings: Meanings,
    plan: LayoutPlan,
) -> Moves:
    moves: dict[str, dict[str, list[str]]] = {}
    ends: dict[str, dict[tuple[str, ...], None]] = {}
    for r in goals:
        if r.kind not in _NO_MOVES:
            for name in meanings.get(r.subject, ()):
                moves.setdefault(name, {}).setdefault(r.kind, []).extend(meanings.get(r.target, ()))
                if r.kind == "between":
                    ends.setdefault(name, {})[tuple(meanings.get(r.target, ()))] = None
    for name, groups in ends.items():
        if len(groups) == 2:
            moves[name]["between"] = plan.nearest(*groups)  # "between the lamp and the row of books"
    for name, o in ((name, o) for k, o in enumerate(objects) for name in meanings.get(k, ())):
        if o.goal_region and name not in moves:
            moves[name] = {"at": [o.goal_region]}
        elif o.change in ("away", "add") and name not in moves and name not in plan.placed:
            moves[name] = {"away": []}
    return moves


def _targets_first(moves: Moves) -> Iterator[tuple[str, Mapping[str, Sequence[str]]]]:
    """The moves in an order in which an object moves after those that it goes to."""
    left = dict(moves)
    while left:
        targets = {n: {t for names in wanted.values() for t in names} - {n} for n, wanted in left.items()}
        name = next((n for n in left if not targets[n] & left.keys()), "")
        name = name or next(iter(left))  # they go to each other
        yield name, left.pop(name)
