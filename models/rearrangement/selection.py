"""The choice among samples of one scene: the fewest faults, and among equals the least movement."""

from collections.abc import Sequence

import numpy as np

from stable_data.geometry.shape import Shape
from stable_data.metrics.bounds import leaves_table
from stable_data.metrics.sampled_collision import num_sampled_collisions
from stable_data.metrics.verdicts import TOLERANCE
from stable_data.scene import Scene


def num_faults(scene: Scene, shapes: Sequence[Shape]) -> int:
    """Counts pairs of objects of which one has a surface sample inside the other, and objects that reach over the table's edge.

    Args:
        scene: The scene.
        shapes: The geometry of its objects, in order.
    """
    outlines = [shape.posed_footprint(pose) for shape, pose in zip(shapes, scene.poses(), strict=True)]
    outside = sum(leaves_table(o.min(axis=0), o.max(axis=0), scene.table, TOLERANCE) for o in outlines)
    return num_sampled_collisions(scene, shapes) + outside


def choose_sample(start: Scene, shapes: Sequence[Shape], samples: Sequence[Scene | None]) -> Scene | None:
    """Returns the sample with the fewest faults; of several the one whose objects moved least, of equal ones the first.

    Args:
        start: The perturbed scene.
        shapes: The geometry of its objects, in order.
        samples: Scenes with the same objects; None, of which the poses are not finite, is not chosen.

    Returns:
        The chosen sample; None if there is none.
    """
    found = [sample for sample in samples if sample is not None]
    if len(found) < 2:
        return next(iter(found), None)

    def score(sample: Scene) -> tuple[int, float]:
        moved = np.linalg.norm(sample.poses()[:, :3] - start.poses()[:, :3], axis=1)
        return num_faults(sample, shapes), float(moved.sum())

    return min(found, key=score)
