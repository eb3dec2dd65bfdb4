"""Which generated object is which required one."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import SceneError
from stable_data.instructions.wording.vocabulary import closeness
from stable_data.metrics import matching
from stable_data.metrics.matching import DesiredRelation, RequiredObject, candidates, match
from stable_data.scene import SceneObject


def thing(instance: str, category: str) -> SceneObject:
    return SceneObject(instance, category, (0.1, 0.1, 0.05), 0.0, (0.1, 0.1, 0.1))


@pytest.mark.parametrize(
    ("found", "wanted", "how"),
    [
        ("nesting_cup", "NestingCups", 2),
        ("mug", "cup", 1),  # a mug is also called a cup
        ("cup", "mug", 1),  # and what is called a cup will do for it
        ("wine_glass", "glass", 1),
        ("tumbler", "drinking_glass", 1),
        ("drinking_glass", "tumbler", 1),
        ("glass", "wine_glass", 0),  # a wine glass is more than a glass
        ("toothbrush_cup", "cup", 0),
        ("notebook", "book", 0),
        ("headphones", "phone", 0),
        ("eggplant", "plant", 0),
        ("fork", "spoon", 0),
        ("", "", 0),
    ],
)
def test_categories_answer_to_each_other_by_whole_words(found: str, wanted: str, how: int) -> None:
    assert closeness(found, wanted) == how


def test_one_object_is_one_required_object_at_most() -> None:
    asked = [RequiredObject("a", ("mug",)), RequiredObject("b", ("mug",))]
    assert len(match(candidates(asked, [thing("x", "mug")])).matches) == 1


def test_the_most_objects_come_first_and_equal_categories_second() -> None:
    asked = [RequiredObject("a", ("mug",)), RequiredObject("b", ("cup",))]
    both = match(candidates(asked, [thing("x", "cup"), thing("y", "mug")]))
    assert both.matches == {"a": "y", "b": "x"}
    # The only mug must be the cup, or nothing is: two matches with no equal category come before one with it.
    asked = [RequiredObject("a", ("mug",)), RequiredObject("b", ("coffee mug",))]
    assert len(match(candidates(asked, [thing("x", "mug"), thing("y", "cup")])).matches) == 2


def test_equal_categories_come_before_relations() -> None:
    asked = [RequiredObject("a", ("mug",))]
    may_be = candidates(asked, [thing("x", "mug"), thing("y", "cup")])
    assert match(may_be, [DesiredRelation(1, ({"a": {"y"}},))]).matches == {"a": "x"}


def test_any_of_several_categories_will_do() -> None:
    asked = [RequiredObject("a", ("tumbler", "mug"))]
    assert match(candidates(asked, [thing("x", "mug")])).matches == {"a": "x"}
    assert str(asked[0]) == "tumbler or mug"


def test_anything_will_do_where_no_kind_is_said() -> None:
    asked = [RequiredObject("a", ("mug",)), RequiredObject("b", ())]
    there = [thing("x", "mug"), thing("y", "stapler")]
    assert match(candidates(asked, there)).matches == {"a": "x", "b": "y"}
    assert match(candidates(asked, there[:1])).matches == {"a": "x"}
    assert str(asked[1]) == "anything"


def test_an_object_of_kinds_without_words_is_refused() -> None:
    with pytest.raises(SceneError, match="expected categories with words"):
        RequiredObject("a", ("", "__"))


def test_nothing_there_matches_nothing() -> None:
    asked = [RequiredObject("a", ("mug",))]
    found = match(candidates(asked, []), [DesiredRelation(1, ())])
    assert found.matches == {}
    assert found.is_best


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5), st.integers(2, 5))
def test_the_search_is_as_good_as_trying_all(seed: int, num_asked: int, num_there: int) -> None:
    rng = np.random.default_rng(seed)
    words = ("mug", "cup", "plate")
    asked = [RequiredObject(f"r{k}", (str(rng.choice(words)),)) for k in range(num_asked)]
    there = [thing(f"o{k}", str(rng.choice(words))) for k in range(num_there)]
    may_be = candidates(asked, there)
    wishes = []
    for _ in range(int(rng.integers(0, 6))):
        one, other = (f"r{k}" for k in rng.choice(num_asked, 2, replace=False))
        held = rng.random((num_there, num_there)) < 0.3
        options = tuple({one: {f"o{k}"}, other: {f"o{n}" for n in np.flatnonzero(held[k])}} for k in range(num_there))
        wishes.append(DesiredRelation(int(rng.integers(1, 4)), options))

    def score(matches: dict[str, str]) -> tuple[int, int, int]:
        equal = sum(may_be[r][o] == 2 for r, o in matches.items())
        return len(matches), equal, sum(w.weight for w in wishes if w.holds(matches))

    places = [*(o.instance for o in there), *[""] * num_asked]
    every = (dict(zip(may_be, chosen, strict=True)) for chosen in set(permutations(places, num_asked)))
    matchings = ({r: o for r, o in one.items() if o} for one in every)
    best = max(score(m) for m in matchings if all(o in may_be[r] for r, o in m.items()))
    found = match(may_be, wishes)
    assert found.is_best
    assert score(dict(found.matches)) == best


def test_a_search_that_is_given_up_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    may_be = {f"r{k}": {f"o{n}": 2 for n in range(9)} for k in range(9)}
    held = rng.random((24, 9, 9)) < 0.3
    ends = [rng.choice(9, 2, replace=False) for _ in held]
    wishes = [
        DesiredRelation(
            1, tuple({f"r{i}": {f"o{k}"}, f"r{j}": {f"o{n}" for n in np.flatnonzero(row)}} for k, row in enumerate(table))
        )
        for (i, j), table in zip(ends, held, strict=True)
    ]
    monkeypatch.setattr(matching, "MAX_NODES", 0)
    found = match(may_be, wishes)
    assert not found.is_best
    assert len(found.matches) == 9


def test_a_row_of_very_many_like_objects_is_not_searched() -> None:
    """It would take minutes."""
    asked = [RequiredObject(f"r{k}", ("dice",)) for k in range(40)]
    may_be = candidates(asked, [thing(f"o{k}", "dice") for k in range(40)])
    beside = tuple(
        DesiredRelation(1, tuple({f"r{k}": {f"o{n}"}, f"r{k + 1}": {f"o{m}" for m in range(n)}} for n in range(1, 40)))
        for k in range(39)
    )
    found = match(may_be, beside)
    assert len(found.matches) == 40
    assert not found.is_best
    in_order = match(may_be, tuple(DesiredRelation(1, ({f"r{k}": {f"o{k}"}},)) for k in range(40)))
    assert in_order.is_best
