"""Text features: sound ones read back, hostile ones are refused unread."""

import gzip
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from stable_data.errors import ConfigError
from stable_data.mesatask import (
    read_text_features,
    write_text_features,
)
from tests.bounds import limit, little_memory, soon
from tests.stable_data.mesatask.layouts import UID


class _Hostile:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_text_features_read_back_in_every_protocol(tmp_path: Path, rng: np.random.Generator) -> None:
    uids, features, path = (UID, "b"), rng.normal(size=(2, 8)).astype(np.float32), tmp_path / "f.pkl"
    write_text_features(path, uids, features)
    files = [path.read_bytes(), gzip.compress(path.read_bytes())]
    for rows in (features, features.astype(">f8"), np.asfortranarray(features), list(features), features.tolist()):
        for names in (list(uids), np.array(uids), np.array(uids, object)):
            files += [pickle.dumps({"uids": names, "text_features": rows}, protocol) for protocol in range(2, 6)]
    files += [data.replace(b"numpy._core.multiarray", b"numpy.core.multiarray") for data in files if data[1] == 2]
    for data in files:
        path.write_bytes(data)
        found_uids, found = read_text_features(path)
        assert found_uids == uids
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, features)


def test_a_hostile_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    path, trace = tmp_path / "f.pkl", tmp_path / "trace"
    path.write_bytes(pickle.dumps({"uids": ["a"], "text_features": _Hostile(trace)}))
    with pytest.raises(ConfigError, match="not run") as caught:
        read_text_features(path)
    assert caught.value.code == "pickle_refused"
    assert "Path.touch" in str(caught.value) or "getattr" in str(caught.value)
    assert not trace.exists()


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"cos\nsystem\n(S'true'\ntR.", "pickle_refused"),
        (b"cnumpy\nload\n(S'x'\ntR.", "pickle_refused"),
        (b"\x80\x04Nr\xff\xff\xff\xff.", "pickle_refused"),
        (pickle.dumps({"uids": ["a"], "text_features": np.zeros((1, 2))})[:-20], "features_invalid"),
        (b"", "features_invalid"),
        (b"no pickle", "features_invalid"),
        (gzip.compress(b"x" * 100, mtime=0)[:-9], "features_invalid"),
        (gzip.compress(b"x" * 100_000, mtime=0), "file_too_big"),
        (pickle.dumps([1]), "features_invalid"),
        (pickle.dumps({"uids": ["a"], "text_features": np.zeros((2, 2))}), "features_invalid"),
        (pickle.dumps({"uids": [1], "text_features": np.zeros((1, 2))}), "features_invalid"),
        (pickle.dumps({"uids": ["a"], "text_features": [[math.nan]]}), "features_invalid"),
        (pickle.dumps({"uids": ["a"], "text_features": np.zeros((1, 2), complex)}), "features_invalid"),
        (pickle.dumps({"uids": ["a"], "text_features": 5}), "features_invalid"),
        (pickle.dumps({"uids": ["a"], "text_features": np.array([{}], object)}), "features_invalid"),
    ],
)
def test_unsound_pickles_say_why(data: bytes, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "features", max_bytes=50_000)
    path = tmp_path / "f.pkl"
    path.write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        read_text_features(path)
    assert caught.value.code == code


_ONE = b"\x80\x04}(\x8c\x04uids](\x8c\x01ae\x8c\rtext_features"
"""The start of a pickle of one uid; its features are missing, and the end ``u.``."""

_DEEP_LIST = b"]" * 200_000 + b"a" * 199_999
_DTYPE = b"cnumpy\ndtype\n" + _DEEP_LIST + b"\x85R"
_LONG = b"\x8b" + (200_000).to_bytes(4, "little") + b"\x01" * 200_000
_NO_TEXT = "contains a key that is no text"
_RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n)R"


@pytest.mark.parametrize(
    ("data", "code", "words"),
    [
        # A tuple in tuples, as a key: hashing it would end the process with a fault of the machine.
        (b"\x80\x04}" + b")" + b"\x85" * 300_000 + b"K\x01s.", "pickle_refused", _NO_TEXT),
        # Each tuple has the one before twice: hashing the last one takes 2^62 steps.
        (b"\x80\x04}" + b")" + b"2\x86" * 62 + b"K\x01s.", "pickle_refused", _NO_TEXT),
        (b"\x80\x04}" + b"(" + b")" + b"2\x86" * 62 + b"K\x01u.", "pickle_refused", _NO_TEXT),
        (b"\x80\x04(" + b")" + b"2\x86" * 62 + b"K\x01d.", "pickle_refused", _NO_TEXT),
        (
            b"\x80\x04})\x940" + b"".join(b"h" + bytes([k]) + b"\x85\x940" for k in range(90)) + b"hZK\x01s.",
            "pickle_refused",
            _NO_TEXT,
        ),
        # A long number is hashed again wherever it is a key.
        (b"\x80\x04}" + _LONG + b"K\x01s.", "pickle_refused", _NO_TEXT),
        (b"\x80\x04}(\x8c\x01aK\x01" + _LONG + b"K\x01u.", "pickle_refused", _NO_TEXT),
        (b"\x80\x04\x8f.", "pickle_refused", "contains a set"),
        (b"\x80\x04" + b"]" * 30_000 + b".", "pickle_refused", "expected at most 20,000"),
        (
            _ONE + _RECONSTRUCT + b"(K\x01K\x01K\x01\x86" + _DTYPE + b"\x89C\x04\x00\x00\x00\x00tbu.",
            "features_invalid",
            "a dtype that is list",
        ),
        (_ONE + _DEEP_LIST + b"u.", "features_invalid", "expected a row of numbers"),
        (_ONE + _RECONSTRUCT + b"(K\x01" + _DEEP_LIST + b"\x85N\x89](K\x01etbu.", "features_invalid", "an invalid shape"),
        # The product of two lengths of 20 million bytes takes minutes; these are shorter.
        (
            _ONE + _RECONSTRUCT + b"(K\x01" + _LONG + b"\x94h\x00\x86N\x89](K\x01etbu.",
            "features_invalid",
            "a longer shape, expected at most 1,000,000 numbers",
        ),
        (_ONE + b"](](\x8a\xc8" + b"\x7f" * 200 + b"eeu.", "features_invalid", "not a table"),
        (
            pickle.dumps({"uids": ["a"] * 5000, "text_features": [[0.5] * 5000] * 5000}),
            "features_invalid",
            "25,000,000 numbers, expected at most 1,000,000",
        ),
        (pickle.dumps({"uids": ["a"] * 6000, "text_features": [[0.5]] * 6000}), "features_invalid", "a list of 6,000"),
        (
            pickle.dumps({"uids": np.array(["a"] * 6000), "text_features": np.zeros((6000, 1))}),
            "features_invalid",
            "6,000 strings",
        ),
    ],
)
def test_pickles_that_take_much_more_than_their_bytes_are_refused(
    data: bytes, code: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    operations = 20_000 if data.count(b"]") == 30_000 else 10**7
    limit(monkeypatch, "features", max_operations=operations, max_rows=5000, max_numbers=10**6)
    path = tmp_path / "f.pkl"
    path.write_bytes(gzip.compress(data))
    with pytest.raises(ConfigError, match=words) as caught:
        read_text_features(path)
    assert caught.value.code == code
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("row", "protocol", "words"),
    [
        (
            np.zeros(200_000, np.float32),
            2,
            "more bytes of arrays, expected at most 4,000,000",
        ),  # bytes as text, copied for each array
        (np.array(["é"] * 2000), 4, "102,000 strings, expected at most 100,000"),
    ],
)
def test_rows_that_refer_to_the_same_bytes_are_refused_before_they_are_made(
    row: npt.NDArray[Any], protocol: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file has one megabyte; as many copies as it has rows would fill the memory."""
    limit(monkeypatch, "features", max_bytes=4_000_000, max_rows=100_000)
    path = tmp_path / "f.pkl"
    path.write_bytes(pickle.dumps({"uids": ["a"] * 50_000, "text_features": [row] * 50_000}, protocol))
    with little_memory(60_000_000), pytest.raises(ConfigError, match=words):
        read_text_features(path)


@pytest.mark.parametrize("is_array", [False, True])
def test_a_row_that_is_referred_to_many_times_is_looked_at_once(is_array: bool, tmp_path: Path) -> None:
    """Looking at 65 million numbers takes ten seconds and more, at those of one row a millisecond."""
    row: Any = [0.5] * 2000
    path, num = tmp_path / "f.pkl", 30_000
    rows = [np.array(row, object) if is_array else row] * num
    path.write_bytes(pickle.dumps({"uids": ["a"] * num, "text_features": rows}, 4))
    with soon(5.0):
        _, features = read_text_features(path)
    assert features.shape == (num, 2000)
    assert (features == 0.5).all()


def test_a_name_of_a_type_of_any_length_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "f.pkl"
    dtype = b"cnumpy\ndtype\nX\xa0\x86\x01\x00" + b"<" * 99_998 + b"f4\x85R"
    path.write_bytes(_ONE + _RECONSTRUCT + b"(K\x01K\x01K\x01\x86" + dtype + b"\x89C\x04\x00\x00\x00\x00tbu.")
    with pytest.raises(ConfigError, match="expected floats or strings") as caught:
        read_text_features(path)
    assert len(str(caught.value)) < 500


def test_a_library_without_assets_is_read(tmp_path: Path) -> None:
    path = tmp_path / "f.pkl"
    empty: tuple[Any, ...] = ([], np.array([]), np.zeros((0, 5), np.float32))
    for rows in empty:
        path.write_bytes(pickle.dumps({"uids": [], "text_features": rows}))
        uids, features = read_text_features(path)
        assert uids == ()
        assert features.shape == (0, 0)


def test_rows_that_are_arrays_of_their_own_are_read(tmp_path: Path) -> None:
    path, rows = tmp_path / "f.pkl", [np.full(3, k, np.float32) for k in range(500)]
    for protocol in range(2, 6):
        path.write_bytes(pickle.dumps({"uids": list(map(str, range(500))), "text_features": rows}, protocol))
        np.testing.assert_array_equal(read_text_features(path)[1], rows)


def test_features_that_do_not_fit_their_uids_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        write_text_features(tmp_path / "f.pkl", ["a"], np.zeros((2, 3)))
