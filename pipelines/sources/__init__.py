"""The inputs of jobs: scenes, tasks, edits and assets."""
