"""The arm: its model, where it stands, how it moves, and what it touches."""
