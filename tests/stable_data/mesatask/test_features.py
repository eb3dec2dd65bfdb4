"""Text features: sound ones read back, hostile ones are refused unread."""

import gzip
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stable_data.errors import ConfigError
from stable_data.mesatask import (
    read_text_features,
    write_text_features,
)
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
def test_unsound_pickles_say_why(data: bytes, code: str, tmp_path: Path) -> None:
    path = tmp_path / "f.pkl"
    path.write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        read_text_features(path, max_bytes=50_000)
    assert caught.value.code == code


def test_features_that_do_not_fit_their_uids_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        write_text_features(tmp_path / "f.pkl", ["a"], np.zeros((2, 3)))
