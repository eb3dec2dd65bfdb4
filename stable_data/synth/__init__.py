"""The embedded world: parametric assets and physically clean scenes in the MesaTask-10K format."""
