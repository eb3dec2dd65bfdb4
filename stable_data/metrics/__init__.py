"""Metrics of scenes: collision, support, bounds, alignment, movement."""
