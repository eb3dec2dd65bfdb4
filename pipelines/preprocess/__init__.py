"""The job preprocess: a folder of scenes becomes tables."""
