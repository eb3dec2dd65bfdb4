"""The training of the Physics Corrector."""
