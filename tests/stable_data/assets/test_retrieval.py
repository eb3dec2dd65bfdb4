"""From words and boxes to assets."""

import math
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.assets import retrieval
from stable_data.assets.box_fitting import turned_box
from stable_data.assets.catalog import Asset, AssetLibrary, RestingTilt
from stable_data.assets.ranking import TURNED_FIT
from stable_data.assets.retrieval import Answer, AssetMatch, AssetQuery, BarredAsset, Retriever, UnmatchedQuery
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.text_embeddings import Rows
from stable_data.errors import ConfigError, SceneError
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.scene import UPRIGHT, Vec3
from tests.stable_data.assets.bag_of_words import LAID, BagOfWords, bottle, library, thing

CUBE = (0.1, 0.1, 0.1)


def found(answer: Answer) -> str:
    assert isinstance(answer, AssetMatch), answer
    return answer.asset_id


def retriever(*assets: Asset, **values: object) -> Retriever:
    return Retriever([library(*assets)], BagOfWords(), replace(RetrievalSettings(), **values))  # type: ignore[arg-type]


def ask(tool: Retriever, text: str, size: Vec3 = CUBE, category: str | None = None, key: str = "", seed: int = 0) -> Answer:
    return tool.retrieve([AssetQuery(text, size, category, key)], seed)[0]


def test_words_decide() -> None:
    tool = retriever(thing("mug", "a red mug"), thing("bowl", "a red bowl"), thing("fork", "a steel fork"))
    assert found(ask(tool, "a red bowl")) == "bowl"
    answer = ask(tool, "a steel fork", (0.3, 0.3, 0.3))
    assert isinstance(answer, AssetMatch)
    assert answer.library == "first"
    assert (answer.text_score, answer.size_score, answer.score) == pytest.approx((1, 1, 1))
    assert answer.scale + answer.size == pytest.approx((0.3,) * 6)


def test_only_what_is_carried_leans() -> None:
    """A brush that was only seen lying, and how it would lean: what stands on the table gets it as it was seen."""
    tilt = (math.sin(0.1), 0.0, 0.0, math.cos(0.1))
    seen, leant = RestingTilt(LAID, (0.1, 2.0, 0.1), 3), RestingTilt(tilt, (0.1, 0.5, 2.0))
    tool = retriever(Asset("brush", "brush", "a red brush", (0.1, 0.1, 2.0), (seen, leant)))
    for leans in (False, True):
        answers = tool.retrieve(
            [AssetQuery("a red brush", size, leans=leans) for size in ((0.01, 0.05, 0.2), (0.01, 0.2, 0.01))]
        )
        standing, lying = (answer for answer in answers if isinstance(answer, AssetMatch))
        assert standing.tilt_quat_xyzw == (tilt if leans else LAID)
        assert lying.tilt_quat_xyzw == LAID
        assert standing.size_score > 0.99 or not leans


def test_the_score_is_nine_parts_text_and_one_part_size() -> None:
    answer = ask(retriever(thing("a", "a red mug", (3.0, 4.0, 0.0))), "a blue mug", (4.0, 3.0, 0.0))
    text = float(np.dot(*BagOfWords()(["a red mug", "a blue mug"])))
    assert isinstance(answer, AssetMatch)
    assert answer.text_score == pytest.approx(text, abs=1e-6)
    assert answer.size_score == pytest.approx(24 / 25)
    assert answer.score == pytest.approx(0.9 * text + 0.1 * 24 / 25, abs=1e-6)


def test_of_equal_words_the_proportions_decide_and_the_size_does_not() -> None:
    tool = retriever(thing("flat", "a box", (4.0, 4.0, 1.0)), thing("high", "a box", (1.0, 1.0, 4.0)))
    for factor in (0.01, 1.0, 100.0):
        assert found(ask(tool, "a box", (factor, factor, 4 * factor))) == "high"
        assert found(ask(tool, "a box", (4 * factor, 4 * factor, factor))) == "flat"


def test_what_is_not_there_is_reported_with_the_nearest() -> None:
    tool = retriever(thing("mug", "a red mug"), thing("fork", "one steel fork"))
    answer = ask(tool, "some red elephant")
    assert isinstance(answer, UnmatchedQuery)
    assert (answer.nearest, answer.library) == ("mug", "first")
    text = float(np.dot(*BagOfWords()(["a red mug", "some red elephant"])))
    assert answer.text_score == pytest.approx(text, abs=1e-6)
    assert answer.reason == (
        f"no asset is similar to 'some red elephant': the nearest is 'a red mug' of library first at {text:.2f}, expected at least 0.55"
    )
    assert found(ask(retriever(*tool._libraries[0][1].assets, floor=-1.0), "some red elephant")) == "mug"


@given(st.floats(-1.0, 1.0))
def test_the_floor_is_of_the_text_score(floor: float) -> None:
    answer = ask(retriever(thing("mug", "a red mug"), floor=floor), "a green mug")
    assert isinstance(answer, AssetMatch) == (answer.text_score >= floor)


def test_annotations_and_licences_keep_assets_out_and_take_no_place() -> None:
    bad = [
        thing("1", "a red mug", on_table=False),
        thing("2", "a red mug", mark_deletion=True),
        thing("3", "a red mug", is_composite=True),
    ]
    free, unknown = thing("4", "a red cup", licence="CC0"), thing("5", "a red mug")
    assert found(ask(retriever(*bad, free, top_k_text=1), "a red mug")) == "4"
    assert found(ask(retriever(*bad, free, unknown), "a red mug")) == "5"
    assert found(ask(retriever(*bad, free, unknown, licences=frozenset({"CC0", "MIT"})), "a red mug")) == "4"
    assert found(ask(retriever(*bad, free, unknown, licences=frozenset({"cc0 1.0"})), "a red mug")) == "4"
    with pytest.raises(ConfigError, match="libraries first offer no asset under the licences MIT, expected at least one"):
        retriever(*bad, free, unknown, licences=frozenset({"MIT"}))
    with pytest.raises(ConfigError, match="offer no asset under the licences any"):
        retriever(*bad)


def test_only_the_nearest_by_text_are_looked_at_if_so_set() -> None:
    words = " ".join(map(str, range(30)))
    assets = [thing("exact", words, (1.0, 1.0, 99.0)), thing("near", f"{words} more", (1.0, 1.0, 1.0))]
    assert found(ask(retriever(*assets), words)) == "near"
    assert found(ask(retriever(*assets, top_k_text=2), words)) == "near"
    assert found(ask(retriever(*assets, top_k_text=1), words)) == "exact"


def test_of_equal_words_the_first_take_the_places() -> None:
    assets = [thing("a", "a box", (1.0, 1.0, 9.0)), thing("b", "a box"), thing("c", "a fork")]
    assert found(ask(retriever(*assets), "a box")) == "b"
    assert found(ask(retriever(*assets, top_k_text=1), "a box")) == "a"


def test_the_first_library_that_has_a_match_serves() -> None:
    encoder = BagOfWords()
    first = library(thing("cup", "a red cup"), name="unseen")
    second = library(thing("mug", "a red mug"), thing("fork", "steel fork"), name="usual")
    tool = Retriever([first, second], encoder)
    answers = tool.retrieve([AssetQuery(text, CUBE) for text in ("a red mug", "steel fork", "no such thing", "red cup")])
    assert [answers[k].library for k in (0, 1, 3)] == ["unseen", "usual", "unseen"]
    assert [found(answers[k]) for k in (0, 1, 3)] == ["cup", "fork", "cup"]
    reverse = Retriever([second, first], encoder).retrieve([AssetQuery(text, CUBE) for text in ("a red mug", "no such thing")])
    assert found(reverse[0]) == "mug"
    assert isinstance(answers[2], UnmatchedQuery)
    assert reverse[1].text_score == answers[2].text_score  # the nearest of all libraries, whatever their order


def test_an_asset_of_the_wanted_noun_needs_no_similar_words() -> None:
    tool = retriever(thing("a", "fruit (scanned)", category="apple"), thing("b", "one red round fruit", category="strawberry"))
    answer = ask(tool, "something to eat", category="apple")
    assert isinstance(answer, AssetMatch)
    assert answer.asset_id == "a"
    assert answer.text_score < tool.settings.floor
    assert isinstance(ask(tool, "something to eat", category="pear"), UnmatchedQuery)
    assert isinstance(ask(tool, "something to eat"), UnmatchedQuery)
    without = AssetQuery("something to eat", CUBE, "apple", without=frozenset({"a"}))
    assert isinstance(tool.retrieve([without])[0], UnmatchedQuery)


@pytest.mark.parametrize(
    ("wanted", "served"),
    [
        ("pot", "second/cooking_pot"),  # a lid is no pot, however similar its words are
        ("kitchen_knife", "second/kitchen_knife"),  # the knife of the first may be another one
        ("plum", "second/plum"),
        ("peach", "first/"),  # no library has one
    ],
)
def test_another_noun_serves_only_where_no_library_has_the_wanted_one(wanted: str, served: str) -> None:
    words = wanted.replace("_", " ")
    first = [thing(f"first/{kind}", f"one {words}", category=kind) for kind in ("pot_lid", "knife", "tomato")]
    second = [thing(f"second/{kind}", f"one {words} more", category=kind) for kind in ("cooking_pot", "kitchen_knife", "plum")]
    tool = Retriever([library(*first), library(*second, name="second")], BagOfWords())
    answer = ask(tool, f"one {words}", category=wanted)
    assert found(answer).startswith(served)


def test_a_kind_in_a_later_library_comes_before_anything_alike_in_the_first() -> None:
    first = library(thing("1/spice_jar", "a small white teapot of clay", category="spice_jar"))
    second = library(thing("2/teapot", "something round", category="teapot"), name="second")
    answer = ask(Retriever([first, second], BagOfWords()), "a small white teapot of clay", category="teapot")
    assert found(answer) == "2/teapot"
    alone = ask(Retriever([first], BagOfWords()), "a small white teapot of clay", category="teapot")
    assert isinstance(alone, AssetMatch)
    assert alone.category == "spice_jar"  # and it does not count as a teapot


@pytest.mark.parametrize(
    ("wanted", "served"), [("fruit", "apple"), ("skillet", "frying_pan"), ("bread", "baguette"), ("apple", "other/apple")]
)
def test_kinds_and_synonyms_of_the_first_library_serve_and_wider_nouns_do_not(wanted: str, served: str) -> None:
    own = [
        thing(kind, "a thing", category=kind) for kind in ("frying_pan", "baguette", "fruit" if wanted == "apple" else "apple")
    ]
    others = [thing(f"other/{kind}", "a thing", category=kind) for kind in ("fruit", "skillet", "bread", "apple")]
    tool = Retriever([library(*own), library(*others, name="other")], BagOfWords())
    assert found(ask(tool, "a thing", category=wanted)) == served


def test_sizes_are_exact_or_in_their_range() -> None:
    exact = thing("exact", "a mug", (2.0, 1.0, 1.0), "mug", size_range=(0.12, 0.12))
    ranged = thing("ranged", "a bowl", (2.0, 1.0, 1.0), "bowl", size_range=(0.1, 0.2))
    free = thing("free", "a fork", (2.0, 1.0, 1.0), "fork")
    for wanted, bowl in ((0.05, 0.1), (0.15, 0.15), (0.9, 0.2)):
        size = (wanted, wanted / 2, wanted / 2)
        for slack in (1.0, 1.3):
            tool = retriever(exact, ranged, free, metric_slack=slack)
            answers = [ask(tool, f"a {kind}", size, kind) for kind in ("mug", "bowl", "fork")]
            lengths = [max(answer.size) for answer in answers if isinstance(answer, AssetMatch)]
            limits = [np.clip(wanted, low / slack, high * slack) for low, high in ((0.12, 0.12), (0.1, 0.2))]
            assert lengths == pytest.approx([*limits, wanted])
            assert slack > 1 or lengths[:2] == pytest.approx([0.12, bowl])


def test_an_asset_is_stretched_only_to_sizes_that_it_has() -> None:
    ranges = {"exact": (0.2, 0.2), "within": (0.1, 0.3), "small": (0.01, 0.15)}
    for name, limits in ranges.items():
        answer = ask(retriever(thing(name, "a box", size_range=limits), stretch=True), "a box", (0.2, 0.15, 0.15))
        assert isinstance(answer, AssetMatch)
        assert (answer.size == (0.2, 0.15, 0.15)) is (name == "within")
        assert ("a size that such an asset does not have" in answer.note) is (name != "within")


def test_of_two_that_fit_that_of_the_true_size_is_preferred() -> None:
    small = thing("small", "a bowl", category="bowl", size_range=(0.1, 0.1))
    large = thing("large", "a bowl", category="bowl", size_range=(0.3, 0.3))
    tool = retriever(small, large)
    for seed in range(10):
        assert found(ask(tool, "a bowl", (0.11, 0.11, 0.11), "bowl", seed=seed)) == "small"
        assert found(ask(tool, "a bowl", (0.26, 0.26, 0.26), "bowl", seed=seed)) == "large"


def test_what_is_more_than_twice_too_large_comes_after_the_other_libraries() -> None:
    first = library(thing("1/plate", "a plate", category="plate", size_range=(0.25, 0.25)))
    second = library(thing("2/plate", "another plate of tin", category="plate"), name="second")
    tool = Retriever([first, second], BagOfWords())
    served = {cm: found(ask(tool, "a plate", (cm / 100, cm / 100, cm / 100), "plate")) for cm in (10, 12, 13, 49, 51)}
    assert served == {10: "2/plate", 12: "2/plate", 13: "1/plate", 49: "1/plate", 51: "2/plate"}
    assert found(ask(Retriever([first], BagOfWords()), "a plate", (0.1, 0.1, 0.1), "plate")) == "1/plate"  # better than none


def test_what_holds_something_is_a_container_if_a_library_has_one() -> None:
    first = library(thing("1/plate", "a plate", category="plate", is_container=False))
    second = library(thing("2/plate", "a plate", category="plate", is_container=True), name="second")
    tool, alone = Retriever([first, second], BagOfWords()), Retriever([first], BagOfWords())
    served = [
        found(one.retrieve([AssetQuery("a plate", CUBE, "plate", holds=holds)])[0])
        for one, holds in ((tool, False), (tool, True), (alone, True))
    ]
    assert served == ["1/plate", "2/plate", "1/plate"]


def test_sizes_change_no_answer_where_they_are_unknown() -> None:
    plain = Retriever([CROWD], Noise()).retrieve(CROWD_QUERIES, seed=4)
    wide = replace(CROWD, assets=tuple(replace(a, size_range=(1e-9, 1e9)) for a in CROWD.assets))
    assert Retriever([wide], Noise()).retrieve(CROWD_QUERIES, seed=4) == plain


def test_a_batch_with_sizes_answers_as_each_query_alone() -> None:
    sized = replace(CROWD, assets=tuple(replace(a, size_range=(0.2, 0.4)) if k % 3 else a for k, a in enumerate(CROWD.assets)))
    tool = Retriever([sized, replace(CROWD, name="later")], Noise())
    batch = tool.retrieve(CROWD_QUERIES, seed=4)
    assert batch[::-1] == tool.retrieve(CROWD_QUERIES[::-1], seed=4)
    assert batch[::11] == [tool.retrieve([query], seed=4)[0] for query in CROWD_QUERIES[::11]]


def test_a_knife_along_the_other_side_is_turned() -> None:
    tool = retriever(thing("knife", "a knife", (10.0, 1.0, 0.5), "knife"))
    along, across = (ask(tool, "a knife", size, "knife") for size in ((0.2, 0.02, 0.01), (0.02, 0.2, 0.01)))
    assert isinstance(along, AssetMatch)
    assert isinstance(across, AssetMatch)
    assert (along.is_turned, across.is_turned) == (False, True)
    assert along.size == across.size == pytest.approx((0.2, 0.02, 0.01))  # each in its own yaw frame
    assert across.size_score == pytest.approx(1)


def test_a_barred_licence_is_said_with_the_substitute() -> None:
    best = thing("best", "a red mug of clay", category="mug", licence="CC BY-NC 4.0")
    other = thing("other", "a mug", category="mug", licence="CC0")
    tool = retriever(best, other, licences=frozenset({"CC0", "CC-BY"}))
    answer = ask(tool, "a red mug of clay", category="mug")
    assert found(answer) == "other"
    assert answer.barred == BarredAsset("best", "first", "CC BY-NC 4.0")
    assert str(answer.barred) == "asset best of library first, whose licence 'CC BY-NC 4.0' is not allowed"
    assert ask(tool, "a mug", category="mug").barred is None  # the allowed one is the best match itself
    assert ask(retriever(best, other), "a red mug of clay", category="mug").barred is None
    later = Retriever(
        [library(best), library(other, name="later")], BagOfWords(), RetrievalSettings(licences=frozenset({"CC0"}))
    )  # nothing of the first library is allowed
    assert ask(later, "a mug", category="mug").barred == BarredAsset("best", "first", "CC BY-NC 4.0")
    unknown = thing("unknown", "a steel fork", licence=None)
    lost = ask(retriever(unknown, other, licences=frozenset({"CC0"})), "a steel fork", category="fork")
    assert isinstance(lost, UnmatchedQuery)
    assert str(lost.barred) == "asset unknown of library first, whose licence is unknown"


def test_an_asset_of_unknown_category_is_what_was_asked_only_if_its_words_say_so() -> None:
    tool = retriever(thing("a", "a red coffee mug"), thing("b", "one red drinking vessel"))
    named, unnamed = ask(tool, "a red coffee mug", category="mug"), ask(tool, "one red drinking vessel", category="mug")
    assert isinstance(named, AssetMatch)
    assert isinstance(unnamed, AssetMatch)
    assert (named.asset_id, named.category) == ("a", "mug")
    assert (unnamed.asset_id, unnamed.category) == ("b", "")


def test_words_are_encoded_once_and_answered_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retrieval, "_MOST_TEXTS", 3)
    encoder = BagOfWords()
    tool = Retriever([library(thing("cup", "a red cup"), thing("fork", "steel fork"))], encoder)
    first = tool.retrieve([AssetQuery(text, CUBE) for text in ("a red cup", "steel fork", "a red cup")])
    assert encoder.asked == ["a red cup", "steel fork"]
    again = tool.retrieve([AssetQuery(text, CUBE) for text in ("steel fork", "a cup", "a red cup")])
    assert encoder.asked == ["a red cup", "steel fork", "a cup"]
    assert [again[2], again[0]] == first[:2]
    tool.retrieve([AssetQuery("a fork", CUBE)])  # one too many: the first is forgotten
    assert tool.retrieve([AssetQuery("a red cup", CUBE)]) == first[:1]
    assert encoder.asked[3:] == ["a fork", "a red cup"]


def test_the_category_is_preferred_among_equals_and_never_demanded() -> None:
    lid, pot = thing("lid", "red one", category="pot_lid"), thing("pot", "red one", category="pot")
    plain = AssetLibrary("own", (lid, pot), BagOfWords()(["red one", "red one"]))
    tool = Retriever([plain], BagOfWords())
    for seed in range(8):
        assert found(ask(tool, "red one", category="Pot Lid", seed=seed)) == "lid"
    assert {found(ask(tool, "red one", category="spaceship", seed=seed)) for seed in range(16)} == {"lid", "pot"}


def test_the_category_is_heard_with_the_words() -> None:
    tool = retriever(thing("mug", "a plain white one", category="mug"), thing("plate", "a round white one", category="plate"))
    assert found(ask(tool, "a white one", category="plate")) == "plate"
    assert found(ask(tool, "a white one", category="mug")) == "mug"
    assert (
        found(ask(retriever(thing("mug", "", category="mug"), thing("plate", "one", category="plate")), " ", category="plate"))
        == "plate"
    )


def test_a_query_without_words_or_category_is_reported() -> None:
    answer = ask(retriever(thing("mug", "a red mug")), " \n", category="")
    assert isinstance(answer, UnmatchedQuery)
    assert "neither words nor a category" in answer.reason


def test_ten_thousand_words_are_a_query_like_any_other() -> None:
    tool = retriever(thing("mug", "red mug"), thing("fork", "steel fork"))
    assert found(ask(tool, "red mug " * 5000)) == "mug"


TWINS = [thing(f"{number:02}", "a red mug") for number in range(6)]


def test_every_equal_comes_up_over_seeds_and_about_as_often() -> None:
    tool = retriever(*TWINS)
    counts = Counter(found(ask(tool, "a red mug", seed=seed)) for seed in range(1200))
    assert set(counts) == {asset.asset_id for asset in TWINS}
    assert all(abs(count - 200) < 5 * math.sqrt(200) for count in counts.values())


def test_equal_queries_differ_by_their_keys_alone() -> None:
    tool = retriever(*TWINS)
    same = tool.retrieve([AssetQuery("a red mug", CUBE, key="scene")] * 40)
    assert len({found(answer) for answer in same}) == 1
    apart = tool.retrieve([AssetQuery("a red mug", CUBE, key=f"scene/{k}") for k in range(40)])
    assert {found(answer) for answer in apart} == {asset.asset_id for asset in TWINS}


def test_what_is_clearly_worse_is_never_drawn() -> None:
    tool = retriever(*TWINS, thing("other", "a red mug of clay"))
    assert "other" not in {found(ask(tool, "a red mug", seed=seed)) for seed in range(50)}
    wide = retriever(*TWINS, thing("other", "a red mug of clay"), margin=0.9)
    assert "other" in {found(ask(wide, "a red mug", seed=seed)) for seed in range(50)}


def test_another_asset_changes_a_choice_only_by_being_chosen() -> None:
    few, more = retriever(*TWINS[:5]), retriever(*TWINS)
    for seed in range(60):
        before, after = (found(ask(tool, "a red mug", seed=seed)) for tool in (few, more))
        assert after in (before, TWINS[5].asset_id)


class Noise:
    """An encoder whose rows crowd together, so that many scores are all but equal."""

    fingerprint = "noise"

    def __call__(self, texts: Sequence[str], /) -> Rows:
        centre = np.random.default_rng(0).normal(size=96)
        rows = np.array([centre + 0.2 * np.random.default_rng([7, *text.encode()]).normal(size=96) for text in texts])
        unit: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
        return unit


def crowd() -> list[Asset]:
    rng = np.random.default_rng(3)
    assets = []
    for number in range(700):
        x, y, z = rng.uniform(0.2, 1.0, 3).tolist()
        tilts = [RestingTilt(UPRIGHT, (x, y, z), 5), RestingTilt(LAID, (x, z, y), 1)]
        assets.append(
            Asset(f"{number:03}", "abc"[number % 3], f"thing {number % 350}", (x, y, z), tuple(tilts[: 1 + number % 2]))
        )
    return assets


CROWD = AssetLibrary("crowd", tuple(crowd())).embedded(Noise())
CROWD_QUERIES = [
    AssetQuery(f"thing {k}", tuple(np.random.default_rng(k).uniform(0.1, 1.0, 3).tolist()), "abcd"[k % 4], str(k))
    for k in range(300)
]


@pytest.mark.parametrize("top_k", [None, 20])
def test_a_batch_answers_as_each_query_alone_in_any_order(top_k: int | None) -> None:
    tool = Retriever([CROWD], Noise(), RetrievalSettings(top_k_text=top_k, margin=0.005))
    batch = tool.retrieve(CROWD_QUERIES, seed=4)
    assert batch[::-1] == tool.retrieve(CROWD_QUERIES[::-1], seed=4)
    assert batch[::7] == [tool.retrieve([query], seed=4)[0] for query in CROWD_QUERIES[::7]]
    assert batch != tool.retrieve(CROWD_QUERIES, seed=5)


def test_what_a_query_is_to_go_without_is_as_if_it_were_not_there() -> None:
    tool = Retriever([CROWD], Noise())
    first = tool.retrieve(CROWD_QUERIES, seed=4)
    barred = {a.asset_id for a in first if isinstance(a, AssetMatch)}
    left = tuple(a for a in CROWD.assets if a.asset_id not in barred)
    few = Retriever([AssetLibrary("crowd", left).embedded(Noise())], Noise())
    second = tool.retrieve([replace(query, without=frozenset(barred)) for query in CROWD_QUERIES], seed=4)
    assert [found(answer) for answer in second] == [found(answer) for answer in few.retrieve(CROWD_QUERIES, seed=4)]
    mixed = [replace(query, without=frozenset(barred)) if k % 3 else query for k, query in enumerate(CROWD_QUERIES)]
    assert tool.retrieve(mixed, seed=4) == [second[k] if k % 3 else first[k] for k in range(len(mixed))]


def test_a_query_that_may_have_nothing_is_reported() -> None:
    everything = frozenset(asset.asset_id for asset in CROWD.assets)
    (answer,) = Retriever([CROWD], Noise()).retrieve([replace(CROWD_QUERIES[0], without=everything)])
    assert answer == UnmatchedQuery("the query excludes all assets of the libraries")


def test_the_floor_is_the_same_to_the_last_bit_alone_and_in_a_batch() -> None:
    by_text = RetrievalSettings(size_weight=0.0, margin=0.0, floor=-1.0)
    queries = [AssetQuery(f"unlike {k}", CUBE) for k in range(130)]
    best = [answer.text_score for answer in Retriever([CROWD], Noise(), by_text).retrieve(queries)]
    for k in range(0, len(queries), 9):
        at, above = (
            Retriever([CROWD], Noise(), replace(by_text, floor=floor)) for floor in (best[k], float(np.nextafter(best[k], 2)))
        )
        for asked, place in ((queries, k), ([queries[k]], 0)):
            assert isinstance(at.retrieve(asked)[place], AssetMatch)
            refused = above.retrieve(asked)[place]
            assert isinstance(refused, UnmatchedQuery)
            assert refused.text_score == best[k]


@pytest.mark.parametrize("top_k", [None, 1, 20])
def test_the_best_is_what_a_plain_loop_finds(top_k: int | None) -> None:
    tool = Retriever([CROWD], Noise(), RetrievalSettings(top_k_text=top_k, margin=0.0))
    assert CROWD.features is not None
    queries = CROWD_QUERIES[::9]
    for query, answer in zip(queries, tool.retrieve(queries), strict=True):
        text = CROWD.features.astype(np.float64) @ Noise()([query.sentence()])[0]
        fitting = [k for k, a in enumerate(CROWD.assets) if a.category == query.category] or range(len(text))
        allowed = sorted(fitting, key=lambda k: -text[k])[: top_k or len(text)]
        x, y, z = query.size
        cosines = []
        for a in CROWD.assets:
            straight, crossed = (
                max(np.dot(box, t.extents) / np.linalg.norm(box) / np.linalg.norm(t.extents) for t in a.tilts)
                for box in ((x, y, z), (y, x, z))
            )
            cosines.append(crossed if crossed > straight + TURNED_FIT else straight)
        score = 0.9 * text + 0.1 * np.array(cosines)
        assert isinstance(answer, AssetMatch)
        assert answer.score == pytest.approx(score[allowed].max(), abs=1e-6)


def test_a_bottle_stands_unless_the_box_asks_for_a_laid_one() -> None:
    tool = retriever(bottle())
    tilts = {}
    for size in [(0.1, 0.1, 0.4), (0.1, 0.1, 0.1), (0.12, 0.14, 0.11), (0.1, 0.4, 0.1), (0.1, 0.3, 0.12)]:
        answer = ask(tool, "a green bottle", size)
        assert isinstance(answer, AssetMatch)
        tilts[size] = answer.tilt_quat_xyzw
    assert list(tilts.values()) == [UPRIGHT, UPRIGHT, UPRIGHT, LAID, LAID]
    laid = ask(tool, "a green bottle", (0.1, 0.4, 0.1))
    assert isinstance(laid, AssetMatch)
    assert laid.size + laid.scale == pytest.approx((0.1, 0.4, 0.1, 0.1, 0.1, 0.1))
    assert laid.size_score == pytest.approx(1)


EDGE = st.floats(0.01, 1.0)


@settings(max_examples=40)
@given(st.tuples(EDGE, EDGE, EDGE), st.tuples(EDGE, EDGE, EDGE), st.floats(1.0, 4.0))
def test_scaling_is_even_unless_asked_and_never_distorts_beyond_the_limit(wanted: Vec3, box: Vec3, limit: float) -> None:
    asset = thing("a", "a box", box)
    even = ask(retriever(asset), "a box", wanted)
    stretched = ask(retriever(asset, stretch=True, max_distortion=limit), "a box", wanted)
    assert isinstance(even, AssetMatch)
    assert isinstance(stretched, AssetMatch)
    assert even.scale[0] == even.scale[1] == even.scale[2]
    assert even.size == pytest.approx([even.scale[0] * edge for edge in box])
    assert even.note == ""
    assert max(stretched.scale) <= min(stretched.scale) * limit * (1 + 1e-9)
    assert even.is_turned == stretched.is_turned
    wanted = turned_box(wanted) if even.is_turned else wanted
    ratios = [w / b for w, b in zip(wanted, box, strict=True)]
    if max(ratios) <= min(ratios) * limit:
        assert stretched.size == pytest.approx(wanted)
        assert stretched.note == ""
    else:
        assert (stretched.size, stretched.scale) == (even.size, even.scale)
        assert "scaled uniformly: stretching would distort it by a factor of" in stretched.note


def test_what_leans_is_scaled_evenly_and_says_so() -> None:
    lean = RestingTilt((0.6, 0.0, 0.0, 0.8), (1.0, 1.2, 1.3), 5)
    answer = ask(retriever(Asset("a", "", "a box", (1.0, 1.0, 1.0), (lean,)), stretch=True), "a box", (0.1, 0.1, 0.2))
    assert isinstance(answer, AssetMatch)
    assert answer.scale[0] == answer.scale[1] == answer.scale[2]
    assert "it is flat or leans" in answer.note


@pytest.mark.parametrize("size", [(math.nan, 1, 1), (1, math.inf, 1), (0, 0, 0), (-1, 1, 1), (1, 1)])
def test_a_query_without_a_box_is_refused(size: Vec3) -> None:
    with pytest.raises(SceneError, match=r"query 'a mug' has size .*, expected width, depth and height in metres"):
        AssetQuery("a mug", size)


def test_boxes_of_any_magnitude_are_answered() -> None:
    tool = retriever(thing("a", "a box", (1e-9, 2e-9, 1e-9)), thing("b", "a sheet", (300.0, 200.0, 0.0)))
    for size in [(1e-200, 2e-200, 1e-200), (1e200, 2e200, 1e200), (1.0, 0.0, 0.0)]:
        answer = ask(tool, "a box", size)
        assert isinstance(answer, AssetMatch)
        assert min(answer.scale) > 0
        assert all(map(math.isfinite, answer.scale))
    assert found(ask(tool, "a sheet", (0.3, 0.2, 0.0))) == "b"


def test_no_queries_have_no_answers() -> None:
    assert retriever(thing("a", "a mug")).retrieve([]) == []


def test_features_of_another_encoder_are_refused() -> None:
    assets = (thing("a", "a mug"), thing("b", "a bowl"))
    bare = AssetLibrary("bare", assets)
    with pytest.raises(ConfigError, match=r"library bare has no text features; call embedded\(encoder\)"):
        Retriever([bare], BagOfWords())
    with pytest.raises(ConfigError, match="come from encoder bag-1-128, expected bag-0-128; call embedded"):
        Retriever([bare.embedded(BagOfWords(seed=1))], BagOfWords())
    for other, what in (
        (BagOfWords(seed=1), "have mean cosine -?0"),
        (BagOfWords(width=64), "have 64 numbers, but this encoder returns 128"),
    ):
        unsaid = AssetLibrary("unsaid", assets, other(["a mug", "a bowl"]))
        with pytest.raises(ConfigError, match=what) as caught:
            Retriever([unsaid], BagOfWords())
        assert caught.value.code == "features_of_another_encoder"


def test_a_datasets_own_features_are_used_if_they_are_this_encoders() -> None:
    assets = (thing("a", "a red mug", category="mug"), thing("b", "a blue bowl", category="bowl"))
    own = AssetLibrary("own", assets, BagOfWords()(["a red mug", "a blue bowl"]))
    answer = ask(Retriever([own], BagOfWords()), "a red mug", category="cup")
    assert isinstance(answer, AssetMatch)
    assert answer.asset_id == "a"
    assert answer.text_score == pytest.approx(1)  # its words alone are compared


def test_libraries_are_needed_and_told_apart() -> None:
    with pytest.raises(ConfigError, match="no asset library"):
        Retriever([], BagOfWords())
    one = library(thing("a", "a mug"))
    with pytest.raises(ConfigError, match="libraries are named first, first"):
        Retriever([one, one], BagOfWords())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("floor", 1.5),
        ("floor", math.nan),
        ("margin", -0.1),
        ("text_weight", 0.0),
        ("size_weight", -1.0),
        ("top_k_text", 0),
        ("tilt_patience", 0.5),
        ("metric_slack", 0.9),
        ("max_distortion", 0.5),
    ],
)
def test_settings_that_give_no_order_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{name} is "):
        RetrievalSettings(**{name: value})  # type: ignore[arg-type]


def test_retrieval_is_light() -> None:
    code = "import sys, stable_data.assets.retrieval, stable_data.assets.substitution; print(*sys.modules)"
    root = Path(__file__).resolve().parents[3]
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root).stdout.split()
    assert not {"torch", "ray", "scipy", "shapely", "trimesh", "transformers"} & set(loaded)


def test_a_real_folder_finds_what_it_holds(real_data: Path) -> None:
    encoder = BagOfWords()
    shelf = library_of_folder(real_data).embedded(encoder)
    offered = [asset for asset in shelf.assets if asset.is_offered]
    queries = [AssetQuery(asset.description, asset.extents, asset.category) for asset in offered]
    answers = Retriever([shelf], encoder).retrieve(queries)
    by_uid = {asset.asset_id: asset for asset in shelf.assets}
    for asset, answer in zip(offered, answers, strict=True):
        assert by_uid[found(answer)].words == asset.words
        assert by_uid[found(answer)].is_offered
