"""What is learned: point encoder, Physics Corrector, Semantic Reasoner."""
