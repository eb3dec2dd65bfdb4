"""Checks whether a stored run is whole: every file, row, reference and verdict that can be checked again."""
