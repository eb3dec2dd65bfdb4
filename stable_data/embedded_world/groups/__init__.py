"""Functional groups: objects that people use together on a table, by activity."""
