"""Modules that all trainings use."""
