"""From the scores of the network to a reading: which mentions are one object, how many there are, which relations hold."""

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from models.instruction_reader.double_claims import double_claims
from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.network import CELLS, CHANGES, GOAL, GROUPS, START
from models.instruction_reader.nouns import is_hollow
from models.instruction_reader.phrases import ADJECTIVES
from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.instruction_reader.spoken_cells import CLAUSE_ENDS, SINGLING, Scores, of_spoken_cells, set_stated_corners
from stable_data.instructions.wording.words import is_plural, plural

_PRONOUNS = frozenset(
    {
        "a", "all", "an", "another", "any", "anything", "both", "bottom", "bunch", "each", "either", "everything",
        "few", "first", "five", "former", "four", "half", "he", "her", "him", "it", "its", "itself", "last", "latter",
        "left", "lot", "lower", "middle", "more", "most", "neither", "none", "of", "one", "ones", "only", "other",
        "others", "pair", "remaining", "rest", "right", "same", "second", "she", "some", "something", "stuff", "that",
        "the", "their", "them", "these", "they", "thing", "things", "third", "this", "those", "three", "top", "two",
        "upper", "what", "whatever", "which", "whole",
    }
)  # fmt: skip
"""Words of mentions without a noun."""

_DETERMINERS = frozenset(
    {"a", "an", "her", "his", "its", "my", "our", "that", "the", "their", "these", "this", "those", "your"}
)

_LAST = frozenset({"back", "bottom", "last", "lower", "lowest", "outer", "rear", "rearmost", "right", "rightmost"})
"""Words of the last object of a stack, nest, row or file."""

_HOLDERS = frozenset({"case", "holder", "pot", "rack", "stand"})
"""Nouns that mean a holder of what is in it, such as a brush pot."""

_ONES = ("one", "ones")
_IS = frozenset({"are", "is", "s", "was", "were"})
_AFTER_ONE = frozenset({"behind", "beside", "from", "in", "next", "on", "under", "with", "without"})
"""Words after ``the one`` that say which other object of a kind it is."""

_TOP_OF = re.compile(
    r"\b(?:top|topmost|uppermost|bottom|bottommost|lowest) (?:one )?of (?:the|these|those|my|our) (?:[\w-]+ ){0,2}$"
)
_PILE_OF = re.compile(r"\b(?:stack|pile|tower) of (?:[\w-]+ ){0,2}$")
_MADE = frozenset({"build", "form", "in", "into", "make"})
"""Words before a pile that is to be made."""

_SAME = 0.5
_PART = 0.5
_HOLDS = 0.5
_CARRIES = ("in", "on")


@dataclass(slots=True)
class _Entity:
    """Mentions of one object, or of several under one name."""

    mentions: tuple[tuple[int, int], ...]
    words: str
    categories: tuple[str, ...]
    has_noun: bool
    count: int
    said: dict[str, int]

    @property
    def size(self) -> int:
        """Number of its objects; two for a plural without a number."""
        return self.count or 2


def spans_of(tags: Sequence[int]) -> list[tuple[int, int]]:
    """Returns the first and last word of each mention from the tags outside, begin, inside (0, 1, 2)."""
    spans: list[tuple[int, int]] = []
    for k, tag in enumerate(tags):
        if tag == 1 or (tag == 2 and not (spans and spans[-1][1] == k - 1)):
            spans.append((k, k))
        elif tag == 2:
            spans[-1] = spans[-1][0], k
    return spans


def join_purposes(words: Sequence[str], spans: Sequence[tuple[int, int]], lexicon: Lexicon) -> list[tuple[int, int]]:
    """Joins two mentions that are one compound said in turn: ``the jar for the cotton pads`` is a cotton jar."""
    joined: list[tuple[int, int]] = []
    for first, last in spans:
        link = words[joined[-1][1] + 1 : first] if joined else []
        is_purpose = link[:1] == ["for"] and set(link[1:]) <= _DETERMINERS
        if is_purpose and lexicon.of_purpose(words[joined[-1][0] : last + 1]):
            joined[-1] = joined[-1][0], last
        else:
            joined.append((first, last))
    return joined


def decode(
    words: Sequence[str],
    spans: Sequence[tuple[int, int]],
    said: Mapping[str, Scores],
    start: Scores,
    goal: Scores,
    lexicon: Lexicon,
    places: Sequence[tuple[int, int]] = (),
) -> InstructionReading:
    """Returns the reading of a sentence.

    Args:
        words: Its words.
        spans: Its mentions.
        said: Probabilities of what is said of each mention, (M, classes) by name.
        start: Probabilities of pairs at the start, (M, M, classes).
        goal: Probabilities of pairs after the task, (M, M, classes).
        lexicon: The known nouns.
        places: Range of characters of each word in the text; without them the reading does not say where its objects are.
    """
    spans = [_noun_phrase(words, span, before[1]) for before, span in pairwise([(-1, -1), *spans])]
    phrases = [words[a : b + 1] for a, b in spans]
    nouns = [_noun(phrase, lexicon) for phrase in phrases]
    repeated = np.array([[a != b and _is_repeated(words, a, b) for b in spans] for a in spans], bool).reshape(
        len(spans), len(spans)
    )
    clusters = _clusters(start, nouns, [phrase[-1] for phrase in phrases], repeated)
    nouns = [(has or _is_another(words, span), found) for (has, found), span in zip(nouns, spans, strict=True)]
    ranges = [(places[a][0], places[b][1]) if places else (0, 0) for a, b in spans]
    said = {**said, **{name: of_spoken_cells(said[name], words) for name in ("region", "goal_region")}}
    set_stated_corners(said, words, [b for _, b in spans])
    _set_piles(said, words, spans)
    bare = [
        words[max(0, a - 1) : a] not in (["a"], ["an"]) and _is_plural_of(words[b], noun)
        for (a, b), (_, noun) in zip(spans, nouns, strict=True)
    ]
    entities = [_entity(cluster, phrases, nouns, said, ranges, bare) for cluster in clusters]
    parts = _parts(clusters, start, entities)
    found = _relations(clusters, start, START[1:7], parts)
    found += list(double_claims(words, spans, clusters, found))
    aims = _relations(clusters, goal, GOAL[1:], parts)
    carriers = {j for _, _, kind, j in (*found, *aims) if kind in _CARRIES}
    _name_ones(entities, clusters, parts, carriers)
    for one in entities:
        turned = one.words.partition(" for ")
        is_one = (turned[2] and not is_plural(turned[0])) or lexicon.is_one_thing(one.words.split(), one.categories)
        if not one.count and one.has_noun and is_one:
            one.count = 1
    _name_by_contents(entities, [*found, *aims], lexicon)
    _give_each_its_own(entities, [*found, *aims], words, [spans[cluster[0]][0] for cluster in clusters])
    made = _objects(entities, parts)
    found = [(p, i, _carrying(kind, i, j, words, spans, clusters, entities), j) for p, i, kind, j in found]
    relations = [*_expanded(found, made.numbers), *_groups(entities, made.numbers)]
    relations += _beside_in_container(relations)
    kept, contradictions = _consistent(relations)
    return InstructionReading(tuple(made.objects), kept, tuple(_expanded(aims, made.numbers)), contradictions)


def _set_piles(said: Mapping[str, Scores], words: Sequence[str], spans: Sequence[tuple[int, int]]) -> None:
    """Makes a stack of what the words call so, ``a pile of thirty plates``, if the network gives it no group at the start."""
    for k, (first, last) in enumerate(spans):
        before = " ".join([*words[:last], ""])
        is_pile = _TOP_OF.search(before) or (
            _PILE_OF.search(before) and not _MADE.intersection(words[max(0, first - 6) : first])
        )
        if is_pile and is_plural(words[last]) and said["group"][k].argmax() == 0:
            said["group"][k] = np.eye(len(GROUPS), dtype=np.float32)[GROUPS.index("stack")]


def _noun_phrase(words: Sequence[str], span: tuple[int, int], least: int) -> tuple[int, int]:
    """The words of a mention with a noun, without an article or possessive, and with the adjectives before it after ``least``."""
    first, last = span
    is_one = words[last] in _ONES and first - 1 > least and words[first - 1] in ADJECTIVES  # "the small one"
    if all(w in _PRONOUNS for w in words[first : last + 1]) and not is_one:
        return span
    if first < last and words[first] in _DETERMINERS:
        return first + 1, last
    while first - 1 > least and words[first - 1] in ADJECTIVES:
        first -= 1
    before = words[max(0, first - 2) : first]
    is_predicate = words[last] in _ONES and before[-1:] == ["the"] and not _IS.isdisjoint(before)
    return span if is_predicate else (first, last)


def _noun(phrase: Sequence[str], lexicon: Lexicon) -> tuple[bool, tuple[str, ...]]:
    """Whether a phrase has a noun, and its categories."""
    if all(w in _PRONOUNS or not w.isalpha() for w in phrase):
        return False, ()
    return True, lexicon.categories(phrase)


def _is_another(words: Sequence[str], span: tuple[int, int]) -> bool:
    """Whether a mention without a noun means another object of a kind: ``the small one``, ``the other one``, ``the one with ...``."""
    first, last = span
    if words[last] not in _ONES:
        return False
    before = words[max(0, first - 1) : last]
    if {"another", "other"} & {*before} and "each" not in words:
        return True
    return "the" in before and bool(_AFTER_ONE & {*words[last + 1 : last + 2]})


def _is_repeated(words: Sequence[str], one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two mentions single out one object with the same words, such as ``the jar that is closest to the left``."""
    (a, b), (c, d) = one, other
    if words[a : b + 1] != words[c : d + 1] or _PRONOUNS.issuperset(words[a : b + 1]):
        return False
    if not all("the" in words[max(0, k - 1) : k + 1] for k in (a, c)) or is_plural(words[b]):
        return False
    after, also = words[b + 1 :], words[d + 1 :]
    if not {"that", "which"} & {*after[:1], *also[:1]}:
        return any(word in SINGLING or word.endswith(("est", "most")) for word in words[a:b])
    size = next((k for k, (x, y) in enumerate(zip(after, also, strict=False)) if x != y), min(len(after), len(also)))
    while size and after[size - 1] not in CLAUSE_ENDS:
        size -= 1
    return size > 2 and not (CLAUSE_ENDS | {"from", "of", "to"}) & {*after[size : size + 1], *also[size : size + 1]}


def _carrying(
    kind: str,
    i: int,
    j: int,
    words: Sequence[str],
    spans: Sequence[tuple[int, int]],
    clusters: Sequence[list[int]],
    entities: Sequence[_Entity],
) -> str:
    """The relation to a carrier: what is taken ``from`` something hollow is in it, where frames know no nouns."""
    categories = entities[j].categories
    if kind != "on" or not categories or not all(map(is_hollow, categories)):
        return kind
    starts = [spans[k][0] for k in clusters[j]]
    is_taken = any("from" in words[max(0, k - 2) : k] for k in starts) and not {"on", "off", "top", "onto"} & {*words}
    return "in" if is_taken else kind


def _clusters(
    start: Scores,
    nouns: Sequence[tuple[bool, tuple[str, ...]]],
    heads: Sequence[str],
    repeated: npt.NDArray[np.bool_],
) -> list[list[int]]:
    """Mentions of the same object, by average linkage; unlike nouns are kept apart, but not "the pen pot ... the pot"."""
    size = len(nouns)
    same = (start[:, :, START.index("same")] + start[:, :, START.index("same")].T) / 2
    same = np.where(repeated, 1, same)
    clusters = [[k] for k in range(size)]

    def fits(one: list[int], other: list[int]) -> bool:
        for i in one:
            for j in other:
                (named, a), (also, b) = nouns[i], nouns[j]
                if heads[i] == heads[j]:
                    continue
                if named and also and a and b and not set(a) & set(b):
                    return False
                if named and also and bool(a) != bool(b) and same[i, j] < 0.9:
                    return False
        return True

    while len(clusters) > 1:
        best, pair = _SAME, None
        for i in range(len(clusters)):
            for j in range(i):
                score = float(np.mean([same[a, b] for a in clusters[i] for b in clusters[j]]))
                if score > best and fits(clusters[i], clusters[j]):
                    best, pair = score, (j, i)
        if pair is None:
            break
        clusters[pair[0]] += clusters.pop(pair[1])
    return [sorted(c) for c in clusters]


def _entity(
    cluster: list[int],
    phrases: Sequence[Sequence[str]],
    nouns: Sequence[tuple[bool, tuple[str, ...]]],
    said: Mapping[str, Scores],
    ranges: Sequence[tuple[int, int]],
    is_bare: Sequence[bool],
) -> _Entity:
    named = [k for k in cluster if nouns[k][0]]
    known = [k for k in named if nouns[k][1]]
    head = max(known, key=lambda k: len(phrases[k])) if known else (named or cluster)[0]
    categories = nouns[head][1]
    for k in known:  # "the desk lamp ... the lamp"
        if both := tuple(c for c in categories if c in nouns[k][1]):
            categories = both
    scores = {name: values[cluster].mean(0) for name, values in said.items()}
    first = (named or cluster)[0]
    count = int(said["count"][first].argmax())
    count = 0 if count == 1 and is_bare[head] else count
    picked = {name: int(values.argmax()) for name, values in scores.items()}
    mentions = tuple(ranges[k] for k in named if ranges[k] != (0, 0))
    return _Entity(mentions, " ".join(phrases[head]), categories, bool(named), count, picked)


def _is_plural_of(noun: str, categories: Sequence[str]) -> bool:
    """Whether a noun is the plural of the last word of a category: ``cups`` of an egg cup, but not ``cards`` of a deck."""
    heads = (c.rpartition("_")[2] for c in categories)
    return any(noun == plural(head) and noun != head for head in heads)


def _name_ones(entities: Sequence[_Entity], clusters: Sequence[list[int]], parts: dict[int, int], carriers: Set[int]) -> None:
    """Gives ``the yellow one`` the noun of its plural, or else of an object that is mentioned before it, which may be a plural.

    In "the knife on the board is dirty, take the clean one" what is carried is meant, not its carrier.
    """
    for k, one in enumerate(entities):
        if not one.has_noun or one.categories or one.words.split()[-1] not in ("one", "ones"):
            continue
        before = [j for j, other in enumerate(entities) if other.categories and clusters[j][0] < clusters[k][0]]
        named = parts.get(k, max(before, key=lambda j: (j not in carriers, clusters[j][0]), default=k))
        if named != k and entities[named].count > 1 and not _is_one(entities[named]):
            parts.setdefault(k, named)
        one.categories = entities[named].categories
        one.words = (
            f"{one.words.rpartition(' ')[0]} {entities[named].words.split()[-1]}".strip() if one.categories else one.words
        )


def _name_by_contents(entities: Sequence[_Entity], found: Sequence[tuple[float, int, str, int]], lexicon: Lexicon) -> None:
    """Gives a carrier whose noun may mean several the category that it has with its contents: the pot of brushes is a brush pot."""
    for _, i, kind, j in found:
        one, carrier = entities[i], entities[j]
        if kind in _CARRIES and one.categories and len(carrier.categories) > 1:
            named = lexicon.of_contents(carrier.words.split(), one.words.split())
            both = tuple(c for c in carrier.categories if c in named)
            is_open = carrier.words.split()[-1] in _HOLDERS
            carrier.categories = both or (named if is_open else ()) or carrier.categories


def _give_each_its_own(
    entities: Sequence[_Entity], found: Sequence[tuple[float, int, str, int]], words: Sequence[str], starts: Sequence[int]
) -> None:
    """Gives as many carriers as objects where each is on its own: ``three cups, each on its own saucer``."""
    for _, i, kind, j in found:
        one, carrier = entities[i], entities[j]
        if kind in _CARRIES and one.count > 1 and carrier.count < 2 and carrier.has_noun:
            before = {*words[max(0, starts[j] - 2) : starts[j]], *carrier.words.split()}
            if "own" in before or (carrier.count == 0 and not _is_one(carrier)):
                carrier.count = one.count


def _beside_in_container(relations: Sequence[MentionedRelation]) -> list[MentionedRelation]:
    """Further contents of a container: those between which another content is."""
    holder = {r.subject: r for r in relations if r.kind == "in"}
    carried = {r.subject for r in relations if r.kind in _CARRIES}
    return [
        replace(holder[r.subject], subject=r.target)
        for r in relations
        if r.kind == "between" and r.subject in holder and r.target not in carried and r.target != holder[r.subject].target
    ]


def _parts(clusters: Sequence[list[int]], start: Scores, entities: Sequence[_Entity]) -> dict[int, int]:
    """The plural that each entity is a part of, by the number of the part."""
    found: dict[int, int] = {}
    for i, one in enumerate(clusters):
        scores = [
            (float(start[np.ix_(one, other)][:, :, START.index("part")].max()), j) for j, other in enumerate(clusters) if i != j
        ]
        score, j = max(scores, default=(0.0, -1))
        if score > _PART and found.get(j) != i:
            found[i] = j
    return {i: j for i, j in found.items() if j not in found or found[j] != i}


@dataclass(slots=True)
class _ObjectList:
    """The objects of the entities; ``numbers`` are those of each entity."""

    entities: Sequence[_Entity]
    objects: list[MentionedObject]
    numbers: list[list[int]]

    def add(self, k: int, count: int, named: int | None = None) -> None:
        """Adds objects to entity k, with the noun of ``named`` if that is another entity."""
        one, noun = self.entities[k], self.entities[k if named is None else named]
        found = MentionedObject(
            noun.words,
            noun.categories,
            CELLS[one.said["region"]],
            CELLS[one.said["goal_region"]],
            bool(one.said["is_filled"]),
            bool(one.said["is_taken"]),
            CHANGES[one.said["change"]],
            noun.mentions,
            k,
            one.count == 0 and not _is_one(one),
        )
        self.numbers[k] += range(len(self.objects), len(self.objects) + count)
        self.objects += [found] * count


def _objects(entities: Sequence[_Entity], parts: Mapping[int, int]) -> _ObjectList:
    """The objects of the entities; a part has some of the objects of its plural."""
    made = _ObjectList(entities, [], [[] for _ in entities])
    for k, one in enumerate(entities):
        members = [i for i, whole in parts.items() if whole == k]
        if k in parts or not (members or one.has_noun):
            continue
        if not members:
            made.add(k, 1 if _is_one(one) else one.size)
        elif one.has_noun:
            _split(made, k, members)
        else:  # "all three" of objects with nouns of their own
            for i in members:
                made.add(i, entities[i].size if entities[i].has_noun else 0)
            made.numbers[k] = [n for i in members for n in made.numbers[i]]
    for i, whole in parts.items():  # a part of a part
        if not made.numbers[i]:
            made.numbers[i] = made.numbers[whole][: entities[i].size]
    return made


def _split(made: _ObjectList, k: int, members: Sequence[int]) -> None:
    """Divides the objects of a plural among its parts; a part without a number, such as ``the rest``, gets what is left."""
    entities = made.entities
    rest = [i for i in members if entities[i].count == 0]
    for i in members:
        if i not in rest:
            made.add(i, entities[i].size, i if entities[i].categories else k)
    given = [n for i in members for n in made.numbers[i]]
    left = entities[k].size - len(given)
    if rest:
        made.add(rest[0], max(1, left), k)
        given += made.numbers[rest[0]]
        for i in rest[1:]:  # "the blocks: red ones in the box, blue ones ..."
            made.add(i, entities[i].size if entities[k].count == 0 and entities[i].has_noun else 0, k)
            given += made.numbers[i]
    else:
        made.add(k, max(0, left))
        given += made.numbers[k]
    last = [n for i in members if _LAST & set(entities[i].words.split()) for n in made.numbers[i]]
    made.numbers[k] = [*(n for n in given if n not in last), *last]


def _is_one(entity: _Entity) -> bool:
    """Whether a plural noun means one object, such as scissors or a pair of scissors."""
    return entity.count in (0, 2) and bool(entity.categories) and all(is_plural(c.replace("_", " ")) for c in entity.categories)


def _relations(
    clusters: Sequence[list[int]], scores: Scores, kinds: Sequence[str], parts: Mapping[int, int]
) -> list[tuple[float, int, str, int]]:
    """The likeliest relation of each pair of entities, if it is likely enough."""
    found = []
    for i, one in enumerate(clusters):
        for j, other in enumerate(clusters):
            if i == j or parts.get(i) == j or parts.get(j) == i:
                continue
            block = scores[np.ix_(one, other)][:, :, 1 : 1 + len(kinds)].reshape(-1, len(kinds)).max(0)
            kind = int(block.argmax())
            if block[kind] > _HOLDS:
                found.append((float(block[kind]), i, kinds[kind], j))
    return sorted(found, reverse=True)


def _expanded(found: Sequence[tuple[float, int, str, int]], copies: Sequence[list[int]]) -> list[MentionedRelation]:
    """The relations of single objects."""
    relations = []
    for score, i, kind, j in found:
        if kind in _CARRIES and len(copies[j]) > 1 and len(copies[j]) == len(copies[i]):
            pairs = list(zip(copies[i], copies[j], strict=True))  # each on its own
        elif kind in _CARRIES:
            pairs = [(a, b) for a in copies[i] for b in copies[j][:1]]
        else:
            pairs = [(a, b) for a in copies[i] for b in copies[j]]
        relations += [MentionedRelation(a, kind, b, score) for a, b in pairs if a != b]
    return relations


def _groups(entities: Sequence[_Entity], copies: Sequence[list[int]]) -> list[MentionedRelation]:
    """The relations within stacks, nests, rows and files, whose objects are in the order from top, inside, left or front."""
    kinds = {"stack": "on", "nest": "in", "row": "left", "file": "front"}
    return [
        MentionedRelation(a, kinds[group], b)
        for one, numbers in zip(entities, copies, strict=True)
        if (group := GROUPS[one.said["group"]])
        for a, b in pairwise(numbers)
    ]


def _consistent(
    relations: Sequence[MentionedRelation],
) -> tuple[tuple[MentionedRelation, ...], tuple[MentionedRelation, ...]]:
    """The relations that can hold together, the likeliest first, and the others: one carrier for each object, and no circle."""
    kept: list[MentionedRelation] = []
    others: list[MentionedRelation] = []
    carrier: dict[int, int] = {}
    for r in sorted(relations, key=lambda r: -r.score):
        if any((r.subject, r.kind, r.target) == (k.subject, k.kind, k.target) for k in kept):
            continue  # said twice
        if any({r.subject, r.target} == {k.subject, k.target} and k.kind != "near" for k in kept):
            others.append(r)
            continue
        if r.kind in _CARRIES:
            above, step = r.target, 0
            while above in carrier and step < len(relations):
                above, step = carrier[above], step + 1
                if above == r.subject:
                    break
            if r.subject in carrier or above == r.subject:
                others.append(r)
                continue
            carrier[r.subject] = r.target
        kept.append(r)
    return tuple(kept), tuple(o for o in others if o.kind != "near")
