"""Matches the objects that a task requires to the objects of a generated scene.

The rule, in order:

1. A required and a generated object may be matched if their categories agree: they have the same words, with singular and
   plural being equal (``NestingCup``, ``nesting_cups``), or one is a name of the other. A generated ``wine_glass`` is a
   ``glass``. A generated ``cup`` matches a required ``mug``, which is also called a cup. A ``notebook`` is no ``book``, since
   only whole words count. A ``toothbrush_cup`` is no ``cup``, since the vocabulary knows both and finds no common class. A
   required object without categories (``everything in the tray``) may be matched to any object.
2. Each object is matched at most once, and as many as possible are matched.
3. Of the matchings with the most objects, those with the most equal categories are taken: a mug before a cup, if a mug is
   required.
4. Of these, one with the most relations that hold is taken. Six identical blocks thus get the roles that suit them best.

Steps 2 and 3 are an assignment problem, step 4 is a small integer program; both are solved exactly. A search that is too large
(``MAX_SEARCH``) is not made, and one that needs more than ``MAX_NODES`` nodes is stopped: its relations are unknown, but its
matching still has the most objects.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linear_sum_assignment, milp
from scipy.sparse import coo_array

from stable_data.errors import SceneError
from stable_data.instructions.wording.vocabulary import closeness
from stable_data.instructions.wording.words import type_words
from stable_data.scene import FloatArray, SceneObject

MAX_NODES = 1000
"""Branch-and-bound nodes after which the search for the most relations is stopped: some seconds. Twelve identical objects at
random places, with the directions of another random layout required, need some hundreds; twenty may need more."""

MAX_SEARCH = 250_000
"""Product of the pairs that may be matched and of the choices that the options of relations leave, above which no search is made. A
row of sixteen identical objects is below it, and takes ten seconds; one of thirty would take more than a minute."""

Option: TypeAlias = Mapping[str, Set[str]]
"""One way for a relation to hold: required instance -> the generated instances that it may be matched to for this."""


@dataclass(frozen=True, slots=True)
class RequiredObject:
    """An object that a scene must have.

    Attributes:
        instance: Its name in the requirements.
        categories: Accepted categories, all equally good; none: any category is accepted.
    """

    instance: str
    categories: tuple[str, ...]

    def __post_init__(self) -> None:
        """Refuses categories without words, because no object could be matched to them."""
        if self.categories and not any(type_words(category) for category in self.categories):
            raise SceneError(
                f"required object {self.instance} has categories {self.categories}, expected categories with words",
                "task_objects_unknown",
            )

    def __str__(self) -> str:
        return " or ".join(" ".join(type_words(category)) for category in self.categories) or "anything"


@dataclass(frozen=True, slots=True)
class DesiredRelation:
    """A relation that should hold.

    Attributes:
        weight: Its weight in the sum to maximise, a whole number.
        options: The ways for it to hold; empty if no matching makes it hold.
    """

    weight: int
    options: tuple[Option, ...]

    def holds(self, matches: Mapping[str, str]) -> bool:
        """Whether it holds under a matching, required instance -> generated instance."""
        return any(all(matches.get(name) in allowed for name, allowed in option.items()) for option in self.options)


@dataclass(frozen=True, slots=True)
class ObjectMatching:
    """A matching with the most objects.

    Attributes:
        matches: Required instance -> generated instance.
        is_best: No other such matching makes more relations hold. False if the search was stopped.
    """

    matches: Mapping[str, str]
    is_best: bool


def candidates(required: Sequence[RequiredObject], objects: Sequence[SceneObject]) -> dict[str, dict[str, int]]:
    """Returns the generated objects that each required object may be matched to.

    Returns:
        Required instance -> generated instance -> closeness, 1 or 2.
    """
    return _close_ones(required, {o.instance: o.category for o in objects})


def unmatched(required: Sequence[RequiredObject], categories: Sequence[str]) -> tuple[RequiredObject, ...]:
    """Returns the required objects that remain without a match if as many as possible are matched.

    Args:
        required: The required objects.
        categories: The category of each object that there is.
    """
    allowed = _close_ones(required, {str(k): category for k, category in enumerate(categories)})
    found = match(allowed).matches if any(allowed.values()) else {}
    return tuple(r for r in required if r.instance not in found)


def _close_ones(required: Sequence[RequiredObject], categories: Mapping[str, str]) -> dict[str, dict[str, int]]:
    """For each required object the generated ones that it may be matched to, by their categories."""
    found: dict[str, dict[str, int]] = {}
    for r in required:
        close = {name: max((closeness(one, c) for c in r.categories), default=1) for name, one in categories.items()}
        found[r.instance] = {name: how for name, how in close.items() if how}
    return found


def match(allowed: Mapping[str, Mapping[str, int]], desired: Sequence[DesiredRelation] = ()) -> ObjectMatching:
    """Finds the best matching by the module's rule.

    Args:
        allowed: From :func:`candidates`.
        desired: Relations that should hold; the sum of their weights is maximised.
    """
    pairs = [(r, o) for r, row in allowed.items() for o in row]
    # One more matched object outweighs every bonus of 1 for an equal category.
    values = np.array([len(allowed) + 1 + (allowed[r][o] == 2) for r, o in pairs], np.float64)
    matches, most = _largest_matching(pairs, values)
    possible = [relation for relation in desired if relation.options]
    if all(relation.holds(matches) for relation in possible):
        return ObjectMatching(matches, is_best=True)
    best = _best_matching(pairs, values, most, possible)
    return ObjectMatching(matches if best is None else best, is_best=best is not None)


def _largest_matching(pairs: Sequence[tuple[str, str]], values: FloatArray) -> tuple[dict[str, str], float]:
    """The matching of the greatest value, and that value."""
    rows, columns = ({name: k for k, name in enumerate(dict.fromkeys(pair[side] for pair in pairs))} for side in (0, 1))
    table = np.zeros((len(rows), len(columns)))  # 0: the two objects may not be matched
    for (r, o), value in zip(pairs, values, strict=True):
        table[rows[r], columns[o]] = value
    required, objects = list(rows), list(columns)
    chosen = [(i, k) for i, k in zip(*linear_sum_assignment(table, maximize=True), strict=True) if table[i, k] > 0]
    return {required[i]: objects[k] for i, k in chosen}, float(sum(table[i, k] for i, k in chosen))


def _best_matching(
    pairs: Sequence[tuple[str, str]], values: FloatArray, most: float, desired: Sequence[DesiredRelation]
) -> dict[str, str] | None:
    """The matching of the greatest value that fulfils the most relations; None if the search was not made or was stopped.

    There is one variable, 0 or 1, for each pair, and one for each option of each relation. An option can be chosen only if
    every instance that it mentions is matched to an object that it allows.
    """
    choices = (len(allowed) - 1 for relation in desired for option in relation.options for allowed in option.values())
    if len(pairs) * sum(choices) > MAX_SEARCH:
        return None
    number = {pair: k for k, pair in enumerate(pairs)}
    program = _IntegerProgram([0.0] * len(pairs))
    for side in (0, 1):  # each required and each generated object is in at most one pair
        for name in dict.fromkeys(pair[side] for pair in pairs):
            program.limit([k for pair, k in number.items() if pair[side] == name], [], 1.0)
    for relation in desired:
        chosen = [program.variable(float(relation.weight)) for _ in relation.options]
        program.limit(chosen, [], 1.0)  # a relation counts once, however many of its options hold
        for variable, option in zip(chosen, relation.options, strict=True):
            for name, allowed in option.items():
                program.limit([variable], [number[name, o] for o in sorted(allowed) if (name, o) in number], 0.0)
    solution = program.solve(values, most)
    return None if solution is None else {r: o for (r, o), value in zip(pairs, solution, strict=False) if value > 0.5}


class _IntegerProgram:
    """An integer program: maximise the sum of gains under limits on sums of variables."""

    def __init__(self, gains: list[float]) -> None:
        self.gains = gains
        self._num_pairs = len(gains)
        self._entries: list[tuple[int, int, float]] = []
        self._upper: list[float] = []

    def variable(self, gain: float) -> int:
        self.gains.append(gain)
        return len(self.gains) - 1

    def limit(self, plus: Sequence[int], minus: Sequence[int], upper: float) -> None:
        """Requires that the sum of ``plus`` exceeds the sum of ``minus`` by at most ``upper``."""
        row = len(self._upper)
        self._entries += [(row, k, 1.0) for k in plus] + [(row, k, -1.0) for k in minus]
        self._upper.append(upper)

    def solve(self, values: FloatArray, most: float) -> FloatArray | None:
        """The pairs of the best solution whose value is ``most``; None if it was not found within MAX_NODES."""
        row, column, value = zip(*self._entries, strict=True)
        limits = coo_array((value, (row, column)), shape=(len(self._upper), len(self.gains))).tocsr()
        total = np.concatenate([values, np.zeros(len(self.gains) - self._num_pairs)])
        found = milp(
            -np.array(self.gains),
            integrality=(np.arange(len(self.gains)) < self._num_pairs).astype(np.int64),  # options follow from the pairs
            bounds=Bounds(0, 1),
            # Values are whole numbers, so half of one below the most admits no smaller matching.
            constraints=[LinearConstraint(limits, ub=self._upper), LinearConstraint(total[None], lb=most - 0.5)],
            options={"node_limit": MAX_NODES, "mip_rel_gap": 0.0},
        )
        return np.asarray(found.x[: self._num_pairs]) if found.status == 0 else None
