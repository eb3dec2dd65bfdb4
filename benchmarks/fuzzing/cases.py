"""Cases: what a reader is given. A case is a number: base and edits follow from the seed, the target and the number alone."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from random import Random

from benchmarks.fuzzing.mutation.files import edited_file

_MOST_BYTES = 2**20  # of a changed file: larger ones cost time and reach no other code
_MORE_EDITS = 0.4  # probability of a further edit
_MOST_EDITS = 5


@dataclass(frozen=True, slots=True)
class Base:
    """An honest input: a folder of files of which one is changed.

    Attributes:
        name: Its name, unique in its target.
        files: Path within the folder -> content.
        changed: The paths that are changed, and how often each, relative to the others; all equally often without any.
    """

    name: str
    files: Mapping[str, bytes]
    changed: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Case:
    """An input: a base with one file changed.

    Attributes:
        base: Name of the base.
        path: The changed file.
        content: Its content.
    """

    base: str
    path: str
    content: bytes


@dataclass(frozen=True)
class Target:
    """A reader that is fuzzed.

    Attributes:
        name: Its name.
        share: How many of all inputs it gets, relative to the other targets; those of this project are thousands of a million.
        make_bases: Makes its honest inputs; the same ones in every process.
        read: Gives a folder to the reader, together with the name of the base; returns whether the input was accepted. It raises
            what the reader raises, and :class:`benchmarks.fuzzing.watching.FalsePass` for a result that must not be.
        words: Words of its grammar, which edits of texts use.
        block: Inputs that a worker gets at once.
        starts: Beginnings of commands that the reader may start.
        read_apart: As ``read``, but with all that protects users from a file that ends its parser; a finding counts only if it is
            one here, too. None: ``read`` itself.
    """

    name: str
    share: float
    make_bases: Callable[[], Sequence[Base]]
    read: Callable[[Path, str], bool]
    words: Sequence[str] = ()
    block: int = 200
    starts: Collection[str] = ()
    read_apart: Callable[[Path, str], bool] | None = None

    @cached_property
    def bases(self) -> Mapping[str, Base]:
        """The honest inputs by name."""
        return {base.name: base for base in self.make_bases()}

    @cached_property
    def _donors(self) -> Mapping[str, Sequence[bytes]]:
        """The contents of all changed files by suffix: edits copy parts of one into another."""
        found: dict[str, list[bytes]] = {}
        for base in self.bases.values():
            for path in base.changed or base.files:
                found.setdefault(Path(path).suffix, []).append(base.files[path])
        return found

    def case(self, seed: int, number: int, kept: Collection[int] | None = None) -> Case:
        """Makes the input with a number.

        Args:
            seed: Seed of the campaign.
            number: The number.
            kept: The edits that are made; None: all.
        """
        name = f"{seed}/{self.name}/{number}"
        rng = Random(name)  # noqa: S311 - inputs, not secrets
        base = rng.choice(list(self.bases.values()))
        weights = base.changed or dict.fromkeys(base.files, 1.0)
        path = rng.choices(list(weights), list(weights.values()))[0]
        content = base.files[path]
        for k in range(num_edits(seed, self, number)):
            if kept is None or k in kept:
                own = Random(f"{name}/{k}")  # noqa: S311 - as above; each edit has its own, so that others can be left out
                changed = edited_file(path, content, own, self._donors[Path(path).suffix], self.words)
                content = changed if len(changed) <= _MOST_BYTES else content
        return Case(base.name, path, content)


def num_edits(seed: int, target: Target, number: int) -> int:
    """The number of edits of an input."""
    rng, count = Random(f"{seed}/{target.name}/{number}/edits"), 1  # noqa: S311 - inputs, not secrets
    while count < _MOST_EDITS and rng.random() < _MORE_EDITS:
        count += 1
    return count
