"""Which objects of a generated scene are the ones that a task requires.

The rule, in order:

1. A required object and a generated one may be matched when their categories say the same: the same words, one and many being
   alike (``NestingCup``, ``nesting_cups``), or one is a name of the other. A generated ``wine_glass`` is a ``glass``, and a
   generated ``cup`` will do for a ``mug``, which is also called one; a ``notebook`` is no ``book``, since only whole words
   count, and a ``toothbrush_cup`` is no ``cup``, since the vocabulary knows both and finds nothing in common.
   What is asked for as no kind of thing (``everything in the tray``) may be anything.
2. Each is matched at most once, and as many as possible are matched.
3. Of the matchings with the most objects those with the most equal categories are taken: a mug before a cup, if a mug is asked.
4. Of these, one under which the most relations hold. Six identical blocks are thus given the roles that suit them best.

Steps 2 and 3 are an assignment problem, step 4 is a small integer programme; both are solved exactly. A search that would
need more than ``MAX_NODES`` branchings is given up and says so: its relations are unknown, its matches are still the most.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linear_sum_assignment, milp
from scipy.sparse import coo_array

from stable_data.errors import SceneError
from stable_data.instructions.wording.vocabulary import classes_of, nouns_of
from stable_data.instructions.wording.words import singular, type_words
from stable_data.scene import FloatArray, SceneObject

MAX_NODES = 1000
"""Branchings after which the search for the most relations is given up: some seconds. Twelve identical objects strewn at random,
asked for another random layout's directions, need some hundreds; twenty may need more."""

Option: TypeAlias = Mapping[str, Set[str]]
"""One way for a relation to hold: required instance -> the generated ones that it may be matched to for that."""


@dataclass(frozen=True, slots=True)
class RequiredObject:
    """An object that a scene must have.

    Attributes:
        instance: What it is called where it is asked for.
        categories: Any of these will do, equally well; none: anything will.
    """

    instance: str
    categories: tuple[str, ...]

    def __post_init__(self) -> None:
        """Refuses an object of kinds without words, which nothing could be matched to."""
        if self.categories and not any(type_words(category) for category in self.categories):
            raise SceneError(
                f"required object {self.instance} has categories {self.categories}, expected categories with words",
                "task_objects_unknown",
            )

    def __str__(self) -> str:
        """The categories as words."""
        return " or ".join(" ".join(type_words(category)) for category in self.categories) or "anything"


@dataclass(frozen=True, slots=True)
class DesiredRelation:
    """A relation that should hold.

    Attributes:
        weight: How much it counts, a whole number.
        options: The ways for it to hold; empty where no matching can do that.
    """

    weight: int
    options: tuple[Option, ...]

    def holds(self, matches: Mapping[str, str]) -> bool:
        """Does it hold under a matching, required instance -> generated instance?"""
        return any(all(matches.get(name) in allowed for name, allowed in option.items()) for option in self.options)


@dataclass(frozen=True, slots=True)
class ObjectMatching:
    """A matching with the most objects.

    Attributes:
        matches: Required instance -> generated instance.
        is_best: No other such matching lets more relations hold. False where the search was given up.
    """

    matches: Mapping[str, str]
    is_best: bool


def closeness(found: str, wanted: str) -> int:
    """How well a generated category answers to a required one: 2 the same words, 1 one is a name of the other, 0 not at all."""
    return _closeness(singular(type_words(found)), singular(type_words(wanted)), found, wanted)


@lru_cache(maxsize=65536)
def _closeness(found: tuple[str, ...], wanted: tuple[str, ...], found_name: str, wanted_name: str) -> int:
    if not found or not wanted:
        return 0
    if found == wanted:
        return 2
    answers = any(noun[-len(wanted) :] == wanted for noun in _names_of(found_name)) or found in _names_of(wanted_name)
    one, other = classes_of(found_name), classes_of(wanted_name)
    return int(answers and (bool(one & other) or not (one and other)))


def _names_of(category: str) -> list[tuple[str, ...]]:
    return [singular(type_words(noun)) for noun in nouns_of(category)]


def candidates(required: Sequence[RequiredObject], objects: Sequence[SceneObject]) -> dict[str, dict[str, int]]:
    """The generated objects that each required one may be matched to.

    Args:
        required: What is asked for.
        objects: What is there.

    Returns:
        Required instance -> generated instance -> closeness, 1 or 2.
    """
    found: dict[str, dict[str, int]] = {}
    for r in required:
        close = {o.instance: max((closeness(o.category, c) for c in r.categories), default=1) for o in objects}
        found[r.instance] = {name: how for name, how in close.items() if how}
    return found


def match(may_be: Mapping[str, Mapping[str, int]], wishes: Sequence[DesiredRelation] = ()) -> ObjectMatching:
    """The best matching by the module's rule.

    Args:
        may_be: From :func:`candidates`.
        wishes: Relations that should hold; the greatest sum of weights is sought.

    Returns:
        The matching.
    """
    pairs = [(r, o) for r, row in may_be.items() for o in row]
    worth = np.array([len(may_be) + 1 + (may_be[r][o] == 2) for r, o in pairs], np.float64)
    matches, most = _most(pairs, worth)
    open_wishes = [wish for wish in wishes if wish.options]
    if not open_wishes or sum(wish.weight for wish in open_wishes if wish.holds(matches)) == sum(w.weight for w in open_wishes):
        return ObjectMatching(matches, is_best=True)
    best = _most_wishes(pairs, worth, most, open_wishes)
    return ObjectMatching(matches if best is None else best, is_best=best is not None)


def _most(pairs: Sequence[tuple[str, str]], worth: FloatArray) -> tuple[dict[str, str], float]:
    """The matching of the greatest worth, and that worth."""
    rows, columns = ({name: k for k, name in enumerate(dict.fromkeys(pair[side] for pair in pairs))} for side in (0, 1))
    table = np.zeros((len(rows), len(columns)))
    for (r, o), value in zip(pairs, worth, strict=True):
        table[rows[r], columns[o]] = value
    required, objects = list(rows), list(columns)
    chosen = [(i, k) for i, k in zip(*linear_sum_assignment(table, maximize=True), strict=True) if table[i, k] > 0]
    return {required[i]: objects[k] for i, k in chosen}, float(sum(table[i, k] for i, k in chosen))


def _most_wishes(
    pairs: Sequence[tuple[str, str]], worth: FloatArray, most: float, wishes: Sequence[DesiredRelation]
) -> dict[str, str] | None:
    """The matching of greatest worth that fulfils the most wishes; None where the search was given up.

    A variable of 0 or 1 stands for each pair, and one for each option of each wish. An option is chosen only where every
    instance that it speaks of is matched to an object that it allows.
    """
    number = {pair: k for k, pair in enumerate(pairs)}
    programme = _Programme([0.0] * len(pairs))
    for side in (0, 1):
        for name in dict.fromkeys(pair[side] for pair in pairs):
            programme.limit([k for pair, k in number.items() if pair[side] == name], [], 1.0)
    for wish in wishes:
        chosen = [programme.variable(float(wish.weight)) for _ in wish.options]
        programme.limit(chosen, [], 1.0)
        for variable, option in zip(chosen, wish.options, strict=True):
            for name, allowed in option.items():
                programme.limit([variable], [number[name, o] for o in sorted(allowed) if (name, o) in number], 0.0)
    values = programme.solve(worth, most)
    return None if values is None else {r: o for (r, o), value in zip(pairs, values, strict=False) if value > 0.5}


class _Programme:
    """An integer programme in the making: maximise gains under limits on sums."""

    def __init__(self, gains: list[float]) -> None:
        self.gains = gains
        self._num_pairs = len(gains)
        self._entries: list[tuple[int, int, float]] = []
        self._upper: list[float] = []

    def variable(self, gain: float) -> int:
        self.gains.append(gain)
        return len(self.gains) - 1

    def limit(self, plus: Sequence[int], minus: Sequence[int], upper: float) -> None:
        """The sum of ``plus`` exceeds that of ``minus`` by at most ``upper``."""
        row = len(self._upper)
        self._entries += [(row, k, 1.0) for k in plus] + [(row, k, -1.0) for k in minus]
        self._upper.append(upper)

    def solve(self, worth: FloatArray, most: float) -> FloatArray | None:
        """The pairs of the best solution whose worth is the most; None where it was not found within MAX_NODES."""
        row, column, value = zip(*self._entries, strict=True)
        limits = coo_array((value, (row, column)), shape=(len(self._upper), len(self.gains))).tocsr()
        total = np.concatenate([worth, np.zeros(len(self.gains) - self._num_pairs)])
        found = milp(
            -np.array(self.gains),
            integrality=(np.arange(len(self.gains)) < self._num_pairs).astype(np.int64),  # options follow from the pairs
            bounds=Bounds(0, 1),
            constraints=[LinearConstraint(limits, ub=self._upper), LinearConstraint(total[None], lb=most - 0.5)],
            options={"node_limit": MAX_NODES, "mip_rel_gap": 0.0},
        )
        return np.asarray(found.x[: self._num_pairs]) if found.status == 0 else None
