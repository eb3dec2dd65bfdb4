"""Other people's programs open exported scenes: whether they see what the scene says, and whether it stays at rest there."""
