"""Job preprocess: a folder of scenes becomes tables."""
