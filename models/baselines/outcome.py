"""The interface of the baselines and their result."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from stable_data.assets.store import AssetStore
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True)
class BaselineResult:
    """The result of a baseline. The exact audit decides whether it is clean, never the baseline.

    Attributes:
        scene: The same instances, in order, with the poses of the baseline; the start layout itself if it gives none.
        converged: Whether the baseline succeeded by its own geometry and tolerance.
        seconds: Processor time of the optimisation, without the preparation of hulls, convex parts and grids of assets.
        reason: Why it did not converge; empty if it did.
    """

    scene: Scene
    converged: bool
    seconds: float
    reason: str = ""


class Baseline(Protocol):
    """A correction method with its settings."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Corrects one scene.

        Args:
            scene: The start layout; its fixed objects are obstacles.
            shapes: Geometry of its objects, in order (``AssetStore.resolved``).
            store: Meshes of its assets.

        Returns:
            The result. Its scene may have other tilts than ``scene``, if objects can tip over: resolve its shapes again.
        """
        ...
