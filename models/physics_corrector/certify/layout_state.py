"""A layout while it is corrected: poses, what carries what, what is still there."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene, Stage

_STIFFNESS = {Stage.TASK: 10.0, Stage.IMPORTANT: 3.0, Stage.SECONDARY: 1.0, None: 1.0}


class LayoutState:
    """Where objects are and what carries them.

    Args:
        scene: The scene.
        shapes: The geometry of its objects.
        carried: What carries each of them.
        fixed: Instances that must not move.

    Attributes:
        poses: (N, 4) float64, metres and radians, changed as the correction goes on.
        carried: What carries each object.
        is_there: Whether each object has not been dropped.
    """

    def __init__(self, scene: Scene, shapes: Sequence[Shape], carried: Sequence[SupportEdge], fixed: frozenset[str]) -> None:
        self.scene, self.shapes = scene, shapes
        self.poses: FloatArray = scene.poses()
        self.carried = list(carried)
        self.is_there = [True] * len(shapes)
        self.is_fixed = [o.instance in fixed for o in scene.objects]

    def present(self) -> list[int]:
        """Objects that have not been dropped."""
        return [k for k, there in enumerate(self.is_there) if there]

    def roots(self) -> list[int]:
        """Objects that stand on the table."""
        return [k for k in self.present() if self.carried[k].parent == TABLE_TOP]

    def children(self, k: int) -> list[int]:
        """Objects that an object carries directly."""
        return [c for c in self.present() if self.carried[c].parent == k]

    def tree(self, k: int) -> list[int]:
        """An object and all that it carries, carriers first."""
        members = [k]
        for m in members:
            members += self.children(m)
        return members

    def carriers(self, k: int) -> list[int]:
        """An object, what carries it, what carries that, and so on down to what stands on the table."""
        chain = [k]
        while self.carried[k].parent != TABLE_TOP:
            k = self.carried[k].parent
            chain.append(k)
        return chain

    def root_of(self, k: int) -> int:
        """What stands on the table below an object, or the object itself."""
        return self.carriers(k)[-1]

    def low(self, k: int) -> float:
        """Height of an object's bottom over the table, metres."""
        return float(self.poses[k, 2] - self.shapes[k].size[2] / 2)

    def stand(self, k: int) -> None:
        """Puts an object on the table itself, with all that it carries."""
        self.carried[k] = SupportEdge()
        self.poses[self.tree(k), 2] -= self.low(k)

    def carry(self, k: int, pose: FloatArray) -> None:
        """Moves an object to a pose (4,), with all that it carries."""
        turn, old = pose[3] - self.poses[k, 3], self.poses[k].copy()
        c, s = np.cos(turn), np.sin(turn)
        for m in self.tree(k):
            offset = self.poses[m, :2] - old[:2]
            self.poses[m, :2] = pose[:2] + (np.array([[c, -s], [s, c]]) @ offset if turn else offset)
            self.poses[m, 2] += pose[2] - old[2]
            self.poses[m, 3] += turn

    def drop(self, k: int) -> list[int]:
        """Takes an object away with all that it carries, and says which those are."""
        members = self.tree(k)
        for m in members:
            self.is_there[m] = False
        return members

    def stiffness(self, k: int) -> float:
        """How much the movement of an object with all that it carries counts; infinite where part of it is fixed."""
        members = self.tree(k)
        if any(self.is_fixed[m] for m in members):
            return float("inf")
        return sum(_STIFFNESS[self.scene.objects[m].stage] for m in members)

    def rank(self, k: int) -> tuple[float, float, str]:
        """What is dropped first comes first: by stage, then by footprint."""
        importance = max(_STIFFNESS[self.scene.objects[m].stage] for m in self.tree(k))
        x, y = self.shapes[k].size[:2]
        return importance, float(x * y), self.scene.objects[k].instance

    def may_drop(self, k: int) -> bool:
        """Is an object, with all that it carries, neither fixed nor part of the task?"""
        return not any(self.is_fixed[m] or self.scene.objects[m].stage is Stage.TASK for m in self.tree(k))
