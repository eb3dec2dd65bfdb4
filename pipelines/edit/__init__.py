"""The job edit: instructions change scenes."""
