"""Corrections that MuJoCo proves stable."""
