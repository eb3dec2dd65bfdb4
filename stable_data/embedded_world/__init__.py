"""The embedded world: parametric assets and physically clean scenes in the MesaTask-10K format."""

from stable_data.embedded_world.world import EmbeddedWorld, write_world

__all__ = ["EmbeddedWorld", "write_world"]
