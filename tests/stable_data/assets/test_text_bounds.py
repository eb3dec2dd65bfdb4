"""Bounds of text scores, and searches that use them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.assets import ranking
from stable_data.assets.catalog import Asset, AssetLibrary, RestingTilt
from stable_data.assets.retrieval import AssetMatch, AssetQuery, Retriever
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.text_bounds import TextBounds
from stable_data.assets.text_embeddings import Rows
from stable_data.scene import UPRIGHT, IntArray
from tests.stable_data.assets.bag_of_words import LAID, BagOfWords

KINDS = ("mug", "coffee_mug", "bowl", "spice_jar", "grand_piano", "")
COLOURS = ("red", "blue", "green", "old", "tall")


def unit_rows(seed: int, num: int, width: int, rank: int, noise: float) -> Rows:
    """Rows of which most is in a space of a few dimensions."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(num, rank)) @ rng.normal(size=(rank, width)) + noise * rng.normal(size=(num, width))
    unit: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return unit


@settings(deadline=None)
@given(
    st.integers(0, 2**32), st.integers(1, 40), st.integers(1, 48), st.integers(1, 8), st.sampled_from((1e-6, 0.1, 1.0, 100.0))
)
def test_no_product_is_above_its_bound(seed: int, num: int, width: int, rank: int, noise: float) -> None:
    rows, asked = unit_rows(seed, num, width, rank, noise), unit_rows(seed + 1, 5, width, rank, 1.0)
    bounds, exact = TextBounds(rows), asked.astype(np.float64) @ rows.T
    slack = 2.0 * width * 2.0**-24  # of a product of float32
    assert (bounds.bounds(asked) + slack >= exact).all()
    for chosen in (np.arange(0, num, 2), np.array([num - 1])):
        assert bounds.bounds(asked, chosen) == pytest.approx(bounds.bounds(asked)[:, chosen], abs=1e-5)


def test_bounds_of_rows_in_few_dimensions_are_close() -> None:
    rows, asked = unit_rows(0, 500, 64, 6, 0.01), unit_rows(1, 20, 64, 6, 0.01)
    assert np.abs(TextBounds(rows).bounds(asked) - asked @ rows.T).max() < 0.2


def assets(seed: int, num: int) -> AssetLibrary:
    """A library with sizes, tilts, containers and equal words."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(num):
        x, y, z = rng.uniform(0.05, 0.5, 3).tolist()
        kind, colour = rng.choice((*KINDS[:4], "")), rng.choice(COLOURS)
        tilts = (RestingTilt(UPRIGHT, (x, y, z), 5), RestingTilt(LAID, (x, z, y), int(rng.integers(0, 2))))
        longest = max(x, y, z)
        found.append(
            Asset(
                f"{number:04}",
                str(kind),
                f"a {colour} {kind.replace('_', ' ')} {rng.choice(['', 'with a lid', 'of steel'])}",
                (x, y, z),
                tilts[: int(rng.integers(1, 3))],
                licence=str(rng.choice(["CC0-1.0", "CC-BY-NC-4.0"])),
                is_container=(None, True, False)[int(rng.integers(3))],
                size_range=None if rng.random() < 0.3 else (0.8 * longest, float(rng.uniform(0.8, 2.0)) * longest),
            )
        )
    return AssetLibrary("first", tuple(found)).embedded(BagOfWords(width=32))


def queries(seed: int, ids: list[str]) -> list[AssetQuery]:
    rng = np.random.default_rng(seed)
    found = []
    for number in range(24):
        kind = str(rng.choice(KINDS))
        x, y, z = rng.uniform(0.02, 1.0, 3).tolist()
        without = rng.choice(ids, int(rng.integers(0, len(ids)))).tolist() if number % 3 == 0 else []
        text = f"a {rng.choice(COLOURS)} {kind.replace('_', ' ')}" if number % 4 else "an unheard word"
        found.append(
            AssetQuery(
                text,
                (x, y, z),
                kind if number % 2 else None,
                str(number),
                leans=bool(rng.integers(2)),
                holds=bool(rng.integers(2)),
                without=frozenset(without),
            )
        )
    return [*found, replace(found[0], without=frozenset(ids)), replace(found[1], without=frozenset(ids))]


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 2**32),
    st.integers(1, 400),
    st.sampled_from((-1.0, 0.3, 0.55, 0.9)),
    st.sampled_from((0.0, 0.02, 0.3)),
    st.sampled_from((0.1, 0.0, 5.0)),
    st.booleans(),
)
def test_a_search_by_bounds_answers_as_one_of_all_assets(
    seed: int, num: int, floor: float, margin: float, size_weight: float, bars: bool
) -> None:
    library = assets(seed, num)
    allowed = frozenset({"CC0-1.0"}) if bars and any(a.licence == "CC0-1.0" for a in library.assets) else None
    chosen = RetrievalSettings(floor=floor, margin=margin, size_weight=size_weight, licences=allowed)
    asked = queries(seed, [a.asset_id for a in library.assets])
    plain = Retriever([library], BagOfWords(width=32), chosen).retrieve(asked, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ranking, "_NARROWED", 1)
        patch.setattr(ranking, "_NARROWING", 1000)
        patch.setattr(ranking, "_PROBED", 8)
        narrowed = Retriever([library], BagOfWords(width=32), chosen)
        assert narrowed.retrieve(asked, seed) == plain
        assert [narrowed.retrieve([each], seed)[0] for each in asked] == plain


def test_most_assets_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranking, "_NARROWED", 4096)
    library = assets(0, 6000)
    tool = Retriever([library], BagOfWords(width=32))
    compared, rough = list[int](), ranking.AssetScores._rough

    def counted(scores: ranking.AssetScores, rows: Rows, cols: IntArray) -> Rows:
        compared.append(len(cols))
        return rough(scores, rows, cols)

    monkeypatch.setattr(ranking.AssetScores, "_rough", counted)
    (answer,) = tool.retrieve([AssetQuery("a red coffee mug of steel", (0.1, 0.1, 0.1))])
    assert isinstance(answer, AssetMatch)
    assert 0 < max(compared) < 3000
