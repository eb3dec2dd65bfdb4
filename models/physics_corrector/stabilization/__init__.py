"""Corrections whose stability is tested in MuJoCo."""
