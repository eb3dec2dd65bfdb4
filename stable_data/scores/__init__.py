"""Scores of sets of answers: intervals of rates and means, average precision."""
