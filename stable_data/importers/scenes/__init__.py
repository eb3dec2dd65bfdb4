"""Readers of the scene files of other projects, and writers that put repaired poses back."""
