"""Where jobs take scenes, tasks, edits and assets from."""
