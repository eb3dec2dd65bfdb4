"""Fuzzing: changed inputs for every reader, run in processes that are watched."""
