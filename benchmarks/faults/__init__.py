"""Faults that happen to a job while it runs: lost processes and nodes, a bad object store, a full disk, a clock that jumps."""
