"""Writes a run as a folder that a dataset hub takes as it is."""
