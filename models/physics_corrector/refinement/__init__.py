"""Batched refinement of layouts on signed distances: separates bodies and rests carried objects, as tensors."""
