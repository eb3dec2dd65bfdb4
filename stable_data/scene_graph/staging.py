"""The paper's partition of a scene into the stages O^t, O^B and O^b, and the sub-layout of each stage.

O^t are the objects that the instruction names. O^B are the objects whose boxes are near one of them. O^b are the rest. The
paper does not state how supports matter: here the support of an object is generated no later than the object, so that no
sub-layout floats.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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


@dataclass(frozen=True, slots=True)
class StageSample:
    """A training sample of the reasoner: one stage of one scene.

    Attributes:
        scene_id: The scene.
        stage: The stage.
        objects_in: All objects of earlier stages, in the order of generation.
        objects_out: This stage's objects in the order of generation (:func:`generation_order`); possibly none.
    """

    scene_id: str
    stage: Stage
    objects_in: tuple[SceneObject, ...]
    objects_out: tuple[SceneObject, ...]

    @property
    def layout(self) -> tuple[SceneObject, ...]:
        """The cumulative sub-layout that this stage completes."""
        return self.objects_in + self.objects_out


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


def samples_of(scene: Scene) -> tuple[StageSample, ...]:
    """Returns the three samples of a staged scene, in the order of generation, without fixed objects.

    A stage without objects has an empty ``objects_out``.

    Raises:
        SceneError: An object has no stage (``stage_missing``), or supports form a cycle (``support_circle``).
    """
    unstaged = [o.instance for o in scene.movable if o.stage is None]
    if unstaged:
        raise SceneError(f"{scene.scene_id}: {unstaged} have no stage; call stage_scene first", "stage_missing")
    samples: list[StageSample] = []
    done: tuple[SceneObject, ...] = ()
    for stage in Stage:
        objects_out = generation_order(scene.scene_id, [o for o in scene.movable if o.stage is stage])
        samples.append(StageSample(scene.scene_id, stage, done, objects_out))
        done += objects_out
    return tuple(samples)


def generation_order(scene_id: str, objects: Sequence[SceneObject]) -> tuple[SceneObject, ...]:
    """Sorts objects by footprint, then by height, large first; each is followed at once by the objects on it, in the same order.

    A model that writes objects in this order has always just written the pose of the support.

    Args:
        scene_id: Their scene, for the error.
        objects: Objects with their supports; a support that is not among them counts as none.

    Raises:
        SceneError: Supports form a cycle (``support_circle``).
    """
    by_size = sorted(objects, key=lambda o: (-o.size[0] * o.size[1], -o.size[2]))  # stable: ties keep the given order
    named = {o.instance: o for o in objects}
    return tuple(named[name] for name in SupportTree.of(by_size, scene_id).bottom_up())
