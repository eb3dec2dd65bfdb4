"""Finds the words in which a source states its licence: files beside the assets, sentences of a description."""

import itertools
import re
from pathlib import PurePosixPath

from stable_data.assets.licences import normalise_licence
from stable_data.importers.boundary import Boundary
from stable_data.importers.source import GivenLicence
from stable_data.json_text import is_unicode

_LICENCE_FILE = re.compile(r"^(?:licen[cs]es?|copying|unlicense)(?:[._ -].*)?$", re.IGNORECASE)
_README = re.compile(r"^read[ _-]?me(?:\..*)?$", re.IGNORECASE)
_WORDS = re.compile(r"licen[cs]e|creative ?commons|\bcc[ -]?(?:by|0)\b|public domain", re.IGNORECASE)
_RESTRICTED = re.compile(r"\b[al]?gpl\b|general public licen[cs]e|non[ -]?commercial", re.IGNORECASE)
_MARKS = re.compile(
    r"\S*(?:://|www\.)[^\s()]*|\bcopyright\b|\(c\)|©|\b(?:19|20)\d\d\b(?: ?[-–] ?(?:(?:19|20)\d\d|present)\b)?", re.IGNORECASE
)
_PARTS = re.compile(r"[,;|()]|(?<=\w\w\w)\.(?: |$)| [-–] ")
_RIGHTS = re.compile(r"\brights?\b", re.IGNORECASE)
_TEXT_SUFFIXES = ("", ".txt", ".md", ".rst")
_HEAD = 65_536  # bytes of a file that are looked at
_MOST_LINES = 80  # lines of a file that are looked at
_TITLE_LINES = 20  # lines of a licence's text that may name it: further on, it may speak of others
_TITLE = 60  # characters of a title
_MOST_CHARACTERS = 1000


class LicenceFiles:
    """The licence files of a folder; each folder is looked at once.

    Args:
        root: The boundary of the source folder.
    """

    def __init__(self, root: Boundary) -> None:
        self.root = root
        self._found: dict[PurePosixPath, str | None] = {}

    def nearest(self, path: str) -> str | None:
        """Returns the nearest licence file in the folder of a file or above it, relative to the source folder; None if none is there.

        A README counts if its lines name one licence, not several for several things, and its folder has no licence file.
        """
        for folder in PurePosixPath(path).parents:
            if folder not in self._found:
                self._found[folder] = self._of_folder(folder)
            if (found := self._found[folder]) is not None:
                return found
        return None

    def _of_folder(self, folder: PurePosixPath) -> str | None:
        names = sorted(p.name for p in (self.root.root / folder).iterdir() if p.is_file() and not p.is_symlink())
        texts = [name for name in names if is_unicode(name) and PurePosixPath(name).suffix.lower() in _TEXT_SUFFIXES]
        for name in filter(_LICENCE_FILE.match, texts):
            return (folder / name).as_posix()
        for name in filter(_README.match, texts):
            path = (folder / name).as_posix()
            if licences_of_file(self.root, path):
                return path
        return None


def licences_of_file(root: Boundary, path: str) -> tuple[GivenLicence, ...]:
    """Returns the licences that a file states.

    Args:
        root: The boundary of the source folder.
        path: A licence file or README, relative to the folder.

    Returns:
        The lines that name a licence, each that of another one; of a licence file without such a line its beginning, of a README
        without one nothing.
    """
    text = root.read_head(path, _HEAD).decode("utf-8", "replace")
    lines = [" ".join(line.split()).strip("#*_ ") for line in text.splitlines()]
    lines = [line for line in lines if line][:_MOST_LINES]
    if _README.match(PurePosixPath(path).name):
        # The rows of a table speak of several things.
        found = [line for line in lines if _WORDS.search(line) and normalise_licence(line) and not line.startswith("|")]
        return (_given(found[:1], path),) if len(set(map(normalise_licence, found))) == 1 else ()
    restricted = [line for line in lines if _RESTRICTED.search(line)]  # with it, the words name no other licence
    top = lines[:_TITLE_LINES]
    for candidates in (top, [f"{a} {b}" for a, b in itertools.pairwise(top)]):  # Apache's name takes two lines
        titles = [line for k, line in enumerate(candidates) if _WORDS.search(line) or (k == 0 and len(line) <= _TITLE)]
        named = {name: line for line in reversed(titles) if (name := normalise_licence(line))}
        if named:
            return tuple(_given([line, *restricted], path) for line in reversed(named.values()))
    return (_given(lines or ["empty file"], path),)


def licence_of_text(text: str, where: str) -> GivenLicence | None:
    """Returns the sentences of a description that speak of a licence; None if none does."""
    sentences = re.split(r"(?<=[.!?;])\s+", " ".join(text.split()))
    found = [sentence for sentence in sentences if _WORDS.search(sentence)]
    return _given(found, where) if found else None


def licence_of_field(text: str, where: str) -> GivenLicence | None:
    """Returns the licence in a field that may hold a copyright alone; None if it names no licence."""
    return _given([text], where) if normalise_licence(text) or _WORDS.search(text) else None


def author_of_copyright(text: str) -> str:
    """Returns who a line of copyright names, without the years and the licence; empty if it names nobody."""
    named = []
    for part in _PARTS.split(" ".join(_MARKS.sub(" ", text[:_MOST_CHARACTERS]).split())):
        words = part.strip(" .-")
        if any(map(str.isalpha, words)) and not (_WORDS.search(words) or _RIGHTS.search(words) or normalise_licence(words)):
            named.append(words)
    return ", ".join(named)


def _given(lines: list[str], where: str) -> GivenLicence:
    return GivenLicence("; ".join(lines)[:_MOST_CHARACTERS], where)
