"""Supports: pieces of furniture whose surfaces become the tables of scenes."""

SECONDS_PER_ITEM = 300.0
"""Time limit of an asset, if no other one is given."""
