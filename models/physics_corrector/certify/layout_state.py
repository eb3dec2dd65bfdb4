"""The state of a layout during a correction: poses, carriers, and which objects are still in it."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.certify.support_inference import TABLE_TOP, SupportEdge
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene, Stage

# A task object moves least; a background object that is far from it moves first, and is dropped first.
STIFFNESS = {Stage.TASK: 10.0, Stage.IMPORTANT: 3.0, Stage.SECONDARY: 1.0, None: 1.0}
_STILL = 30.0  # factor of the weight of an object that shall move less than all others


class LayoutState:
    """The poses of objects and their carriers.

    Args:
        scene: The scene.
        shapes: The geometry of its objects.
        carried: The support of each object.
        fixed: Instances that must not move.
        still: Instances that shall move less than all others.

    Attributes:
        poses: (N, 4) float64, metres and radians; changes during the correction.
        carried: The support of each object; changes likewise.
        is_there: Whether each object has not been dropped.
    """

    def __init__(
        self,
        scene: Scene,
        shapes: Sequence[Shape],
        carried: Sequence[SupportEdge],
        fixed: frozenset[str],
        still: frozenset[str] = frozenset(),
    ) -> None:
        self.scene, self.shapes = scene, shapes
        self.poses: FloatArray = scene.poses()
        self.carried = list(carried)
        self.is_there = [True] * len(shapes)
        self.is_fixed = [o.instance in fixed for o in scene.objects]
        self._weights = [STIFFNESS[o.stage] * (_STILL if o.instance in still else 1.0) for o in scene.objects]

    def present(self) -> list[int]:
        """Returns the objects that have not been dropped."""
        return [k for k, there in enumerate(self.is_there) if there]

    def roots(self) -> list[int]:
        """Returns the objects that stand on the table."""
        return [k for k in self.present() if self.carried[k].parent == TABLE_TOP]

    def children(self, k: int) -> list[int]:
        """Returns the objects that an object carries directly."""
        return [c for c in self.present() if self.carried[c].parent == k]

    def tree(self, k: int) -> list[int]:
        """Returns an object and all that it carries, directly and through others, carriers first."""
        members = [k]
        for m in members:
            members += self.children(m)
        return members

    def carriers(self, k: int) -> list[int]:
        """Returns an object and its carriers, direct and indirect, down to the one on the table."""
        chain = [k]
        while self.carried[k].parent != TABLE_TOP:
            k = self.carried[k].parent
            chain.append(k)
        return chain

    def root_of(self, k: int) -> int:
        """Returns the lowest carrier of an object, or the object itself if it stands on the table."""
        return self.carriers(k)[-1]

    def low(self, k: int) -> float:
        """Returns the height of an object's bottom over the table, metres."""
        return float(self.poses[k, 2] - self.shapes[k].size[2] / 2)

    def stand(self, k: int) -> None:
        """Puts an object on the table, with all that it carries."""
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
        """Drops an object with all that it carries, and returns these."""
        members = self.tree(k)
        for m in members:
            self.is_there[m] = False
        return members

    def stiffness(self, k: int) -> float:
        """Returns the weight of the movement of an object with all that it carries; infinite if one of these is fixed."""
        members = self.tree(k)
        if any(self.is_fixed[m] for m in members):
            return float("inf")
        return sum(self._weights[m] for m in members)

    def rank(self, k: int) -> tuple[float, float, str]:
        """Returns the importance by stage, the footprint in square metres, and the instance, by which objects to drop are chosen."""
        importance = max(STIFFNESS[self.scene.objects[m].stage] for m in self.tree(k))
        x, y = self.shapes[k].size[:2]
        return importance, float(x * y), self.scene.objects[k].instance

    def may_drop(self, k: int) -> bool:
        """Whether neither an object nor anything that it carries is fixed or a task object."""
        return not any(self.is_fixed[m] or self.scene.objects[m].stage is Stage.TASK for m in self.tree(k))
