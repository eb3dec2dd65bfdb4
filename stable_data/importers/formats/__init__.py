"""Formats of meshes and models: what the content of a file says. Nothing here opens a file; others are asked for by reference."""
