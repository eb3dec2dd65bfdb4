"""The Physics Corrector: a learned flow from coarse poses to poses that a physics engine accepts."""
