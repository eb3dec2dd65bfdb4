"""A robot at the table: its model, tasks, grasps, demonstrations."""
