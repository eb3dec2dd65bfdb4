"""The training of the Semantic Reasoner."""
