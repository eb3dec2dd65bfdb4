"""Searches for the places of boxes on a table under stated relations: a grid search, and backtracking over a graph."""
