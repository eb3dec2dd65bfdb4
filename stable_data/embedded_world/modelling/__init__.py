"""Parametric solids, of which the families of the embedded world are built."""
