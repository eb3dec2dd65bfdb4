"""The paper's partition of a scene into the stages O^t, O^B and O^b, and the sub-layout of each stage.

O^t are the objects that the instruction names. O^B are the objects whose boxes are near one of them. O^b are the rest. The
paper does not state how supports matter: here the support of an object is generated no later than the object, so that no
sub-layout floats.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import shapely

from stable_data.errors import SceneError
from stable_data.scene import Scene, SceneObject, Stage
from stable_data.scene_graph.relations import yawed_rectangle
from stable_data.scene_graph.support_tree import SupportTree

THRESHOLD = 0.02
"""An object is important if its box is at most this far from the box of a task object, metres. The paper states no
threshold."""

_ORDER = {stage: index for index, stage in enumerate(Stage)}


def box_distance(one: SceneObject, other: SceneObject) -> float:
    """Computes the distance of two objects' boxes, each turned by its yaw, metres; 0 if they meet."""
    flat = shapely.distance(shapely.Polygon(yawed_rectangle(one)), shapely.Polygon(yawed_rectangle(other)))
    gap = abs(one.position[2] - other.position[2]) - (one.size[2] + other.size[2]) / 2
    return float(np.hypot(flat, max(0.0, gap)))


def stage_scene(scene: Scene, threshold: float = THRESHOLD) -> Scene:
    """Sets the stage of every object.

    Distances are measured to the objects that the instruction names, not to their supports. Then each support joins the
    earliest stage of the objects that it supports, directly or through others.

    Args:
        scene: The scene, with its task's objects and every object's ``support``.
        threshold: Largest distance of an important object's box to a task object's box, metres.

    Returns:
        The scene with ``stage`` set on every object but the fixed ones, which have none. Task objects that the scene does not contain
        are ignored.

    Raises:
        SceneError: There is no task (``task_missing``), or supports form a cycle (``support_circle``).
    """
    if scene.task is None:
        raise SceneError(f"{scene.scene_id}: no task, expected one for staging; derive a task first", "task_missing")
    named = [o for o in scene.objects if o.instance in scene.task.task_objects]
    stages = {o.instance: _stage_of(o, named, threshold) for o in scene.movable}
    tree = SupportTree.of(scene.movable, scene.scene_id)
    for name in reversed(tree.bottom_up()):  # from the top down, so that a stage reaches the lowest support
        if (carrier := tree.parent(name)) is not None and carrier not in scene.fixed:
            stages[carrier] = min(stages[carrier], stages[name], key=_ORDER.__getitem__)
    return replace(scene, objects=tuple(replace(o, stage=stages.get(o.instance)) for o in scene.objects))


def _stage_of(item: SceneObject, named: Iterable[SceneObject], threshold: float) -> Stage:
    if item in named:
        return Stage.TASK
    return Stage.IMPORTANT if any(box_distance(item, o) <= threshold for o in named) else Stage.SECONDARY
