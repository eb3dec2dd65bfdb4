"""Edits from a reading of the instruction: which objects are meant, and where they go."""
