"""Frames: sentences with slots for objects, whose labels come with the text.

A frame is one line ``TEXT => FACTS``, such as ``Fish the {a} <outof> the {b} => a in b; > take a``. The text has:

- ``{a}``: a noun of object a, in the singular and without determiner; ``{a+}`` its plural, ``{#a}`` its count, ``{a^}`` its
  shortened noun;
- ``[it:a]``: literal words that mean object a, such as a pronoun;
- ``{~n}``: a noun that means no object on the table;
- ``(x|y|)``: alternatives, one of which may be empty;
- ``<in>``, ``<put>`` and other keys of :data:`PHRASES`: one of many phrases; ``<r>``: the phrase of any relation.

The facts are separated by semicolons. Those of the goal start with ``>``:

- ``a in b`` and the other keys of :data:`RELATIONS`; ``a r b`` for the relation of ``<r>``; ``a between b c``;
- ``a at back left``: a region of the table; ``take a``: picked up, with no place stated;
- ``stack a``, ``nest a``, ``row a``, ``file a``: the objects of plural a are on each other, in each other, side by side, one behind
  the other; ``fill a``: a holds objects without a name;
- ``remove a``, ``add a``, ``away a``, ``a replace b``, ``a style s``, ``swap a b``: changes of a scene, in files ``edit*.txt``:
  a goes, comes, goes elsewhere, comes in place of b, gets the look of the words s, changes places with b;
- ``d of a``: d is some of the plural a; ``a x3``: the count of a; ``a = container``: a pool of nouns, or nouns.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from models.instruction_reader.phrases import PHRASES, POOLS, REGIONS, RELATIONS
from stable_data.errors import ConfigError

FOLDER = Path(__file__).with_name("frames")
"""The files of frames."""

SLOT = re.compile(
    r"\{(?P<kind>[#~]?)(?P<name>[a-z])(?P<form>[+^]?)\}|\[(?P<words>[^\]:]+):(?P<who>[a-z])\]|<(?P<phrase>[a-z]+)>"
)
"""A slot of a text: a noun, literal words for an object, or a phrase."""

ANY_RELATION = "r"
"""The name of ``<r>`` in texts and facts."""

_UNARY = frozenset({"take", "stack", "nest", "row", "file", "fill"})
_CHANGES = frozenset({"remove", "add", "away"})


@dataclass(frozen=True, slots=True)
class FrameFact:
    """A fact of a frame.

    Attributes:
        kind: A key of :data:`RELATIONS`, ``r``, ``between``, ``at``, ``of``, or the name of a property or a change.
        subject: Name of an object.
        targets: Names of the other objects; for ``at`` the region.
        is_goal: Whether it shall hold after the task; otherwise it holds at the start.
    """

    kind: str
    subject: str
    targets: tuple[str, ...] = ()
    is_goal: bool = False


@dataclass(frozen=True, slots=True)
class Frame:
    """A sentence with slots.

    Attributes:
        text: The text.
        facts: What it states.
        counts: Fixed counts of plural objects, by name.
        pools: Pools of nouns, or nouns separated by ``|``, by name.
        is_edit: Whether it says how to change a scene.
        source: Name of its file without the ending.
    """

    text: str
    facts: tuple[FrameFact, ...]
    counts: Mapping[str, int] = field(default_factory=dict)
    pools: Mapping[str, str] = field(default_factory=dict)
    is_edit: bool = False
    source: str = field(default="", compare=False)

    @property
    def names(self) -> frozenset[str]:
        """Names of the objects that the text mentions."""
        found = (m["name"] or m["who"] for m in SLOT.finditer(self.text) if m["kind"] != "~")
        return frozenset(name for name in found if name)


def parse_frame(line: str, is_edit: bool = False, source: str = "") -> Frame:
    """Parses a frame.

    Args:
        line: The frame.
        is_edit: Whether it says how to change a scene.
        source: Name of its file without the ending.

    Raises:
        ConfigError: The line is not a frame (``frame_invalid``).
    """
    text, arrow, tail = line.partition("=>")
    if not arrow:
        raise _invalid(line, "it has no =>")
    facts: list[FrameFact] = []
    counts: dict[str, int] = {}
    pools: dict[str, str] = {}
    for part in filter(None, (p.strip() for p in tail.split(";"))):
        if m := re.fullmatch(r"([a-z]) x(\d+)", part):
            counts[m[1]] = int(m[2])
        elif m := re.fullmatch(r"([a-z]) = ([a-z][a-z |-]*)", part):
            pools[m[1]] = m[2]
        else:
            facts.append(_fact(part, line))
    frame = Frame(text.strip(), tuple(facts), counts, pools, is_edit, source)
    _check(frame, line)
    return frame


def _fact(part: str, line: str) -> FrameFact:
    is_goal = part.startswith(">")
    words = part.removeprefix(">").split()
    match words:
        case [kind, subject] if kind in _UNARY or (kind in _CHANGES and is_goal):
            return FrameFact(kind, subject, (), is_goal)
        case [subject, "replace" | "style" as kind, target] if is_goal:
            return FrameFact(kind, subject, (target,), is_goal)
        case ["swap", subject, target] if is_goal:
            return FrameFact("swap", subject, (target,), is_goal)
        case [subject, "at", *region] if " ".join(region) in REGIONS:
            return FrameFact("at", subject, (" ".join(region),), is_goal)
        case [subject, "between", *targets] if len(targets) in (1, 2):
            return FrameFact("between", subject, tuple(targets), is_goal)
        case [subject, kind, target] if kind in (*RELATIONS, ANY_RELATION, "of"):
            return FrameFact(kind, subject, (target,), is_goal)
    raise _invalid(line, f"{part!r} is not a fact")


def _check(frame: Frame, line: str) -> None:
    rest = SLOT.sub("", frame.text)
    if re.search(r"[{}\[\]<>]", rest) or rest.count("(") != rest.count(")") or re.search(r"\([^)]*\(", rest):
        raise _invalid(line, "a bracket of its text opens no slot or is not closed")
    used = {f.subject for f in frame.facts} | {t for f in frame.facts if f.kind != "at" for t in f.targets}
    if strange := sorted((used | frame.counts.keys() | frame.pools.keys()) - frame.names):
        raise _invalid(line, f"its text does not mention {strange[0]}")
    phrases = {m["phrase"] for m in SLOT.finditer(frame.text) if m["phrase"]}
    if strange := sorted(phrases - PHRASES.keys() - {ANY_RELATION}):
        raise _invalid(line, f"<{strange[0]}> is unknown")
    if (ANY_RELATION in phrases) != any(f.kind == ANY_RELATION for f in frame.facts):
        raise _invalid(line, "<r> and a fact with r have to come together")
    if strange := sorted(p for p in frame.pools.values() if p not in POOLS and not re.fullmatch(r"[a-z -]+(?:\|[a-z -]+)*", p)):
        raise _invalid(line, f"{strange[0]!r} is no pool of nouns")


def _invalid(line: str, reason: str) -> ConfigError:
    return ConfigError(f"frame {line.strip()!r}: {reason}; see models/instruction_reader/frames.py", "frame_invalid")


def read_frames(folder: Path = FOLDER) -> Iterator[Frame]:
    """Yields the frames of all files of a folder, each text once, in the order of the file names.

    Raises:
        ConfigError: A line is not a frame (``frame_invalid``).
    """
    return (parse_frame(line, source.startswith("edit"), source) for line, source in _lines(folder))


def read_texts(folder: Path = FOLDER) -> Iterator[str]:
    """Yields the texts of the frames without reading their facts, which takes a twentieth of the time."""
    return (line.partition("=>")[0] for line, _ in _lines(folder))


def _lines(folder: Path) -> Iterator[tuple[str, str]]:
    """Each line once, and the name of its file without the ending; those of files ``edit*`` say how to change a scene."""
    seen = set()
    for path in sorted(folder.glob("*.txt")):
        for line in path.read_text("utf-8").splitlines():
            if line.strip() and not line.startswith("#") and line not in seen:
                seen.add(line)
                yield line, path.stem
