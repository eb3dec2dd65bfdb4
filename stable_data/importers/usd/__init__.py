"""Assets in the format of Universal Scene Description (USD)."""

from stable_data.importers.usd.reader import UsdReader

__all__ = ["READER", "UsdReader"]

READER = UsdReader()
