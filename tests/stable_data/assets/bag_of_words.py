"""A text encoder for tests: every word has a direction of its own, a text the sum of its words'. And small libraries for it."""

import re
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from stable_data.assets.catalog import Asset, AssetLibrary, RestingTilt
from stable_data.assets.text_embeddings import Rows
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Vec3

LAID: QuatXyzw = (0.5**0.5, 0.0, 0.0, 0.5**0.5)  # a quarter turn about x: what was up points to -y


class BagOfWords:
    """Texts that share words are alike; the order of words does not matter.

    Args:
        seed: Two encoders with different seeds have nothing in common.
        width: Numbers a row.
    """

    def __init__(self, seed: int = 0, width: int = 128) -> None:
        self._seed, self._width, self.asked = seed, width, list[str]()
        self.fingerprint = f"bag-{seed}-{width}"

    def __call__(self, texts: Sequence[str], /) -> Rows:
        self.asked += texts
        rows = np.array([sum(map(self._word, re.findall(r"\w+", text.lower()) or [""])) for text in texts])
        unit: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
        return unit

    def _word(self, word: str) -> FloatArray:
        row: FloatArray = np.random.default_rng([self._seed, zlib.crc32(word.encode())]).normal(size=self._width)
        return row


def thing(
    asset_id: str, words: str, extents: Vec3 = (1.0, 1.0, 1.0), category: str = "", *, licence: str | None = None, **more: Any
) -> Asset:
    return Asset(asset_id, category, words, extents, (RestingTilt(UPRIGHT, extents, 9),), licence=licence, **more)


def bottle(asset_id: str = "bottle", words: str = "a green bottle") -> Asset:
    """One that mostly stands, and may lie along y."""
    return Asset(
        asset_id,
        "bottle",
        words,
        (1.0, 1.0, 4.0),
        (RestingTilt(UPRIGHT, (1.0, 1.0, 4.0), 90), RestingTilt(LAID, (1.0, 4.0, 1.0), 10)),
    )


def library(*assets: Asset, name: str = "first", encoder: BagOfWords | None = None) -> AssetLibrary:
    return AssetLibrary(name, assets).embedded(encoder or BagOfWords())
