"""Movement of the objects of a scene between two of its states."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stable_data.metrics.card import MetricCard
from stable_data.rotations import wrap_angle
from stable_data.scene import Scene

if TYPE_CHECKING:  # movement itself needs no mesh
    from stable_data.metrics.relations_kept import RelationsKept


def movement(before: Scene, after: Scene) -> tuple[float, float, float]:
    """Computes how far objects moved.

    Args:
        before: A scene.
        after: The same scene later; dropped objects do not count.

    Returns:
        Mean and largest displacement, millimetres; largest turn, degrees.
    """
    was = {o.instance: (*o.position, o.yaw) for o in before.objects}
    steps = np.array([np.subtract((*o.position, o.yaw), was[o.instance]) for o in after.objects]).reshape(-1, 4)
    if not len(steps):
        return 0.0, 0.0, 0.0
    lengths = 1e3 * np.linalg.norm(steps[:, :3], axis=1)
    turns = np.degrees(np.abs(wrap_angle(steps[:, 3])))
    return float(lengths.mean()), float(lengths.max()), float(turns.max())


def add_movement(card: MetricCard, before: Scene, after: Scene, kept: "RelationsKept") -> MetricCard:
    """Adds the movement of the objects from ``before`` to ``after``, and the shares of kept relations, to the card of ``after``."""
    mean, farthest, turn = movement(before, after)
    return replace(
        card,
        relations_kept_on_in=kept.on_in_share,
        relations_kept_directional=kept.directional_share,
        move_mean_mm=mean,
        move_max_mm=farthest,
        turn_max_deg=turn,
    )
