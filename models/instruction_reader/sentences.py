"""Makes labelled sentences from frames: nouns, phrases, additions, joined frames, and the noise of real text."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from random import Random

from models.instruction_reader.frames import ANY_RELATION, SLOT, Frame, FrameFact
from models.instruction_reader.nouns import NounPools
from models.instruction_reader.phrases import (
    ADJECTIVES,
    CLOSINGS,
    COUNT_WORDS,
    DETAILS,
    DETERMINERS,
    MODIFIERS,
    OPENINGS,
    PHRASES,
    REGIONS,
    RELATIONS,
)
from stable_data.instructions.wording.words import is_plural, plural

WORD = re.compile(r"[^\W\d_]+|\d+|[^\w\s]")
"""A word, a number or a punctuation mark."""

MOST_MENTIONS = 16
"""Mentions of one sentence; longer drafts are made again."""

EDIT_MARK = ("edit", ":")
"""Words before an edit, which tell the network that a scene shall be changed."""

_OPEN, _CLOSE = 0xE000, "\uf000"  # private characters around a mention; the first one tells the object

_JOINS = 0.4  # share of sentences of two frames
_SHARES_OBJECT = 0.5  # share of these in which both frames have an object in common
_MODIFIES = 0.15  # share of sentences with an addition after a noun
_DETAILS = 0.05  # share of nouns with a description after them
_DETERMINES = 0.2  # share of "the" before a noun that becomes another determiner
_DESCRIBES = (0.55, 0.37, 0.08)  # shares of objects with 0, 1, 2 adjectives
_OPENS, _CLOSES = 0.15, 0.15  # shares of sentences with an opening, a closing
_TYPES_BADLY = 0.25  # share of sentences with typing errors,
_TYPING_ERRORS = (0.05, 0.3)  # and range of the share of words with one in these
_SHORTENS = 0.35  # share of further mentions of an object with the last word of its noun alone
_WITHOUT_MARKS, _WITHOUT_APOSTROPHES, _WITHOUT_ARTICLES = 0.15, 0.1, 0.06
_COUNTS = ((2, 0.62), (3, 0.22), (4, 0.08), (5, 0.04), (6, 0.02), (7, 0.01), (8, 0.01))

_ARTICLES = frozenset({"the", "a", "an"})
_MANY = frozenset(
    {
        "they", "them", "these", "those", "others", "rest", "both", "all", "ones", "two", "three", "four", "which", "everything",
    }
)  # fmt: skip
"""Words of mentions that mean several objects."""
_ENDS_NOUN = re.compile(r"(?=[ .,;:?!]|$)(?! (?:of|and|or)\b)")
_FIXED = re.compile(r"\b(?:the|my|your|our|his|her|their|these|those|all|both|of the|other|same|last|first|only)$")


@dataclass(frozen=True, slots=True)
class ObjectLabels:
    """What a sentence says of one object, or of several under one name.

    Attributes:
        count: Number of objects; 0 for a plural without a number.
        region: Cell of the table at the start, or empty.
        goal_region: Cell of the table after the task, or empty.
        group: ``stack``, ``nest``, ``row`` or ``file`` if several are so at the start, or empty.
        goal_group: The same after the task.
        is_filled: Whether it holds objects without a name at the start.
        is_taken: Whether it is to be picked up or used, with no place stated.
        change: ``remove``, ``add`` or ``away`` in an edit, or empty.
    """

    count: int = 1
    region: str = ""
    goal_region: str = ""
    group: str = ""
    goal_group: str = ""
    is_filled: bool = False
    is_taken: bool = False
    change: str = ""


@dataclass(frozen=True, slots=True)
class LabelledSentence:
    """A sentence with its labels.

    Attributes:
        words: Its words, in lower case.
        mentions: First and last word, and object, of each mention, in the order of the text.
        objects: The labels of the objects.
        start: Relations at the start, (subject, kind, target); kinds ``in on left front near between part``.
        goal: Relations after the task; the same kinds except ``part``, and ``replace style swap`` in an edit.
    """

    words: tuple[str, ...]
    mentions: tuple[tuple[int, int, int], ...]
    objects: tuple[ObjectLabels, ...]
    start: frozenset[tuple[int, str, int]]
    goal: frozenset[tuple[int, str, int]]


def split_words(text: str) -> list[str]:
    """Splits a text into words, numbers and punctuation marks, in lower case."""
    return [word.lower() for word in WORD.findall(text)]


@dataclass(slots=True)
class _Draft:
    """One or two frames with their objects under common numbers."""

    texts: list[tuple[str, Mapping[str, int], str]] = field(default_factory=list)  # text, number by name, relation of <r>
    facts: list[tuple[str, int, tuple[int | str, ...], bool]] = field(default_factory=list)
    is_edit: bool = False
    counts: dict[int, int] = field(default_factory=dict)
    pools: dict[int, str] = field(default_factory=dict)
    size: int = 0


class SentenceMaker:
    """Makes labelled sentences.

    Args:
        frames: The frames.
        nouns: The nouns.
    """

    def __init__(self, frames: Sequence[Frame], nouns: NounPools) -> None:
        self._frames, self._nouns = frames, nouns
        self._by_kind = {is_edit: [f for f in frames if f.is_edit is is_edit] for is_edit in (False, True)}

    def make(self, rng: Random) -> LabelledSentence:
        """Returns a sentence; it depends on the state of ``rng`` alone."""
        while True:
            draft = self._draft(rng)
            sentence = self._render(draft, rng)
            if sentence is not None:
                return sentence

    def make_of(self, frame: Frame, rng: Random) -> LabelledSentence | None:
        """Returns a sentence of one frame, or None if it would be too long."""
        draft = _Draft()
        self._add(draft, frame, rng)
        return self._render(draft, rng)

    # --- drafts ---

    def _draft(self, rng: Random) -> _Draft:
        draft = _Draft()
        first = rng.choice(self._frames)
        self._add(draft, first, rng)
        if rng.random() < _JOINS:
            second = rng.choice(self._by_kind[first.is_edit])
            if len(first.names) + len(second.names) <= 9:
                shared = _shared(first, second, rng) if rng.random() < _SHARES_OBJECT else None
                names = {shared[1]: draft.texts[0][1][shared[0]]} if shared else {}
                self._add(draft, second, rng, names)
        return draft

    def _add(self, draft: _Draft, frame: Frame, rng: Random, names: Mapping[str, int] | None = None) -> None:
        text, facts = _choose(frame.text, rng), list(frame.facts)
        draft.is_edit = frame.is_edit
        relation = rng.choice(RELATIONS)
        number = dict(names or {})
        found = list(_names(text))
        if rng.random() < _MODIFIES and (added := self._modified(text, facts, found, rng)) is not None:
            text, more = added
            facts += more
            found = list(_names(text))
        for name in found:
            if name not in number:
                number[name] = draft.size
                draft.size += 1
        for name, count in frame.counts.items():
            if name in number:
                draft.counts.setdefault(number[name], count)
        for name, pool in frame.pools.items():
            if name in number:
                draft.pools.setdefault(number[name], pool)
        for fact in facts:
            if {fact.subject, *(fact.targets if fact.kind != "at" else ())} <= number.keys():
                kind = relation if fact.kind == ANY_RELATION else fact.kind
                targets = fact.targets if kind == "at" else tuple(number[t] for t in fact.targets)
                draft.facts.append((kind, number[fact.subject], targets, fact.is_goal))
        draft.texts.append((text, number, relation))

    def _modified(
        self, text: str, facts: Sequence[FrameFact], names: Sequence[str], rng: Random
    ) -> tuple[str, list[FrameFact]] | None:
        """The text with an addition after a noun, and what it states; None if no noun takes one."""
        carried = {f.subject for f in facts if not f.is_goal and f.kind in ("in", "on", "under", ANY_RELATION)}
        spots = [m for m in re.finditer(r"\b[Tt]he \{([a-z])\}(?=[ ,.?!]|$)", text) if m[1] not in carried]
        free = next((c for c in "nmopqstuvwxyz" if c not in names), None)
        if not spots or free is None:
            return None
        spot, addition = rng.choice(spots), rng.choice(MODIFIERS)
        relation = rng.choice(RELATIONS)
        said = addition.replace("<r>", f"<{relation}>").replace("{n}", f"{{{free}}}")
        said = said if said.startswith(",") else f" {said}"
        return text[: spot.end()] + said + text[spot.end() :], [FrameFact(relation, spot[1], (free,))]

    # --- text ---

    def _render(self, draft: _Draft, rng: Random) -> LabelledSentence | None:
        draft.counts = {**_counts(draft, rng), **draft.counts}
        nouns = self._choose_nouns(draft, rng)
        adjectives = {k: _adjectives(rng) for k in range(draft.size)}
        parts = []
        said: set[int] = set()
        for text, number, relation in draft.texts:
            text = re.sub(r"\bthe (?=\{[a-z]\})", lambda _: _determiner(rng), text)
            pieces, end = [], 0
            for m in SLOT.finditer(text):
                pieces.append(text[end : m.start()])
                pieces.append(self._fill(m, number, relation, draft.counts, nouns, adjectives, said, "".join(pieces), rng))
                if m["name"] and m["kind"] == "" and _ENDS_NOUN.match(text, m.end()) and rng.random() < _DETAILS:
                    pieces.append(f" {rng.choice(DETAILS)}")
                end = m.end()
            parts.append("".join(pieces) + text[end:])
        text = _joined(parts, rng)
        if rng.random() < _OPENS:
            text = f"{rng.choice(OPENINGS)} {text}"
        if rng.random() < _CLOSES:
            text = re.sub(r"[.!?]$", "", text) + " " + rng.choice(CLOSINGS)
        return _labelled(text, draft, rng)

    def _fill(
        self,
        m: re.Match[str],
        number: Mapping[str, int],
        relation: str,
        counts: Mapping[int, int],
        nouns: Mapping[int, str],
        adjectives: Mapping[int, str],
        said: set[int],
        before: str,
        rng: Random,
    ) -> str:
        if m["phrase"]:
            return rng.choice(PHRASES[relation if m["phrase"] == ANY_RELATION else m["phrase"]])
        if m["kind"] == "~":
            noun = rng.choice(self._nouns.elsewhere) if rng.random() < 0.3 else self._nouns.sample("any", rng)
            return plural(noun) if m["form"] == "+" else noun
        k = number[m["name"] or m["who"]]
        if m["kind"] == "#":
            words = COUNT_WORDS.get(counts[k], (str(counts[k]),))
            bare = [w for w in words if not w.startswith(("a ", "half"))]
            return rng.choice(bare if _FIXED.search(before.rstrip()) else words)
        if m["words"]:
            return _marked(m["words"], k)
        noun = nouns[k]
        if m["form"] == "^" or (k in said and rng.random() < _SHORTENS and _is_clear(k, nouns)):
            noun = _head(noun)
        elif k not in said or rng.random() < 0.4:
            noun = f"{adjectives[k]}{noun}"
        if m["form"] == "+" and not is_plural(noun):
            noun = plural(noun)
        said.add(k)
        return _marked(noun, k)

    def _choose_nouns(self, draft: _Draft, rng: Random) -> dict[int, str]:
        pools = _pools_of(draft) | draft.pools
        whole = {subject: int(targets[0]) for kind, subject, targets, _ in draft.facts if kind == "of"}
        nouns: dict[int, str] = {}
        for k in range(draft.size):
            for _ in range(20):
                nouns[k] = self._nouns.sample(pools.get(k, "any"), rng)
                if nouns[k] not in [v for j, v in nouns.items() if j != k]:
                    break
        named = {
            number[m["name"]] for text, number, _ in draft.texts for m in SLOT.finditer(text) if m["name"] and m["kind"] == ""
        }
        for k, parent in whole.items():
            if parent in named:  # "all three" has no noun of its own, and its parts have different ones
                nouns[k] = nouns[parent]
        return nouns


def _head(noun: str) -> str:
    return noun.split(" of ")[0].split(" ")[-1]


def _is_clear(k: int, nouns: Mapping[int, str]) -> bool:
    """Whether the last word of the noun of object k means no other object of the sentence."""
    return all(_head(noun) != _head(nouns[k]) for j, noun in nouns.items() if j != k)


def _marked(words: str, k: int) -> str:
    return f"{chr(_OPEN + k)}{words}{_CLOSE}"


def _names(text: str) -> dict[str, None]:
    """Names of the objects of a text, in its order."""
    return dict.fromkeys(m["name"] or m["who"] for m in SLOT.finditer(text) if not m["phrase"] and m["kind"] != "~")


def _choose(text: str, rng: Random) -> str:
    """Chooses one of each group of alternatives; parentheses without a bar stay."""
    return re.sub(r"\(([^()]*\|[^()]*)\)", lambda m: rng.choice(m[1].split("|")), text)


def _shared(first: Frame, second: Frame, rng: Random) -> tuple[str, str] | None:
    """A name of each frame for a common object: singular, and carried in one of them at most."""

    def single(frame: Frame) -> list[tuple[str, bool]]:
        spoken = set(re.findall(r"\{([a-z])\}", frame.text)) - set(re.findall(r"\{[#]?([a-z])\+\}|\{#([a-z])", frame.text))
        parts = {f.subject for f in frame.facts if f.kind == "of"} | frame.counts.keys() | frame.pools.keys()
        carried = {f.subject for f in frame.facts if f.kind in ("in", "on", ANY_RELATION) and not f.is_goal}
        carried |= {t for f in frame.facts if f.kind in ("under", ANY_RELATION) and not f.is_goal for t in f.targets}
        return [(name, name in carried) for name in sorted(spoken - parts)]

    pairs = [(a, b) for a, one in single(first) for b, other in single(second) if not (one and other)]
    return rng.choice(pairs) if pairs else None


def _counts(draft: _Draft, rng: Random) -> dict[int, int]:
    """The counts of the objects by their slots: drawn for ``{#a}``, 0 for a bare plural, else 1."""
    counts = dict.fromkeys(range(draft.size), 1)
    for text, number, _ in draft.texts:
        for m in SLOT.finditer(text):
            if m["phrase"] or m["kind"] == "~":
                continue
            k = number[m["name"] or m["who"]]
            if m["kind"] == "#":
                counts[k] = rng.choices([c for c, _ in _COUNTS], [w for _, w in _COUNTS])[0]
            elif counts[k] == 1 and (m["form"] == "+" or (m["words"] and _is_many(m["words"]) and f"{{{m['who']}" not in text)):
                counts[k] = 0
    return counts


def _is_many(words: str) -> bool:
    return bool(set(words.lower().split()) & _MANY) and not words.lower().startswith(("one", "that", "another"))


def _pools_of(draft: _Draft) -> dict[int, str]:
    """Pools that fit the facts."""
    pools: dict[int, str] = {}
    for kind, subject, targets, _ in draft.facts:
        others = [t for t in targets if isinstance(t, int)]
        if kind in ("stack", "nest"):
            pools[subject] = "stackable"
        elif kind == "fill":
            pools[subject] = "container"
        elif kind in ("in", "on", "under"):
            item, place = (subject, others[0]) if kind != "under" else (others[0], subject)
            pools.setdefault(item, "small")
            if pools.get(place) not in ("container", "stackable"):
                pools[place] = "container" if kind == "in" else "carrier"
    return pools


def _adjectives(rng: Random) -> str:
    count = rng.choices((0, 1, 2), _DESCRIBES)[0]
    return "".join(f"{word} " for word in rng.sample(ADJECTIVES, count))


def _determiner(rng: Random) -> str:
    return f"{rng.choice(DETERMINERS) if rng.random() < _DETERMINES else 'the'} "


def _joined(parts: Sequence[str], rng: Random) -> str:
    if len(parts) == 1:
        return parts[0]
    first, second = parts
    first = first.rstrip()
    if first.endswith((".", "!", "?")) and rng.random() < 0.8:
        return f"{first} {second}"
    first = first.rstrip(".!?")
    return (
        f"{first}{rng.choice(['. ', '. ', '; ', ', and ', '. Also, ', '. And ', ' - ', '. Then ', ', then ', '... '])}{second}"
    )


# --- labels -------------------------------------------------------------------------------------------------------------------


def _labelled(text: str, draft: _Draft, rng: Random) -> LabelledSentence | None:
    """The words of a marked text with its labels and noise; None if it has too many mentions."""
    if rng.random() < _WITHOUT_APOSTROPHES:
        text = re.sub(r"['’](?=[a-z])", "", text)
    text = re.sub(r"\s+(?=['’]s\b|[,.;:?!])", "", re.sub(r"\s+", " ", text))
    tokens = WORD.findall(text.lower())
    is_unmarked, is_terse = rng.random() < _WITHOUT_MARKS, rng.random() < _WITHOUT_ARTICLES
    errors = rng.uniform(*_TYPING_ERRORS) if rng.random() < _TYPES_BADLY else 0.0
    words = list(EDIT_MARK) if draft.is_edit else []
    mentions: list[tuple[int, int, int]] = []
    opened: tuple[int, int] | None = None
    for token in tokens:
        code = ord(token[0])
        if token == _CLOSE:
            if opened is None or opened[0] == len(words):
                return None
            mentions.append((opened[0], len(words) - 1, opened[1]))
            opened = None
        elif _OPEN <= code < _OPEN + 64:
            opened = len(words), code - _OPEN
        elif opened is None and ((is_unmarked and not token[0].isalnum()) or (is_terse and token in _ARTICLES)):
            continue
        else:
            words.append(_mistyped(token, rng) if errors and rng.random() < errors else token)
    if len(mentions) > MOST_MENTIONS or not words or opened is not None:
        return None
    for k in range(len(words) - 1):
        if words[k] in ("a", "an") and words[k + 1][0].isalpha():
            words[k] = "an" if words[k + 1][0] in "aeiou" else "a"
    used = {k for _, _, k in mentions}
    start, goal, labels = _labels(draft, used)
    return LabelledSentence(tuple(words), tuple(mentions), labels, start, goal)


def _labels(
    draft: _Draft, used: set[int]
) -> tuple[frozenset[tuple[int, str, int]], frozenset[tuple[int, str, int]], tuple[ObjectLabels, ...]]:
    relations: dict[bool, set[tuple[int, str, int]]] = {False: set(), True: set()}
    labels: list[dict[str, object]] = [{"count": min(draft.counts.get(k, 1), 8)} for k in range(draft.size)]
    for kind, subject, targets, is_goal in draft.facts:
        others = [t for t in targets if isinstance(t, int)]
        if subject not in used or not set(others) <= used:
            continue
        match kind:
            case "at":
                labels[subject]["goal_region" if is_goal else "region"] = REGIONS[str(targets[0])]
            case "stack" | "nest" | "row" | "file":
                labels[subject]["goal_group" if is_goal else "group"] = kind
            case "fill":
                labels[subject]["is_filled"] = not is_goal
            case "take":
                labels[subject]["is_taken"] = True
            case "remove" | "add" | "away":
                labels[subject]["change"] = kind
            case "swap":
                relations[True] |= {(subject, "swap", others[0]), (others[0], "swap", subject)}
            case "of":
                relations[False].add((subject, "part", others[0]))
            case "right" | "behind" | "under":
                inverse = {"right": "left", "behind": "front", "under": "on"}[kind]
                relations[is_goal].add((others[0], inverse, subject))
            case _:
                relations[is_goal] |= {(subject, kind, other) for other in others}
    return frozenset(relations[False]), frozenset(relations[True]), tuple(ObjectLabels(**one) for one in labels)  # type: ignore[arg-type]


# --- typing errors ------------------------------------------------------------------------------------------------------------

_ROWS = ("qwertyuiop", "asdfghjkl", "zxcvbnm")


def _mistyped(word: str, rng: Random) -> str:
    """The word with one typing error; words of fewer than three letters stay."""
    if len(word) < 3 or not word.isalpha():
        return word
    k = rng.randrange(len(word) - 1)
    match rng.randrange(5):
        case 0:
            return word[:k] + word[k + 1] + word[k] + word[k + 2 :]
        case 1:
            return word[: k + 1] + word[k + 2 :]
        case 2:
            return word[:k] + word[k] + word[k:]
        case 3:
            return word[:k] + _neighbour(word[k], rng) + word[k + 1 :]
        case _:
            return word[:k] + _neighbour(word[k], rng) + word[k:]


def _neighbour(letter: str, rng: Random) -> str:
    for row in _ROWS:
        if letter in row:
            k = row.index(letter)
            return rng.choice([row[j] for j in (k - 1, k + 1) if 0 <= j < len(row)])
    return letter
