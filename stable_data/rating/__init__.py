"""Ratings of scenes by the five criteria of the paper's GPT-score, whoever rates: their definitions and their arithmetic."""
