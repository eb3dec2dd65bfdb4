"""Functional groups: what people put together on a table, kind by kind."""
