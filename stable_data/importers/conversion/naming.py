"""Category and description of an asset: as its source states them, else from the words of its name; no word is invented."""

import re
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from stable_data.assets.text_embeddings import Rows, TextEncoder, embed_texts
from stable_data.importers.source import SourceAsset
from stable_data.instructions.wording.vocabulary import classes_of, nouns_of
from stable_data.instructions.wording.words import singular, type_words
from stable_data.scene import FloatArray

ALIKE = 0.6
"""Cosine of sentence embeddings from which a known category counts as what a name means (measured with all-MiniLM-L6-v2)."""

_MOST_WORDS = 4  # of a category
_SHORTEST_START, _SHORTEST_END = 3, 4  # letters of the two words in one, as in ``vegetableburger``
_UNNAMED = "object"
# Words of file names and sets that say nothing about a thing.
_EMPTY = frozenset(
    (
        "asset", "aws", "cc", "collision", "dae", "final", "fbx", "free", "glb", "gltf", "google", "gso", "high", "hd", "item",
        "lod", "low", "mesh", "meshes", "mod", "model", "models", "new", "nontextured", "obj", "object", "objects", "old", "poly",
        "prop", "props", "ply", "residential", "robomaker", "scan", "scanned", "simplified", "sk", "sm", "stl", "textured", "the", "uv",
        "version", "visual", "ycb",
    )
)  # fmt: skip
# Words that tell how a thing is and not what it is.
_ADJECTIVES = frozenset(
    (
        "amber", "assorted", "beige", "big", "black", "blue", "bronze", "brown", "burnt", "ceramic", "chopped", "clean", "clear",
        "closed", "copper", "cooked", "cream", "dark", "decorative", "dirty", "empty", "extra", "filled", "full", "glossy", "gold",
        "golden", "gray", "green", "grey", "half", "huge", "iron", "large", "left", "light", "little", "long", "mashed", "medium",
        "metal", "metallic", "mini", "modern", "navy", "open", "opened", "orange", "oval", "piece", "pieces", "pink", "plain",
        "plastic", "porcelain", "purple", "raw", "rectangular", "red", "right", "rings", "round", "short", "silver", "simple", "slice",
        "slices", "sliced", "small", "square", "stainless", "steel", "stoneware", "tall", "teal", "tiny", "trash", "turquoise",
        "uncooked", "variant", "vintage", "violet", "white", "wood", "wooden", "yellow",
    )
)  # fmt: skip
_HASH = re.compile(r"(?<![^\W_])(?=[0-9a-f]*\d)[0-9a-f]{8,}(?![^\W_])", re.IGNORECASE)  # names of files that are hashes
_AFTER_THE_HEAD = re.compile(r"(?<![^\W_])(?:with|of|for|from|in|on|by)(?![^\W_])", re.IGNORECASE)
_BEFORE_OF = ("pair", "set", "pack", "box of", "piece")


@dataclass(frozen=True, slots=True)
class Name:
    """What an asset is called.

    Attributes:
        category: Words joined by ``_``; ``object`` if nothing is known.
        category_source: ``given``, ``name`` or ``encoder``; None if nothing is known.
        description: A phrase; empty if nothing is known.
        description_source: ``given`` or ``name``; None if nothing is known.
        likeness: Cosine to the known category, if the encoder found it; else 1.
    """

    category: str
    category_source: str | None
    description: str
    description_source: str | None
    likeness: float = 1.0


def words_of_name(name: str, source_set: str = "") -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Splits the name of a file or model into words, without numbers, single letters, and words of sets and formats.

    Args:
        name: Such as ``ycb_065-a_cups`` or ``Threshold_Porcelain_Teapot_White``.
        source_set: The set that it belongs to, whose words are left out.

    Returns:
        All words, lower case; and those before a word such as ``with``, or before the first variant, as ``pot`` in ``pot_A_stew``.
    """
    plain = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c))
    plain = _HASH.sub(" ", plain)
    left_out = _EMPTY | set(type_words(source_set))

    def kept(text: str) -> tuple[str, ...]:
        return tuple(word for word in type_words(text) if word.isalpha() and len(word) > 1 and word not in left_out)

    everything = kept(plain)
    head = plain
    cut = _AFTER_THE_HEAD.search(plain)
    if cut and kept(plain[: cut.start()]) and not plain[: cut.start()].rstrip(" _-").lower().endswith(_BEFORE_OF):
        head = plain[: cut.start()]
    for variant in re.finditer(r"(?<=[_\-. ])(?:[A-Za-z]|\d+)(?=[_\-. ])", head):
        if kept(head[: variant.start()]):
            head = head[: variant.start()]
            break
    return everything, kept(head) or everything


def related_categories(category: str) -> Iterator[str]:
    """Lists categories that a category is a kind or another name of, nearest first: for ``coffee_mug`` its own, then ``mug``.

    Everything that looks for the size, the density or the pose of a category asks for these in turn.
    """
    words = type_words(category)
    found = ["_".join(words[start:]) for start in range(len(words))]
    for end in list(found):
        for noun in nouns_of(end)[1:]:
            other = type_words(noun)
            found += ["_".join(other), *([] if "of" in other else [other[-1]])]
    yield from dict.fromkeys(found)


def _mentions(text: str, words: Iterable[str]) -> bool:
    """Whether a text has one of some words, in the singular or the plural."""
    return not set(singular(tuple(type_words(text)))).isdisjoint(singular(tuple(words)))


class Vocabulary:
    """The categories that are known, and the names that mean them.

    Args:
        categories: Known categories.
        encoder: Finds what other names mean; None: only words count.

    Attributes:
        categories: Known categories, sorted.
    """

    def __init__(self, categories: Iterable[str], encoder: TextEncoder | None = None) -> None:
        self.categories = tuple(sorted(set(categories)))
        self._encoder, self._known = encoder, frozenset(self.categories)
        self._by_words: dict[str, str] = {}
        for category in self.categories:
            self._by_words.setdefault(_key(type_words(category)), category)
        for category in self.categories:  # other names only where no category has them
            for noun in nouns_of(category)[1:]:
                self._by_words.setdefault(_key(type_words(noun)), category)

    @cached_property
    def _rows(self) -> Rows:
        assert self._encoder is not None
        return embed_texts([category.replace("_", " ") for category in self.categories], self._encoder)

    def likenesses(self, phrase: str) -> FloatArray:
        """Cosines of a phrase and each of ``categories``, (C,) float64; all 0 without an encoder."""
        if self._encoder is None or not phrase.strip() or not self.categories:
            return np.zeros(len(self.categories))
        return np.asarray(self._rows @ embed_texts([phrase], self._encoder)[0], np.float64)

    def nearest(self, phrase: str) -> tuple[str, float]:
        """Returns the known category whose embedding is nearest to a phrase, and the cosine; ``("", 0.0)`` without one."""
        likeness = self.likenesses(phrase)
        if not likeness.any():
            return "", 0.0
        best = int(np.argmax(likeness))
        return self.categories[best], float(likeness[best])

    def known(self, category: str) -> str:
        """Returns the known category that the words of another name, as ``crate`` for ``crate_cheese``; empty for none."""
        named, is_certain = self._named(type_words(category))
        if named and is_certain:
            return named
        return next((c for c in related_categories(category) if c in self._known), named)

    def name(self, asset: SourceAsset) -> Name:
        """Names an asset."""
        words, head = words_of_name(asset.name, asset.source_set)
        stated, phrase = asset.description.strip(), " ".join(words)
        if words and not asset.category and not _mentions(stated, words):
            stated = ""  # it is about the file, such as who converted it
        description, description_source = (stated, "given") if stated else (phrase, "name" if phrase else None)
        category, category_source, likeness = self._category(asset, words, head)
        return Name(category, category_source, description, description_source, likeness)

    def _category(self, asset: SourceAsset, words: tuple[str, ...], head: tuple[str, ...]) -> tuple[str, str | None, float]:
        """Category, what it rests on, and its likeness."""
        if given := "_".join(type_words(asset.category)):
            return given, "given", 1.0
        found, is_certain = self._named(head)
        if found and is_certain:
            return found, "name", 1.0
        near, likeness = self.nearest(" ".join(head))
        if likeness >= ALIKE:
            return near, "encoder", likeness
        if found:
            return found, "name", 1.0
        plain = tuple(word for word in head if word not in _ADJECTIVES) or head
        for tag in (*asset.tags,):
            if tagged := self._by_words.get(_key(type_words(tag))):
                return tagged, "given", 1.0
        return ("_".join(plain[-_MOST_WORDS:]), "name", 1.0) if words else (_UNNAMED, None, 1.0)

    def _named(self, words: tuple[str, ...]) -> tuple[str, bool]:
        """The known category that words name, and whether its last word is the last one that names a thing."""
        last = len(words)
        while last > 1 and words[last - 1] in _ADJECTIVES:
            last -= 1
        found: list[tuple[int, int, str]] = []  # number of words, end, category
        for end in range(len(words), 0, -1):
            for start in range(max(0, end - _MOST_WORDS), end):
                category = self._by_words.get(_key(words[start:end]))
                if category and not (end - start == 1 and words[start] in _ADJECTIVES and len(words) > 1):
                    found.append((len(type_words(category)), end, category))
        if not found:
            ending = (
                next((c for c in (self._by_words.get(_key((e,))) for e in _endings(words[last - 1])) if c), "") if words else ""
            )
            return ending, bool(ending)
        best = max(found, key=lambda each: (each[1] >= last, each[0], each[1]))
        # Food after something else is what is in it or on it: a crate of cheese.
        before = [each for each in found if each[1] < best[1] and "food" not in classes_of(each[2])]
        if best[0] == 1 and "food" in classes_of(best[2]) and before:
            return max(before, key=lambda each: (each[0], each[1]))[2], True
        return best[2], best[1] >= last


@lru_cache(maxsize=65536)
def _key(words: tuple[str, ...]) -> str:
    """Words as one, so that ``cuttingboard`` equals ``cutting board``."""
    return "".join(re.sub("oe$", "o", word) for word in singular(words))


def _endings(word: str) -> Iterator[str]:
    """The ends of a word that may be a word of their own, longest first."""
    return (word[start:] for start in range(_SHORTEST_START, len(word) - _SHORTEST_END + 1))
