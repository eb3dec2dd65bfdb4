"""The paper's partition of a scene into O^t, O^B and O^b, and the sub-layouts that it serialises into.

O^t are the objects that the instruction names. O^B are those whose boxes come near one of them. O^b are the rest. One thing is
added to the paper: what carries an object is generated no later than the object, so that no sub-layout floats.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from stable_data.errors import SceneError
from stable_data.scene import Scene, SceneObject, Stage
from stable_data.scene_graph.relations import yawed_rectangle

THRESHOLD = 0.02
"""Objects whose box is this close to a task object's are important, metres. The paper leaves its threshold open."""

_ORDER = {stage: index for index, stage in enumerate(Stage)}


@dataclass(frozen=True, slots=True)
class StageSample:
    """What the reasoner learns from at one stage of one scene.

    Attributes:
        scene_id: The scene.
        stage: The stage.
        objects_in: All objects of earlier stages, in the order in which they were generated.
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
    """Distance of two objects' boxes, each turned by its yaw, metres; 0 where they meet."""
    flat = shapely.distance(shapely.Polygon(yawed_rectangle(one)), shapely.Polygon(yawed_rectangle(other)))
    gap = abs(one.position[2] - other.position[2]) - (one.size[2] + other.size[2]) / 2
    return float(np.hypot(flat, max(0.0, gap)))


def stage_scene(scene: Scene, threshold: float = THRESHOLD) -> Scene:
    """Gives every object its stage.

    Nearness is measured to the objects that the instruction names, not to what only carries them. Then what carries an object
    joins the earliest stage of what it carries, directly or through others.

    Args:
        scene: The scene, with its task's objects and every object's ``support``.
        threshold: How close a box is to a task object's to be important, metres.

    Returns:
        The scene with ``stage`` set on every object. Task objects that the scene does not have are passed over.

    Raises:
        SceneError: There is no task (``task_missing``), or supports form a circle (``support_circle``).
    """
    if scene.task is None:
        raise SceneError(f"{scene.scene_id}: no task, expected one to stage by; derive one first", "task_missing")
    named = [o for o in scene.objects if o.instance in scene.task.task_objects]
    stages = {o.instance: _stage_of(o, named, threshold) for o in scene.objects}
    carriers = _carriers(scene)
    for o in scene.objects:
        for carrier in _chain(scene, carriers, o.instance):
            stages[carrier] = min(stages[carrier], stages[o.instance], key=_ORDER.__getitem__)
    return replace(scene, objects=tuple(replace(o, stage=stages[o.instance]) for o in scene.objects))


def _stage_of(item: SceneObject, named: Iterable[SceneObject], threshold: float) -> Stage:
    if item in named:
        return Stage.TASK
    return Stage.IMPORTANT if any(box_distance(item, o) <= threshold for o in named) else Stage.SECONDARY


def _carriers(scene: Scene) -> dict[str, str]:
    """What carries each object that another object carries."""
    names = {o.instance for o in scene.objects}
    return {o.instance: o.support for o in scene.objects if o.support in names and o.support is not None}


def _chain(scene: Scene, carriers: Mapping[str, str], instance: str) -> list[str]:
    """What carries an object, directly and through others, nearest first."""
    chain: list[str] = []
    while instance in carriers:
        instance = carriers[instance]
        if instance in chain:
            found = " -> ".join([*chain, instance])
            raise SceneError(f"{scene.scene_id}: {found} form a circle of supports; derive supports anew", "support_circle")
        chain.append(instance)
    return chain


def samples_of(scene: Scene) -> tuple[StageSample, ...]:
    """The three samples of a staged scene, in the order of generation.

    Args:
        scene: A staged scene.

    Returns:
        One sample a stage; a stage without objects has an empty ``objects_out``.

    Raises:
        SceneError: An object has no stage (``stage_missing``), or supports form a circle (``support_circle``).
    """
    unstaged = [o.instance for o in scene.objects if o.stage is None]
    if unstaged:
        raise SceneError(f"{scene.scene_id}: {unstaged} have no stage; call stage_scene first", "stage_missing")
    samples: list[StageSample] = []
    done: tuple[SceneObject, ...] = ()
    for stage in Stage:
        objects_out = generation_order(scene.scene_id, [o for o in scene.objects if o.stage is stage])
        samples.append(StageSample(scene.scene_id, stage, done, objects_out))
        done += objects_out
    return tuple(samples)


def generation_order(scene_id: str, objects: Sequence[SceneObject]) -> tuple[SceneObject, ...]:
    """Objects large to small by footprint, then by height; each is followed at once by what it carries, in the same order.

    So a model that writes them one after the other has just written where a thing's carrier stands.

    Args:
        scene_id: Their scene, for the error.
        objects: Objects with their supports; a support that is not among them counts as none.

    Raises:
        SceneError: Supports form a circle (``support_circle``).
    """
    members = {o.instance: o for o in objects}
    carried: dict[str | None, list[SceneObject]] = {}
    for o in sorted(objects, key=lambda o: (-o.size[0] * o.size[1], -o.size[2])):  # stable: ties keep the given order
        carried.setdefault(o.support if o.support in members else None, []).append(o)
    ordered: list[SceneObject] = []
    waiting = carried.get(None, [])[::-1]
    while waiting:
        ordered.append(waiting.pop())
        waiting += carried.get(ordered[-1].instance, [])[::-1]
    if len(ordered) < len(objects):
        left = sorted(members.keys() - {o.instance for o in ordered})
        raise SceneError(f"{scene_id}: {left} form a circle of supports; derive supports anew", "support_circle")
    return tuple(ordered)
