"""Job edit: instructions change scenes."""
