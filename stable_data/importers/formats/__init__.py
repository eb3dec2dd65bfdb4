"""Mesh file formats: the content of a file becomes surfaces. Nothing here opens a file; companions are asked for by reference."""
