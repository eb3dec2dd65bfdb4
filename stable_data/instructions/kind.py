"""Kinds of task, and how a template of a kind becomes a task of a scene.

A template has its roles in braces, ``put {x} into {y}``. ``{x}`` is a name with its article, ``{x:short}`` a name without a
clause after its noun. ``{x:it}`` and the other words of ``_GRAMMAR`` agree with the name in number. ``{xs:=everything}`` is a
role for which the template itself gives the words.
"""

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from stable_data.condition import GoalCondition
from stable_data.instructions.ends import End
from stable_data.instructions.naming import WEIGHTS, Distinction, ObjectName, ObjectNamer, holds_relation
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.paraphrase import reword
from stable_data.instructions.wording.vocabulary import answers_to, is_counted
from stable_data.instructions.wording.words import is_plural, join_words, number_word, plural, type_name
from stable_data.scene import Relation, RelationKind

Roles: TypeAlias = Mapping[str, str | tuple[str, ...]]
"""Instances by role: one in ``x``, ``y``, ``z``, ``w``; several in ``xs``, ``zs``; other keys hold words of the template."""

Finder: TypeAlias = Callable[[TaskContext], Iterator[Roles]]

SINGLE, SEVERAL = ("x", "y", "z", "w"), ("xs", "zs")
MAX_LISTED = 4
"""Largest number of objects of one role that a text names one by one."""

_ATTEMPTS = 8  # assignments of objects to roles that a kind tries before it returns None
_GRAMMAR = {  # singular, plural
    "it": ("it", "them"),
    "they": ("it", "they"),
    "its": ("its", "their"),
    "is": ("is", "are"),
    "was": ("was", "were"),
    "has": ("has", "have"),
    "s": ("s", ""),
    "es": ("es", ""),
}


@dataclass(frozen=True, slots=True)
class TaskKind:
    """A kind of task.

    Attributes:
        name: Unique.
        find: Yields feasible assignments of objects to its roles, in random order.
        texts: Templates: clauses without a full stop, or whole sentences; each contains all roles.
        goal: Templates of sentences that hold when the task is done.
        actions: Templates of primitives, filled with types instead of names; a line with several objects is repeated for each.
        links: Relations that the words state: first role, kind, second role. The kind is None (in or on), a
            :class:`RelationKind`, or a key of the roles whose value is one.
        theme: The topic of the reasons that the request may give (see ``paraphrase``).
        ends: What ``goal`` states as conditions; none if no state of the scene shows that the task is done.
    """

    name: str
    find: Finder
    texts: tuple[str, ...]
    goal: tuple[str, ...]
    actions: tuple[str, ...]
    links: tuple[tuple[str, str | None, str], ...] = ()
    theme: str = ""
    ends: tuple[End, ...] = ()

    def draft(self, context: TaskContext, namer: ObjectNamer) -> "TaskDraft | None":
        """Returns a task of this kind, or None if none was found in the scene."""
        for roles in itertools.islice(self.find(context), _ATTEMPTS):
            text = context.pick(self.texts)
            names = _names_for(self, roles, text, context, namer)
            if names is not None:
                return _draft_of(self, roles, text, names, context, namer)
        return None


@dataclass(frozen=True, slots=True)
class TaskDraft:
    """A task of a scene, before the request is framed.

    Attributes:
        text: A clause or sentences.
        goal: Sentences.
        actions: Primitives.
        objects: All objects that the words refer to, in the order of the roles, then the anchors.
        nouns: The nouns of the objects.
        relations: The relations that the words state about the initial scene.
        theme: See :class:`TaskKind`.
        conditions: What ``goal`` states as conditions; none if not all of it can be.
    """

    text: str
    goal: tuple[str, ...]
    actions: tuple[str, ...]
    objects: tuple[str, ...]
    nouns: tuple[str, ...]
    relations: tuple[Relation, ...]
    theme: str = ""
    conditions: tuple[GoalCondition, ...] = ()


@dataclass(frozen=True, slots=True)
class _Phrase:
    """The words for a role, as a value of :meth:`str.format_map`."""

    words: str
    is_plural: bool

    def __format__(self, spec: str) -> str:
        if spec.startswith("="):
            return spec[1:]
        return self.words if spec in ("", "short") else _GRAMMAR[spec][self.is_plural]


def members(roles: Roles) -> dict[str, tuple[str, ...]]:
    """Returns the instances of each role."""
    found = {role: roles[role] for role in (*SINGLE, *SEVERAL) if role in roles}
    return {role: (names,) if isinstance(names, str) else names for role, names in found.items()}


# --- names for the roles ------------------------------------------------------------------------------------------------------


def _names_for(
    kind: TaskKind, roles: Roles, text: str, context: TaskContext, namer: ObjectNamer
) -> dict[str, ObjectName] | None:
    """A name for each object that the text names one by one; None if the words would be ambiguous."""
    by_role = members(roles)
    every = [n for names in by_role.values() for n in names]
    if len(set(every)) < len(every):
        return None
    names: dict[str, ObjectName] = {}
    nouns = set()
    for role, objects in by_role.items():
        formats = set(re.findall(rf"\{{{role}(?::(\w+))?\}}", text))
        if formats & {"", "short"}:
            alone = [n for n in objects if n not in _whole_kinds(objects, context, namer)]
            if len(alone) > MAX_LISTED:
                return None
            for n in alone:
                options = _options(kind, role, n, names, every, roles, namer)
                name = _draw_name([o for o in options if o.is_short or "short" not in formats], context)
                if name is None:
                    return None
                names[n] = name
            nouns |= {namer.own_noun(n) for n in objects if n not in alone}
    return names if _are_distinguishable(list(names.values()), nouns, namer) else None


def _whole_kinds(objects: Sequence[str], context: TaskContext, namer: ObjectNamer) -> dict[str, str]:
    """The objects whose whole category is among ``objects``, with its noun: the text can say ``all mugs``."""
    found: dict[str, str] = {}
    for alike in context.kinds(objects):
        noun = namer.own_noun(alike[0])
        if len(alike) > 1 and is_counted(noun) and not is_plural(noun) and set(namer.matching(noun)) == set(alike):
            found |= dict.fromkeys(alike, noun)
    return found


def _options(
    kind: TaskKind,
    role: str,
    instance: str,
    names: Mapping[str, ObjectName],
    every: Sequence[str],
    roles: Roles,
    namer: ObjectNamer,
) -> list[ObjectName]:
    """Names for one object. Another object of the task is never its anchor, and only one name of a task has an anchor."""
    places = [roles[b] for a, kind_of_link, b in kind.links if a == role and kind_of_link is None]
    options = [name for name in namer.names(instance) if name.anchor not in every]
    if places and not any(name.distinction is Distinction.NOUN for name in options):
        options += namer.linked_names(instance, str(places[0]))
    if any(name.anchor for name in names.values()):
        options = [name for name in options if name.anchor is None]
    if places:  # the template states the container already
        options = [name for name in options if name.distinction is not Distinction.CARRIER]
    return options


def _draw_name(options: Sequence[ObjectName], context: TaskContext) -> ObjectName | None:
    # The kind of distinction is drawn first: an object with many names of one kind does not use that kind more often.
    distinctions = sorted({name.distinction for name in options})
    if not distinctions:
        return None
    weights = [WEIGHTS[distinction] for distinction in distinctions]
    shares = [w / sum(weights) for w in weights]
    distinction = distinctions[int(context.rng.choice(len(distinctions), p=shares))]
    return context.pick([name for name in options if name.distinction is distinction])


def _are_distinguishable(names: Sequence[ObjectName], kinds: set[str], namer: ObjectNamer) -> bool:
    """Whether no name equals another name or its end: "the mug" is ambiguous beside "the coffee mug"."""
    if len({name.words for name in names}) < len(names):
        return False
    nouns = [name.noun for name in names] + sorted(kinds)
    nouns += [namer.own_noun(name.anchor) for name in names if name.anchor]
    bare = {
        name.noun for name in names if name.distinction in (Distinction.LINK, Distinction.NOUN, Distinction.SYNONYM)
    } | kinds
    for a, b in itertools.combinations(nouns, 2):
        if a == b and a in bare:
            return False
        if a != b and (a.endswith(b) or b.endswith(a)):
            return False
    return True


# --- drafts -------------------------------------------------------------------------------------------------------------------


def _draft_of(
    kind: TaskKind, roles: Roles, text: str, names: Mapping[str, ObjectName], context: TaskContext, namer: ObjectNamer
) -> TaskDraft:
    by_role = members(roles)
    words = {key: value for key, value in roles.items() if key not in by_role}
    before = {role: _phrase(objects, names, context, namer) for role, objects in by_role.items()}
    later = {n: _name_afterwards(n, name, names, namer) for n, name in names.items()}
    after = {role: _phrase(objects, later, context, namer) for role, objects in by_role.items()}
    objects = [n for of_role in by_role.values() for n in of_role]
    anchors = [name.anchor for name in names.values() if name.anchor and name.anchor not in objects]
    relations = {name.relation for name in names.values() if name.relation}
    relations |= set(_stated_relations(kind, by_role, words, context))
    nouns = [name.noun for name in names.values()] + [namer.own_noun(n) for n in [*objects, *anchors]]
    return TaskDraft(
        reword(text, context.rng).format_map({**words, **before}),
        tuple(goal.format_map({**words, **after}) for goal in kind.goal),
        tuple(action for line in kind.actions for action in _actions_of(line, by_role, words, context)),
        tuple(dict.fromkeys([*objects, *anchors])),
        tuple(dict.fromkeys(nouns)),
        tuple(sorted(relations)),
        kind.theme,
        tuple(dict.fromkeys(c for end in kind.ends for c in end.filled(by_role, words))),
    )


def _phrase(objects: Sequence[str], names: Mapping[str, ObjectName], context: TaskContext, namer: ObjectNamer) -> _Phrase:
    """Words for the objects of a role: single names, and ``both mugs`` for a whole category."""
    kinds = _whole_kinds(objects, context, namer) if len(objects) > 1 else {}
    parts = []
    for n in objects:
        if n in kinds:
            parts.append(
                _all_of(kinds[n], sum(noun == kinds[n] for noun in kinds.values()), is_only=len(kinds) == len(objects))
            )
        elif n in names:
            parts.append(names[n].words)
    words = join_words(list(dict.fromkeys(parts))) if parts else ""
    noun = names[objects[0]].noun if objects[0] in names else namer.own_noun(objects[0])
    return _Phrase(words, len(objects) > 1 or is_plural(noun))


def _all_of(noun: str, count: int, *, is_only: bool) -> str:
    if count == 2:
        return f"both {plural(noun)}"
    return f"all {number_word(count)} {plural(noun)}" if is_only else f"the {number_word(count)} {plural(noun)}"


def _name_afterwards(instance: str, name: ObjectName, names: Mapping[str, ObjectName], namer: ObjectNamer) -> ObjectName:
    """A name that is true after the task: the bare noun if no other named object matches it."""
    noun = namer.own_noun(instance)
    others = (n for n in names if n != instance)
    if name.is_lasting or not noun or any(answers_to(namer.objects[n].category, noun) for n in others):
        return name
    return replace(name, words=f"the {noun}", noun=noun)


def _actions_of(
    line: str, by_role: Mapping[str, Sequence[str]], words: Mapping[str, str | tuple[str, ...]], context: TaskContext
) -> Iterator[str]:
    """The primitives of a line, repeated for each object of a role with several."""
    group = next((role for role in SEVERAL if f"{{{role}}}" in line), None)
    for member in by_role[group] if group else (None,):
        types = {
            role: type_name(context.objects[member if role == group and member else objects[0]].category) or "Object"
            for role, objects in by_role.items()
        }
        yield from line.format_map({**words, **types}).split("; ")


def _stated_relations(
    kind: TaskKind, by_role: Mapping[str, Sequence[str]], words: Mapping[str, str | tuple[str, ...]], context: TaskContext
) -> Iterator[Relation]:
    for one, link, other in kind.links:
        stated = (RelationKind.IN, RelationKind.ON) if link is None else (RelationKind(str(words.get(link, link))),)
        for a, b in itertools.product(by_role[one], by_role[other]):
            for k in stated:
                relation = holds_relation(context.graph, a, k, b)
                if relation is not None:
                    yield relation
