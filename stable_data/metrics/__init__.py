"""Verdicts on scenes: collision, support, bounds."""
