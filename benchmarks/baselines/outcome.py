"""What every baseline takes and gives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from stable_data.assets.store import AssetStore
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene


@dataclass(frozen=True, slots=True)
class BaselineResult:
    """A scene as a baseline leaves it. Whether it is clean is for the exact audit to say, never for the baseline.

    Attributes:
        scene: The same instances, in order, where the baseline put them.
        converged: Whether the baseline counts itself done, by its own geometry and tolerance.
        seconds: Processor time of the optimisation alone: hulls, convex parts and grids of the assets are made before.
        reason: Why it did not converge; empty where it did.
    """

    scene: Scene
    converged: bool
    seconds: float
    reason: str = ""


class Baseline(Protocol):
    """A baseline with its settings."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Corrects one scene.

        Args:
            scene: The layout to start from.
            shapes: Geometry of its objects, in its order (``AssetStore.resolved``).
            store: Meshes of its assets.

        Returns:
            What became of it. The scene that comes back may hold other tilts than the one given where the baseline lets
            things tip over: ask the store for its shapes again.
        """
        ...
