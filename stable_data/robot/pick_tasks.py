"""Tasks that ask a robot to pick up one object of a scene: for training and tests of grasping, in scenes with any task or none."""

from dataclasses import replace

import numpy as np

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.instructions.naming import ObjectNamer
from stable_data.scene import Scene, TaskInfo
from stable_data.scene_graph.relations import contacts_of, scene_graph
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.tasks.geometry import TaskGeometry


def with_pick_task(geometry: SceneGeometry, instance: str) -> SceneGeometry:
    """Returns the scene with the task to pick up one of its objects.

    Args:
        geometry: The scene.
        instance: The object.
    """
    scene = geometry.scene
    words = _name(scene, geometry, instance)
    task = TaskInfo(
        environment=f"A {scene.table.table_type.replace('_', ' ')}, seen from its front edge.",
        task=f"Pick up {words}.",
        goal=(f"{words[0].upper()}{words[1:]} is held above the table.",),
        task_objects=(instance,),
        origin="template",
        conditions=(GoalCondition(instance, ConditionKind.HELD),),
    )
    return replace(geometry, scene=replace(scene, task=task))


def pick_order(scene: Scene, rng: np.random.Generator) -> tuple[str, ...]:
    """Returns the objects of a scene that carry nothing, in random order."""
    carriers = {o.support for o in scene.objects}
    names = [o.instance for o in scene.movable if o.instance not in carriers]
    return tuple(names[k] for k in rng.permutation(len(names)))


def _name(scene: Scene, geometry: SceneGeometry, instance: str) -> str:
    """Words for an object that single it out if there are such words, else its category."""
    graph = scene_graph(scene, contacts_of(scene), containers=TaskGeometry.of(geometry).containers)
    names = ObjectNamer(scene, graph).names(instance)
    if names:
        return min(names, key=lambda name: (name.anchor is not None, len(name.words), name.words)).words
    return f"the {scene[instance].category.replace('_', ' ')}"
