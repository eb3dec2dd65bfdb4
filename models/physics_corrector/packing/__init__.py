"""Packing in the plane: separates bodies that only shift on a table, with little movement and their order preserved."""
