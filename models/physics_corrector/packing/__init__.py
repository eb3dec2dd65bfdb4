"""Packing in the plane: bodies that only shift are parted on a table, with the least movement and their order kept."""
