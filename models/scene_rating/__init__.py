"""Ratings of scenes by the paper's five criteria: by a language model that sees pictures, or by rules on the geometry alone."""
