"""Sets of pictures: near-duplicates by the direction of their features, within and between sets, and scores at one size."""

import json
import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.diversity.pictures import PictureSet, compare_pictures, near_duplicate_pictures
from stable_data.errors import ConfigError
from stable_data.scores.set_distance import Features
from stable_data.storage.run_folder import RunFolder


def made(name: str, features: Features, extractor: str = "gradients", fingerprint: str = "f") -> PictureSet:
    return PictureSet(name, tuple(f"{name}_{k}" for k in range(len(features))), features, extractor, fingerprint)


def turned(*degrees: float) -> Features:
    """Rows of different lengths that point in these directions."""
    return np.array([[(1 + k) * math.cos(math.radians(d)), (1 + k) * math.sin(math.radians(d))] for k, d in enumerate(degrees)])


@given(st.integers(2, 12), st.integers(1, 4), st.integers(0, 2**32 - 1), st.floats(0.1, 0.99))
def test_pairs_are_those_of_all_comparisons(count: int, size: int, seed: int, alike: float) -> None:
    rows = np.random.default_rng(seed).normal(size=(count, size)).astype(np.float32)
    units = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    found = {tuple(pair) for pair in near_duplicate_pictures(rows, alike).tolist()}
    cosine = units.astype(np.float64) @ units.T.astype(np.float64)
    for a in range(count):
        for b in range(a + 1, count):
            if abs(cosine[a, b] - alike) > 1e-5:
                assert ((a, b) in found) == (cosine[a, b] >= alike)


def test_lengths_do_not_count_and_zeros_are_like_nothing() -> None:
    assert near_duplicate_pictures(turned(0, 1, 90), 0.999).tolist() == [[0, 1]]
    assert near_duplicate_pictures(np.zeros((3, 2)), 0.5).tolist() == []


def test_sets_are_compared_within_and_between_each_other() -> None:
    found = compare_pictures([made("a", turned(0, 0.5, 45, 90)), made("b", turned(90.5, 180))])
    assert [one.duplicates for one in found.sets] == [2, 0]
    assert found.sets[0].examples == (("a_0", "a_1"),)
    assert found.overlaps == (("a", "b", 1, 1),)
    assert {row["scene_id"]: row["group_size"] for row in found.groups} == {
        "a_0": 2, "a_1": 2, "a_2": 1, "a_3": 2, "b_0": 2, "b_1": 1,
    }  # fmt: skip
    assert [one.sample for one in found.sets] == [2, 2]
    vendi = found.sets[1].vendi
    assert vendi is not None
    assert 1.0 < vendi <= 2.0
    assert "1 and 1" in str(found)
    assert compare_pictures([made("a", turned(3))]).sets[0].vendi is None


def test_other_features_are_refused() -> None:
    with pytest.raises(ConfigError, match="expected one extractor") as caught:
        compare_pictures([made("a", turned(0, 1)), made("b", turned(0, 1), fingerprint="g")])
    assert caught.value.code == "features_differ"
    with pytest.raises(ConfigError, match="expected --alike"):
        compare_pictures([made("a", turned(0, 1), "transformers:folder")])
    assert compare_pictures([made("a", turned(0, 1), "transformers:folder")], alike=0.9).sets[0].duplicates == 2


def test_the_command_reads_runs_of_pictures(tmp_path: Path) -> None:
    for name, features in (("one", turned(0, 0.5, 90)), ("two", turned(0.2, 60))):
        rows = [
            {
                "scene_id": f"{name}_{k}",
                "extractor": "gradients",
                "extractor_fingerprint": "f",
                "views": [
                    {"view": view, "picture": b"png", "features": row.tolist()}
                    for view, row in (("perspective", np.ones(2)), ("front", features[k]))
                ],
            }
            for k in range(len(features))
        ]
        RunFolder(str(tmp_path / name)).write_shard("views", "0", rows)
    words = ["diversity", "--pictures", str(tmp_path / "one"), str(tmp_path / "two")]
    result = CliRunner().invoke(app, [*words, "--json", str(tmp_path / "o.json"), "--table", str(tmp_path / "o.parquet")])
    assert result.exit_code == 0, result.output
    assert "near-duplicates: one_0, one_1" in result.output
    figures = json.loads((tmp_path / "o.json").read_text())
    assert [one["duplicates"] for one in figures["sets"]] == [2, 0]
    assert figures["overlaps"][0]["second_scenes"] == 1
    assert pl.read_parquet(tmp_path / "o.parquet").height == 5
    assert CliRunner().invoke(app, [*words, "--where", "clean"]).exit_code == 2
    assert CliRunner().invoke(app, ["diversity", str(tmp_path / "one"), "--alike", "0.9"]).exit_code == 2
