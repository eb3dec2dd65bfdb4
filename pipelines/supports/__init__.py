"""Supports: pieces of furniture whose surfaces become the tables of scenes."""
