"""A trained network that moves the objects of scenes: what the corrector's flow shares with the rearrangers of other papers."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch

from models.device_batches import DeviceBatches
from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.scene_reading import SceneReader
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene


class LearnedMover(ABC):
    """A trained network that moves objects; a :data:`~models.physics_corrector.corrector.SceneMover`.

    Args:
        name: What it is, for messages.
        reader: Reads scenes for the network.
        batch: Scenes in one batch of the network.
    """

    def __init__(self, name: str, reader: SceneReader, batch: int) -> None:
        self._reader, self._batches = reader, DeviceBatches(name, batch)

    def prepare(self, scene: Scene, shapes: Sequence[Shape]) -> None:
        """Computes what is kept of a scene's objects: features of their shapes and words."""
        self._reader.condition([scene], [shapes], [frozenset()])

    @torch.no_grad()
    def __call__(
        self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]
    ) -> list[Scene | None]:
        """Moves the objects of scenes; fixed objects are unchanged bit by bit.

        Args:
            scenes: The scenes, positions at the centres of the boxes, with known supports.
            shapes: The geometry of the objects of each scene, in their order.
            fixed: The instances of each scene that must not move.

        Returns:
            The moved scenes; None where the new poses are not finite.
        """
        return self._batches.run(list(zip(scenes, shapes, fixed, strict=True)), self._move_batch)

    def _move_batch(self, layouts: Sequence[tuple[Scene, Sequence[Shape], Fixed]]) -> Sequence[Scene | None]:
        scenes, shapes, fixed = [x for x, _, _ in layouts], [x for _, x, _ in layouts], [x for _, _, x in layouts]
        condition = self._reader.condition(scenes, shapes, fixed)
        return self._moved(condition, scenes, shapes, fixed) if condition.mask.any() else scenes

    @abstractmethod
    def _moved(
        self, condition: Condition, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]
    ) -> list[Scene | None]:
        """Moves the objects of a batch, of which the network reads the condition."""
