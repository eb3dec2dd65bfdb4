"""MuJoCo, the engine of the corrections, as a judge."""

from stable_data.simulation.settling import settle

__all__ = ["settle"]
