"""How jobs run: shards, workers, progress, resume."""
