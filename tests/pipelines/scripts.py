"""Replies that are written down, in the words of a library's own assets."""

from typing import Any

from stable_data.asset_library import Asset


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
