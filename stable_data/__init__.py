"""Scenes, geometry, verdicts and tables: the light library that policy-training jobs install."""

__version__ = "0.1.0"
