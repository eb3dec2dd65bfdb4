"""What a kind of task is, and how one of its texts is told of a scene.

A text names its roles in braces, ``put {x} into {y}``. ``{x}`` is a name with its article, ``{x:short}`` one without a clause
after its noun; ``{x:it}`` and the other words of ``_GRAMMAR`` agree with it in number; ``{xs:=everything}`` stands for a role
in words that the text gives itself.
"""

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from stable_data.instructions.naming import WEIGHTS, Distinction, ObjectName, ObjectNamer, holds_relation
from stable_data.instructions.situation import TaskContext
from stable_data.instructions.wording.paraphrase import reword
from stable_data.instructions.wording.vocabulary import answers_to, is_counted
from stable_data.instructions.wording.words import is_plural, join_words, number_word, plural, type_name
from stable_data.scene import Relation, RelationKind

Roles: TypeAlias = Mapping[str, str | tuple[str, ...]]
"""Instances by role: ``x``, ``y``, ``z``, ``w``; several in ``xs`` and ``zs``; other keys hold words of the text."""

Finder: TypeAlias = Callable[[TaskContext], Iterator[Roles]]

SINGLE, SEVERAL = ("x", "y", "z", "w"), ("xs", "zs")
MOST_LISTED = 4
"""Objects that are named one by one in a text."""

_ATTEMPTS = 8  # role fillings that a kind may try before it gives up
_GRAMMAR = {  # of one thing, of several
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
        find: What may fill its roles, in drawn order.
        texts: Clauses without a full stop, or whole sentences; every text names every role.
        goal: Sentences that hold when it is done.
        actions: Primitives, with types in place of names; what mentions several objects is repeated for each.
        links: Roles of which the words say that the first is in or on the second (kind None), or in some other relation to it:
            a :class:`RelationKind`, or a key of the roles that holds one.
        theme: What reasons it may be given (see ``paraphrase``).
    """

    name: str
    find: Finder
    texts: tuple[str, ...]
    goal: tuple[str, ...]
    actions: tuple[str, ...]
    links: tuple[tuple[str, str | None, str], ...] = ()
    theme: str = ""

    def tell(self, situation: TaskContext, namer: ObjectNamer) -> "TaskDraft | None":
        """A task of this kind, or None where the scene has none."""
        for roles in itertools.islice(self.find(situation), _ATTEMPTS):
            text = situation.pick(self.texts)
            names = _names_for(self, roles, text, situation, namer)
            if names is not None:
                return _told(self, roles, text, names, situation, namer)
        return None


@dataclass(frozen=True, slots=True)
class TaskDraft:
    """A task told of a scene.

    Attributes:
        text: A clause or sentences.
        goal: Sentences.
        actions: Primitives.
        objects: Every object that the words name or mean, in the order of the roles, anchors last.
        nouns: What the objects are called.
        relations: What the words say of the start.
        theme: See :class:`TaskKind`.
    """

    text: str
    goal: tuple[str, ...]
    actions: tuple[str, ...]
    objects: tuple[str, ...]
    nouns: tuple[str, ...]
    relations: tuple[Relation, ...]
    theme: str = ""


@dataclass(frozen=True, slots=True)
class _Phrase:
    """What stands for a role."""

    words: str
    is_plural: bool

    def __format__(self, spec: str) -> str:
        if spec.startswith("="):
            return spec[1:]
        return self.words if spec in ("", "short") else _GRAMMAR[spec][self.is_plural]


def members(roles: Roles) -> dict[str, tuple[str, ...]]:
    """The instances of every role."""
    found = {role: roles[role] for role in (*SINGLE, *SEVERAL) if role in roles}
    return {role: (names,) if isinstance(names, str) else names for role, names in found.items()}


# --- names for the roles ------------------------------------------------------------------------------------------------------


def _names_for(
    kind: TaskKind, roles: Roles, text: str, situation: TaskContext, namer: ObjectNamer
) -> dict[str, ObjectName] | None:
    """A name for each object that the text names one by one; None where the words could not tell them apart."""
    spoken = members(roles)
    every = [n for names in spoken.values() for n in names]
    if len(set(every)) < len(every):
        return None
    names: dict[str, ObjectName] = {}
    nouns = set()
    for role, objects in spoken.items():
        said_as = set(re.findall(rf"\{{{role}(?::(\w+))?\}}", text))
        if said_as & {"", "short"}:
            alone = [n for n in objects if n not in _as_kinds(objects, situation, namer)]
            if len(alone) > MOST_LISTED:
                return None
            for n in alone:
                options = _options(kind, role, n, names, every, roles, namer)
                name = _drawn([o for o in options if o.is_short or "short" not in said_as], situation)
                if name is None:
                    return None
                names[n] = name
            nouns |= {namer.own_noun(n) for n in objects if n not in alone}
    if not _can_be_told_apart(list(names.values()), nouns, namer):
        return None
    return names


def _as_kinds(objects: Sequence[str], situation: TaskContext, namer: ObjectNamer) -> dict[str, str]:
    """Of several objects those that are all of their kind in the scene, with the words for their kind."""
    found: dict[str, str] = {}
    for alike in situation.kinds(objects):
        noun = namer.own_noun(alike[0])
        if len(alike) > 1 and is_counted(noun) and not is_plural(noun) and set(namer.answering(noun)) == set(alike):
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
    """Names for one object; no other object of the task is its anchor, and only one name of a task has an anchor."""
    places = [roles[b] for a, kind_of_link, b in kind.links if a == role and kind_of_link is None]
    options = [name for name in namer.names(instance) if name.anchor not in every]
    if places and not any(name.telling is Distinction.NOUN for name in options):
        options += namer.linked_names(instance, str(places[0]))
    if any(name.anchor for name in names.values()):
        options = [name for name in options if name.anchor is None]
    if places:  # what it is in is said anyway
        options = [name for name in options if name.telling is not Distinction.CARRIER]
    return options


def _drawn(options: Sequence[ObjectName], situation: TaskContext) -> ObjectName | None:
    tellings = sorted({name.telling for name in options})
    if not tellings:
        return None
    weights = [WEIGHTS[telling] for telling in tellings]
    shares = [w / sum(weights) for w in weights]
    telling = tellings[int(situation.rng.choice(len(tellings), p=shares))]
    return situation.pick([name for name in options if name.telling is telling])


def _can_be_told_apart(names: Sequence[ObjectName], kinds: set[str], namer: ObjectNamer) -> bool:
    """Do no two names read the same, or differ by nothing but a word that another leaves out?"""
    if len({name.words for name in names}) < len(names):
        return False
    nouns = [name.noun for name in names] + sorted(kinds)
    nouns += [namer.own_noun(name.anchor) for name in names if name.anchor]
    bare = {name.noun for name in names if name.telling in (Distinction.LINK, Distinction.NOUN, Distinction.SYNONYM)} | kinds
    for a, b in itertools.combinations(nouns, 2):
        if a == b and a in bare:
            return False
        if a != b and (a.endswith(b) or b.endswith(a)):
            return False
    return True


# --- telling ------------------------------------------------------------------------------------------------------------------


def _told(
    kind: TaskKind, roles: Roles, text: str, names: Mapping[str, ObjectName], situation: TaskContext, namer: ObjectNamer
) -> TaskDraft:
    spoken = members(roles)
    words = {key: value for key, value in roles.items() if key not in spoken}
    said = {role: _phrase(objects, names, situation, namer) for role, objects in spoken.items()}
    later = {n: _afterwards(n, name, names, namer) for n, name in names.items()}
    done = {role: _phrase(objects, later, situation, namer) for role, objects in spoken.items()}
    objects = [n for of_role in spoken.values() for n in of_role]
    anchors = [name.anchor for name in names.values() if name.anchor and name.anchor not in objects]
    relations = {name.relation for name in names.values() if name.relation}
    relations |= set(_linked(kind, spoken, words, situation))
    nouns = [name.noun for name in names.values()] + [namer.own_noun(n) for n in [*objects, *anchors]]
    return TaskDraft(
        reword(text, situation.rng).format_map({**words, **said}),
        tuple(goal.format_map({**words, **done}) for goal in kind.goal),
        tuple(action for line in kind.actions for action in _acted(line, spoken, words, situation)),
        tuple(dict.fromkeys([*objects, *anchors])),
        tuple(dict.fromkeys(nouns)),
        tuple(sorted(relations)),
        kind.theme,
    )


def _phrase(objects: Sequence[str], names: Mapping[str, ObjectName], situation: TaskContext, namer: ObjectNamer) -> _Phrase:
    """Words for the objects of a role: names one by one, and ``both mugs`` for all of a kind."""
    kinds = _as_kinds(objects, situation, namer) if len(objects) > 1 else {}
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


def _afterwards(instance: str, name: ObjectName, names: Mapping[str, ObjectName], namer: ObjectNamer) -> ObjectName:
    """A name that still holds when things have been moved: the bare noun where no other named object answers to it."""
    noun = namer.own_noun(instance)
    others = (n for n in names if n != instance)
    if name.is_lasting or not noun or any(answers_to(namer.objects[n].category, noun) for n in others):
        return name
    return replace(name, words=f"the {noun}", noun=noun)


def _acted(
    line: str, spoken: Mapping[str, Sequence[str]], words: Mapping[str, str | tuple[str, ...]], situation: TaskContext
) -> Iterator[str]:
    """The primitives of a line, once for each of several objects that it mentions."""
    group = next((role for role in SEVERAL if f"{{{role}}}" in line), None)
    for member in spoken[group] if group else (None,):
        types = {
            role: type_name(situation.objects[member if role == group and member else objects[0]].category) or "Object"
            for role, objects in spoken.items()
        }
        yield from line.format_map({**words, **types}).split("; ")


def _linked(
    kind: TaskKind, spoken: Mapping[str, Sequence[str]], words: Mapping[str, str | tuple[str, ...]], situation: TaskContext
) -> Iterator[Relation]:
    for one, link, other in kind.links:
        said = (RelationKind.IN, RelationKind.ON) if link is None else (RelationKind(str(words.get(link, link))),)
        for a, b in itertools.product(spoken[one], spoken[other]):
            for k in said:
                relation = holds_relation(situation.graph, a, k, b)
                if relation is not None:
                    yield relation
