"""The embedded world: parametric assets and physically clean scenes in the MesaTask-10K format."""

from stable_data.synth.scenes import write_embedded_set

__all__ = ["write_embedded_set"]
