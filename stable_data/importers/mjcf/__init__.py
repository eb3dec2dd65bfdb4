"""Assets in the format of MuJoCo (MJCF)."""

from stable_data.importers.mjcf.reader import MjcfReader

__all__ = ["READER", "MjcfReader"]

READER = MjcfReader()
