"""Rows of texts, and the file that keeps them."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from stable_data.assets.text_embeddings import check_rows, embed_texts, share_rows
from stable_data.errors import ConfigError
from tests.stable_data.assets.bag_of_words import BagOfWords

TEXTS = ["a mug", "a bowl", "a mug", "ein Löffel 🥄"]


def test_each_text_is_encoded_once_and_has_its_row() -> None:
    encoder = BagOfWords()
    rows = embed_texts(TEXTS, encoder)
    assert encoder.asked == ["a mug", "a bowl", "ein Löffel 🥄"]
    assert np.array_equal(rows, BagOfWords()(TEXTS))
    assert rows.dtype == np.float32


def test_no_texts_have_no_rows() -> None:
    assert embed_texts([], BagOfWords()).shape == (0, 0)


def test_a_file_serves_what_it_holds_and_takes_what_it_lacks(tmp_path: Path) -> None:
    cache = tmp_path / "deep" / "rows.parquet"
    first = embed_texts(TEXTS, BagOfWords(), cache)
    encoder = BagOfWords()
    assert np.array_equal(embed_texts(TEXTS[::-1], encoder, cache), first[::-1])
    assert encoder.asked == []
    more = embed_texts(["a fork", *TEXTS], encoder, cache)
    assert encoder.asked == ["a fork"]
    assert np.array_equal(more[1:], first)
    embed_texts(["a fork", *TEXTS], encoder, cache)
    assert encoder.asked == ["a fork"]
    assert [path.name for path in cache.parent.iterdir()] == ["rows.parquet"]


def test_writers_with_the_number_of_one_process_do_not_disturb_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getpid", lambda: 1)  # as in two containers that share a folder
    cache = tmp_path / "rows.parquet"

    def ask(writer: int) -> None:
        for number in range(20):
            texts = [f"thing {writer} {number} {k}" for k in range(50)]
            assert np.array_equal(embed_texts(texts, BagOfWords(), cache), BagOfWords()(texts))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(ask, range(4)))
    assert list(tmp_path.iterdir()) == [cache]


def test_a_file_of_another_encoder_is_refused(tmp_path: Path) -> None:
    cache = tmp_path / "rows.parquet"
    embed_texts(TEXTS, BagOfWords(), cache)
    with pytest.raises(ConfigError, match="contains features of encoder bag-0-128, expected bag-1-128; delete") as caught:
        embed_texts(TEXTS, BagOfWords(seed=1), cache)
    assert caught.value.code == "features_of_another_encoder"


def test_an_encoder_of_another_length_under_the_same_name_is_refused(tmp_path: Path) -> None:
    cache = tmp_path / "rows.parquet"
    embed_texts(TEXTS, BagOfWords(), cache)
    other = BagOfWords(width=16)
    other.fingerprint = BagOfWords().fingerprint
    with pytest.raises(ConfigError, match="contains features of 128 numbers, but the encoder returns 16"):
        embed_texts(["a fork"], other, cache)


@pytest.mark.parametrize("content", [b"", b"PAR1 no parquet", b"\x00" * 100])
def test_a_file_that_is_no_cache_is_refused(content: bytes, tmp_path: Path) -> None:
    cache = tmp_path / "rows.parquet"
    cache.write_bytes(content)
    with pytest.raises(ConfigError, match=r"rows\.parquet cannot be read .*delete the file") as caught:
        embed_texts(TEXTS, BagOfWords(), cache)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("rows", "what"),
    [
        (np.ones((2, 3)), "length 1.732"),
        (np.ones(3), r"shape \(3,\)"),
        (np.ones((3, 1)), r"shape \(3, 1\)"),
        (np.array([[1.0], [np.nan]]), "not finite"),
        (np.zeros((2, 0)), r"shape \(2, 0\)"),
    ],
)
def test_rows_that_cannot_be_compared_are_refused(rows: np.ndarray, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        check_rows(rows, 2, "here")


def test_rows_are_shared_by_a_file_that_is_checked(tmp_path: Path) -> None:
    rows = BagOfWords()(TEXTS)
    shared = share_rows(rows, tmp_path / "rows")
    assert isinstance(shared.base, np.memmap) or isinstance(shared, np.memmap)
    assert np.array_equal(shared, rows)
    (file,) = (tmp_path / "rows").iterdir()
    again = share_rows(rows.copy(), tmp_path / "rows")
    assert np.array_equal(again, rows)
    assert [path.name for path in (tmp_path / "rows").iterdir()] == [file.name]
    file.write_bytes(file.read_bytes()[:-4] + bytes(4))
    assert share_rows(rows, tmp_path / "rows") is rows  # not what it should be
    file.write_bytes(b"damaged")
    assert share_rows(rows, tmp_path / "rows") is rows
    (tmp_path / "file").write_text("no folder", "utf-8")
    assert share_rows(rows, tmp_path / "file") is rows
