"""Signed distance, negative inside: exact for a mesh, and on grids."""
