"""Statistics are those of numpy; those of all episodes follow from the episodes'."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from stable_data.robot.lerobot.statistics import (
    QUANTILES,
    PictureStatistics,
    TotalStatistics,
    array_statistics,
    sampled_frames,
)

NUMBERS = arrays.arrays(np.float32, st.tuples(st.integers(1, 40), st.integers(1, 3)), elements=st.floats(-100, 100, width=32))


@given(NUMBERS)
def test_an_array_has_the_statistics_of_numpy(values: np.ndarray) -> None:
    found = array_statistics(values)
    whole = values.astype(np.float64)
    assert np.array_equal(found["min"], values.min(axis=0))
    assert np.array_equal(found["max"], values.max(axis=0))
    assert np.allclose(found["mean"], whole.mean(axis=0))
    assert np.allclose(found["std"], whole.std(axis=0))
    assert found["count"].tolist() == [len(values)]
    for name, q in QUANTILES.items():
        shares = (values <= found[name].astype(np.float32)).mean(axis=0)
        assert (shares >= q - 1e-12).all()
        assert ((values < found[name]).mean(axis=0) < q + 1e-12).all()


def test_truth_values_and_integers_keep_their_type() -> None:
    found = array_statistics(np.array([[False], [True], [False]]))
    assert (found["min"].dtype, found["max"].tolist(), found["mean"].tolist()) == (np.dtype(bool), [True], [1 / 3])
    assert array_statistics(np.arange(4)[:, None])["max"].dtype == np.int64


@pytest.mark.parametrize("size", [(30, 40), (200, 302)])
def test_pictures_have_the_statistics_of_their_pixels(size: tuple[int, int]) -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (5, *size, 3), np.uint8)
    pictures[..., 1] //= 3
    collected = PictureStatistics()
    for picture in pictures:
        collected.add(picture)
    step = 1 if max(size) < 300 else 2
    pixels = (pictures[:, ::step, ::step].reshape(-1, 3) / 255).astype(np.float64)
    found = collected.statistics()
    assert {name: values.shape for name, values in found.items() if name != "count"} == dict.fromkeys(
        ("min", "max", "mean", "std", *QUANTILES), (3, 1, 1)
    )
    for name, wanted in (("min", pixels.min(0)), ("max", pixels.max(0)), ("mean", pixels.mean(0)), ("std", pixels.std(0))):
        assert np.allclose(found[name].ravel(), wanted), name
    for name, q in QUANTILES.items():
        assert np.allclose(found[name].ravel(), np.quantile(pixels, q, axis=0, method="inverted_cdf")), name
    assert found["count"].tolist() == [5]


@given(
    st.lists(
        arrays.arrays(np.float32, st.tuples(st.integers(1, 9), st.just(2)), elements=st.floats(-9, 9, width=32)), min_size=1
    )
)
def test_the_whole_follows_from_its_parts(parts: list[np.ndarray]) -> None:
    total = TotalStatistics()
    for part in parts:
        total.add({"action": array_statistics(part)})
    found, whole = total.as_json()["action"], np.concatenate(parts).astype(np.float64)
    assert found["min"] == whole.min(axis=0).tolist()
    assert found["max"] == whole.max(axis=0).tolist()
    assert np.allclose(found["mean"], whole.mean(axis=0))
    assert np.allclose(found["std"], whole.std(axis=0), atol=1e-6)
    assert found["count"] == [len(whole)]
    weights = [len(part) for part in parts]
    mean = np.average([array_statistics(part)["q90"] for part in parts], axis=0, weights=weights)
    assert np.allclose(found["q90"], mean)


def test_few_frames_are_all_looked_at_and_many_are_thinned_out() -> None:
    assert sampled_frames(1) == [0]
    assert sampled_frames(100) == list(range(100))
    many = sampled_frames(2000)
    assert (many[0], many[-1], len(many)) == (0, 1999, 299)
