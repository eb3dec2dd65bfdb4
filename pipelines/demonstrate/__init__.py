"""The demonstrate job: a scripted expert carries out the tasks of scenes, and its episodes are recorded."""
