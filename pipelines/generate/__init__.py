"""Job generate: tasks become simulation-ready scenes."""
