"""Looks at scenes in a browser: a page that needs no network, and a live viewer of a run."""
