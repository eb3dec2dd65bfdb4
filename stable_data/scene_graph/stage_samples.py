"""The training samples of the reasoner: a staged scene, cut into what each stage is given and what it adds.

Needs only the standard library; :mod:`stable_data.scene_graph.staging` sets the stages.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from stable_data.errors import SceneError
from stable_data.scene import Scene, SceneObject, Stage
from stable_data.scene_graph.support_tree import SupportTree


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
