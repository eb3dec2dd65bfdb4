"""Interprets instructions: what they require of a scene, their wording for the engine, and what is not understood.

The instruction reader finds the objects and relations of an instruction. All that follows from them rests on this one reading:
the objects that a reply must have, the relations of its start, the task info, and the warnings.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.reader import InstructionReader
from models.instruction_reader.reading import InstructionReading, MentionedObject
from models.instruction_reader.reference import reference_of_reading
from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.hazards import hazard_of
from models.semantic_reasoner.language.stated_counts import with_stated_counts
from models.semantic_reasoner.text.prompt import ANY_TABLE, required_phrases
from stable_data.errors import Notice
from stable_data.instructions.wording.vocabulary import nouns_of
from stable_data.instructions.wording.words import is_plural, plural, singular, singular_noun, type_words
from stable_data.metrics.alignment import Alignment, AlignmentReference, align, members
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import contacts_of

TextEncoder: TypeAlias = Callable[[Sequence[str]], npt.NDArray[np.float32]]
"""Maps texts to rows of unit length, (N, D)."""

STEP = "understand"
"""The step in the notices of this module."""

NEAR = 0.7
"""Least cosine similarity for reading an unknown noun as a known one (all-MiniLM-L6-v2, ``a doughnut`` with ``a donut``)."""

ALIKE, APART = 0.4, 0.15
"""Least cosine similarity of words with the description that they mean, and by how much less similar all others must be."""

LANGUAGE = 0.5
"""Share of unknown words above which a text counts as another language than English."""

_REMEMBERED = 256  # instructions: more than the scenes that a process makes at a time
_MIN_FOREIGN = 3  # least number of unknown words in a text of another language
_SHOWN = 60  # characters of an instruction in a message


@dataclass(frozen=True, slots=True)
class InterpretedInstruction:
    """What an instruction means.

    Attributes:
        instruction: The instruction.
        reading: Its objects and relations.
        num_objects: Number of known objects that it states; if no layout can have so many, ``reading`` has fewer.
        reference: What a scene must have so that the instruction makes sense in it; None if it mentions no known object.
        stated: The same with the relations that contradict others, which no scene can fulfil.
        wording: The instruction with nouns that the engine knows.
        phrases: What a layout must have in canonical form, see :class:`models.semantic_reasoner.text.prompt.ReasonerQuestion`.
        notices: ``word_read_as``, ``word_unknown``, ``no_object``, ``language_unknown``, ``contradiction`` or ``dangerous``.
    """

    instruction: str
    reading: InstructionReading
    num_objects: int
    reference: AlignmentReference | None
    stated: AlignmentReference | None
    wording: str
    phrases: tuple[str, ...] = ()
    notices: tuple[Notice, ...] = ()


class InstructionInterpreter:
    """Interprets instructions for the known categories.

    Args:
        statistics: The known categories, tables and words of the engine.
        encode: Finds known nouns that are similar to an unknown one; None finds none.
        reader: The reader; None loads the one of the package.
    """

    def __init__(
        self, statistics: CategoryStatistics, encode: TextEncoder | None = None, reader: InstructionReader | None = None
    ) -> None:
        self._statistics, self._encode = statistics, encode
        self._reader = reader or InstructionReader.load(statistics.categories)
        self._interpret = lru_cache(maxsize=_REMEMBERED)(self._interpreted)

    @property
    def lexicon(self) -> Lexicon:
        """The nouns of the known categories."""
        return self._reader.lexicon

    def __call__(self, instruction: str, is_edit: bool = False) -> InterpretedInstruction:
        """Returns what an instruction means.

        Args:
            instruction: The instruction.
            is_edit: Whether it says how to change a scene.
        """
        return self._interpret(instruction, is_edit)

    def _interpreted(self, instruction: str, is_edit: bool) -> InterpretedInstruction:
        if self._is_foreign(instruction):
            message = f"most words of {_shown(instruction)} are unknown, expected English; write it in English"
            notice = Notice("instruction", STEP, "language_unknown", f"instruction: {message}")
            return InterpretedInstruction(instruction, InstructionReading(()), 0, None, None, instruction, (), (notice,))
        reading = self._reader.read(instruction, is_edit)
        if not is_edit:  # the reader may take objects for new ones that only an edit can have
            objects = tuple(replace(o, change="", categories=self._closest(o)) for o in reading.objects)
            reading = replace(reading, objects=objects)
        reading, notices = self._with_similar_nouns(reading, instruction)
        reading, num_objects = with_stated_counts(reading, instruction)
        reference, stated = (reference_of_reading(reading, "instruction", both) for both in (False, True))
        wording = self._reworded(instruction, reading)
        notices += (*_contradictions(reading), *_dangers(instruction, reading))
        if not reading.objects and not is_edit:
            message = f"{_shown(instruction)} mentions no object; name what shall be on the table"
            notices += (Notice("instruction", STEP, "no_object", f"instruction: {message}"),)
        phrases = () if reference is None else self._phrases(reference)
        return InterpretedInstruction(instruction, reading, num_objects, reference, stated, wording, phrases, notices)

    def table_type(self, table_type: str) -> tuple[str, tuple[Notice, ...]]:
        """Returns a kind of table if it is known, else the kind for any table, so that the engine sees only its size.

        Args:
            table_type: The kind of table.

        Returns:
            The kind, and the notice ``table_unknown`` if it is unknown.
        """
        known = self._statistics.tables
        if not known or table_type in (*known, ANY_TABLE):
            return table_type, ()
        message = f"table: {_shown(table_type)} is an unknown kind of table, only its size is used; known kinds: "
        return ANY_TABLE, (Notice("table", STEP, "table_unknown", message + ", ".join(sorted(known))),)

    def _closest(self, o: MentionedObject) -> tuple[str, ...]:
        """The category with just the words that an object is called by, if there is one: ``bottle``; else the usual ones."""
        spoken = singular(tuple(split_words(o.words)))
        own = {c: singular(type_words(c)) for c in o.categories}
        called = [c for c, noun in own.items() if noun and spoken[-len(noun) :] == noun]
        longest = max((len(own[c]) for c in called), default=0)
        return tuple(c for c in called if len(own[c]) == longest) or self.lexicon.usual(o.words.split(), o.categories)

    # --- unknown words ---

    def _is_foreign(self, instruction: str) -> bool:
        words = [w for w in split_words(instruction) if w.isalpha()]
        unknown = [w for w in words if not self._reader.knows(w)]
        if 0 < len(unknown) == len(words) and not all(map(str.isascii, unknown)):
            return True  # a script without spaces between words gives few words
        return len(unknown) >= _MIN_FOREIGN and len(unknown) > LANGUAGE * len(words)

    def _with_similar_nouns(
        self, reading: InstructionReading, instruction: str
    ) -> tuple[InstructionReading, tuple[Notice, ...]]:
        """The reading in which unknown objects have the category of a similar noun if there is one, and notices."""
        objects, notices = [], []
        for o in reading.objects:
            shown = _shown(instruction[slice(*o.mentions[0])] if o.mentions else o.words)  # also with its typing errors
            if not o.categories and (similar := self._similar(o.words)) is not None:
                noun, o = similar[0], replace(o, categories=similar[1])
                notices.append(("word_read_as", f"{shown} is unknown, read as {noun}"))
            elif not o.categories:
                message = f"{shown} is unknown and no known object is similar; name a known object"
                notices.append(("word_unknown", message))
            objects.append(o)
        found = dict.fromkeys(Notice("instruction", STEP, code, f"instruction: {message}") for code, message in notices)
        return replace(reading, objects=tuple(objects)), tuple(found)

    @cached_property
    def _names(self) -> dict[str, tuple[str, ...]]:
        """The categories of each noun of the vocabulary."""
        names: dict[str, list[str]] = {}
        for category in self._statistics.categories:
            for noun in dict.fromkeys((_own_noun(category), *nouns_of(category))):
                names.setdefault(noun, []).append(category)
        return {noun: tuple(categories) for noun, categories in sorted(names.items())}

    @cached_property
    def _rows(self) -> npt.NDArray[np.float32]:
        assert self._encode is not None
        return np.asarray(self._encode([f"a {name}" for name in self._names]))

    def _similar(self, words: str) -> tuple[str, tuple[str, ...]] | None:
        """The known noun that is most similar to an unknown one, and its categories; None if none is similar enough."""
        if self._encode is None or not self._names or self.lexicon.is_unknown(words.split()):
            return None
        similarity = self._rows @ np.asarray(self._encode([f"a {singular_noun(words)}"]))[0]
        best = int(similarity.argmax())
        return list(self._names.items())[best] if similarity[best] >= NEAR else None

    def most_similar(self, words: str, texts: Sequence[str]) -> str | None:
        """Returns the text that is clearly most similar to some words; None if there is none, or without an encoder.

        Args:
            words: The words of an object, such as ``sand timer``.
            texts: Descriptions; equal ones count once.
        """
        several = tuple(dict.fromkeys(texts))
        if self._encode is None or not several or not words.strip():
            return None
        rows = np.asarray(self._encode([f"the {words}", *several]))
        similarity = rows[1:] @ rows[0]
        best, *others = np.sort(similarity)[::-1].tolist()
        if best < ALIKE or (others and best - others[0] < APART):
            return None
        return several[int(similarity.argmax())]

    # --- the engine's words ---

    def _phrases(self, reference: AlignmentReference) -> tuple[str, ...]:
        """The required objects, each under the likeliest of its categories, and their relations; not what may be of any kind."""
        names: dict[str, str] = {}
        for r in reference.required:
            if r.categories:
                category = self._statistics.most_frequent(r.categories)
                names[r.instance] = f"{category}_{sum(n.rpartition('_')[0] == category for n in names.values())}"
        return required_phrases(names, [r for r in reference.entailed if set(members(r)) <= names.keys()])

    def _reworded(self, instruction: str, reading: InstructionReading) -> str:
        """The instruction with a noun of the engine in place of each noun that it does not know."""
        changes = {place: o for o in reading.objects if o.categories for place in o.mentions}
        for (start, end), o in sorted(changes.items(), reverse=True):
            words = split_words(instruction[start:end])
            size = self._reader.lexicon.noun_size(words)
            if all(w in self._statistics.words for w in words[len(words) - size :]):
                continue
            noun = _own_noun(o.categories[0])
            if words[-1].endswith("s") and not words[-1].endswith("ss") and not is_plural(noun):
                noun = plural(noun)
            instruction = f"{instruction[:start]}{' '.join([*words[: len(words) - size], noun])}{instruction[end:]}"
        return instruction


def compare_with_instruction(
    layout: Sequence[SceneObject], table: Tabletop, meant: InterpretedInstruction
) -> tuple[Alignment | None, tuple[Relation, ...]]:
    """Compares a layout with what an instruction requires of the scene that it starts from, in the way in which the most of it holds.

    Args:
        layout: The objects; what carries one is its support, or by boxes if it states none.
        table: The table.
        meant: The interpreted instruction.

    Returns:
        The alignment, None if the instruction mentions no known object, and the relations that do not hold, in the names of the
        layout. A relation of a missing object is not among them.
    """
    if meant.reference is None:
        return None, ()
    scene = Scene("layout", table, tuple(layout))
    found = align(scene, meant.reference, contacts=contacts_of(scene))
    return found, tuple(_renamed(found, found.broken or ()))


def relations_of_task(found: Alignment) -> tuple[Relation, ...]:
    """Returns the relations that an instruction states of the start, in the names of the layout; none of a missing object."""
    return tuple(_renamed(found, found.reference.entailed))


def _renamed(found: Alignment, relations: Sequence[Relation]) -> Iterator[Relation]:
    names = dict(found.matches)
    for r in relations:
        if set(members(r)) <= names.keys():
            target = r.target if r.kind is RelationKind.IS_AT else ", ".join(names[name] for name in members(r)[1:])
            yield Relation(names[r.subject], r.kind, target)


def _contradictions(reading: InstructionReading) -> Iterator[Notice]:
    for r in reading.contradictions:
        one, other = (reading.objects[k].words for k in (r.subject, r.target))
        kind = {"left": "left of", "front": "in front of"}.get(r.kind, r.kind)
        message = f"that {_shown(one)} is {kind} {_shown(other)} contradicts other words, so it is not used; state one of them"
        yield Notice("instruction", STEP, "contradiction", f"instruction: {message}")


def _dangers(instruction: str, reading: InstructionReading) -> Iterator[Notice]:
    if (words := hazard_of(instruction, reading)) is not None:
        message = f"{_shown(words)} is dangerous; its start scene is made, but let no robot carry it out"
        yield Notice("instruction", STEP, "dangerous", f"instruction: {message}")


def _own_noun(category: str) -> str:
    """A category in words, such as ``spice jar``."""
    return " ".join(type_words(category))


def _shown(text: str) -> str:
    words = " ".join(text.split())
    return repr(words if len(words) <= _SHOWN else f"{words[: _SHOWN - 3]}...")
