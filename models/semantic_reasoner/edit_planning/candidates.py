"""The objects of a layout that the noun of a mention may mean, before anything else that is said of them is considered."""

from collections.abc import Callable, Iterable, Mapping, Sequence

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.reading import MentionedObject
from models.instruction_reader.sentences import split_words
from stable_data.instructions.wording.vocabulary import closeness, nouns_of
from stable_data.instructions.wording.words import singular, type_words
from stable_data.scene import SceneObject

MostSimilar = Callable[[str, Sequence[str]], str | None]
"""The text of several that is clearly most similar to some words, or None."""

_SAYS_IT, _NAMES_IT, _MAY_MEAN_IT = 3, 2, 1
"""How well a category fits a mention: the same words; a usual name of it, or its last words; one that is said of it too."""

_LETTERS = 3  # of a word that is looked for in descriptions
_COMPOUND = 4  # letters of the end of a compound
_AFTER_NOUN = frozenset({"for", "of", "with"})
_SAYS_NOTHING = frozenset({"and", "for", "its", "one", "ones", "that", "the", "thing", "things", "this", "with"})


class Candidates:
    """Finds the objects that a mention may mean by its noun.

    Args:
        layout: The objects.
        lexicon: The known nouns.
        most_similar: Finds the description of what has no known noun; None finds none.
    """

    def __init__(self, layout: Sequence[SceneObject], lexicon: Lexicon, most_similar: MostSimilar | None = None) -> None:
        self._layout, self._lexicon, self._most_similar = layout, lexicon, most_similar
        self._described = {o.instance: words_of(o) for o in layout}
        self._found: dict[tuple[str, tuple[str, ...]], Mapping[str, int]] = {}

    def of(self, one: MentionedObject) -> list[str]:
        """Returns the objects that a mention may mean: those whose category it says, or else all that it may name.

        If its noun fits no category, they are those with most of its words in their descriptions, or else the one whose
        description is clearly most similar.
        """
        close = self._close(one)
        least = _SAYS_IT if _SAYS_IT in close.values() else 1
        return [name for name, how in close.items() if how >= least]

    def named(self, one: MentionedObject) -> list[str]:
        """Returns the objects whose category a mention may mean, whatever their descriptions say."""
        return [o.instance for o in self._layout if self._fits(one, o)]

    def best(self, one: MentionedObject, names: Iterable[str]) -> list[str]:
        """Returns those of some objects whose category fits a mention best."""
        close, some = self._close(one), list(names)
        most = max((close.get(name, 0) for name in some), default=0)
        return [name for name in some if close.get(name, 0) == most]

    def categories(self, words: Sequence[str]) -> tuple[str, ...]:
        """Returns the known categories that a noun phrase may mean."""
        return self._lexicon.categories(words)

    def described(self, words: Iterable[str]) -> list[str]:
        """Returns the objects of any category whose descriptions have all of some words."""
        wanted = set(singular(tuple(words)))
        return [name for name, said in self._described.items() if wanted and wanted <= set(said)]

    def _close(self, one: MentionedObject) -> Mapping[str, int]:
        key = one.words, one.categories
        if key not in self._found:
            self._found[key] = self._closeness(one)
        return self._found[key]

    def _closeness(self, one: MentionedObject) -> Mapping[str, int]:
        if not one.words:
            return dict.fromkeys(self._described, 1)  # "whatever is between them"
        close = {o.instance: self._fits(one, o) for o in self._layout}
        if any(close.values()):
            return close
        words = [w for w in singular(tuple(one.words.split())) if len(w) >= _LETTERS and w not in _SAYS_NOTHING]
        common = {name: _common_words(words, said) for name, said in self._described.items()}
        best = max(common.values(), default=0)
        if not best and not one.categories and self._most_similar is not None:
            found = self._most_similar(one.words, [o.description for o in self._layout])
            return {o.instance: int(o.description == found) for o in self._layout}
        return {name: int(how == best > 0) for name, how in common.items()}

    def _fits(self, one: MentionedObject, o: SceneObject) -> int:
        words, category = singular(tuple(one.words.split())), singular(type_words(o.category))
        size = self._lexicon.noun_size(one.words.split())
        noun = words[len(words) - size :]
        if not category or not noun:
            return 0
        if category == words[-len(category) :] and len(category) >= size:
            return _SAYS_IT
        if set(category) <= set(words) and set(self._lexicon.categories(category)) & set(one.categories):
            return _NAMES_IT  # the ketchup of a "ketchup bottle"
        if noun == category[-len(noun) :] or any(noun == singular(type_words(name)) for name in nouns_of(o.category)):
            return _NAMES_IT
        return min(_MAY_MEAN_IT, max((closeness(o.category, c) for c in one.categories), default=0))


def adjectives_of(one: MentionedObject) -> list[str]:
    """Returns the words of a mention that describe it: those before its last one that are in no name of its categories."""
    words = one.words.split()
    if not one.categories:
        return words
    own = {word for category in one.categories for word in type_words(category)}
    return [word for word in words[:-1] if word not in own]


def head_of(words: str) -> str:
    """Returns the noun of a phrase without plural ending: the last word before ``with``, ``of`` or ``for``."""
    said = words.split()
    end = next((k for k, word in enumerate(said) if k and word in _AFTER_NOUN), len(said))
    return singular(tuple(said[:end]))[-1] if said else ""


def words_of(o: SceneObject) -> tuple[str, ...]:
    """Returns the words of an object's description, without plural endings."""
    return singular(tuple(split_words(o.description)))


def _common_words(words: Iterable[str], of_description: Sequence[str]) -> int:
    """The number of words that a description has, alone or as the end of a compound such as ``racquetball``."""
    return sum(
        any(other == word or (len(word) >= _COMPOUND and other.endswith(word)) for other in of_description)
        for word in set(words)
    )
