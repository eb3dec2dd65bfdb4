"""Scores of sets: intervals of rates and means, average precision, distances and diversity of features."""
