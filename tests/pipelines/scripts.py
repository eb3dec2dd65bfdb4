"""Replies that are written down, in the words of a library's own assets."""

from collections.abc import Sequence
from typing import Any

from models.semantic_reasoner.text.prompt import WANTED
from stable_data.assets.catalog import Asset
from stable_data.scene import Stage


def entry(asset: Asset, x: float, name: str = "", words: str = "") -> dict[str, Any]:
    """An object of a reply that asks for an asset in its own words, on the table."""
    size = [round(12 * side / max(asset.tilts[0].extents), 1) + 0.1 for side in asset.tilts[0].extents]
    place = [x, 30.0, round(size[2] / 2, 1)]
    described = words or asset.words
    return {
        "instance": name or f"{asset.category}_0",
        "description": described,
        "size": size,
        "position": place,
        "z_rotation": 90,
    }


def one_thing_a_stage(assets: Sequence[Asset]) -> dict[str, Any]:
    """A script that puts an asset on the table in each stage, one in the other: the corrector has to part them."""
    return {WANTED[stage]: {"objects": [entry(a, 20.0)]} for stage, a in zip(Stage, assets, strict=True)}
