"""The job generate: tasks become simulation-ready scenes."""
