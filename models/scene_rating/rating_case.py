"""A scene as judges get it: with its two pictures, and with its geometry for judges by rules."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from stable_data.errors import SceneError
from stable_data.metrics.alignment import Alignment, AlignmentReference, align
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.related_scene import RelatedScene, relate_scene
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.tasks.geometry import known_containers


@dataclass(frozen=True, eq=False)
class AuditedScene:
    """A scene with its geometry, its exact audit and its relations: what rules look at.

    Attributes:
        geometry: The scene with its geometry.
        audit: Its exact audit.
        related: The scene with the supports and relations that follow from the audit.
        containers: Which objects are containers; None where it is not known.
    """

    geometry: SceneGeometry
    audit: Audit
    related: RelatedScene
    containers: Mapping[str, bool | None]

    @classmethod
    def of(cls, geometry: SceneGeometry) -> "AuditedScene":
        """Audits a scene and derives its relations."""
        posed = PosedScene(geometry.scene, geometry.shapes)
        audit = audit_posed_scene(posed)
        containers = known_containers(geometry.scene, geometry.annotations)
        return cls(geometry, audit, relate_scene(posed, audit, containers), containers)

    @property
    def scene(self) -> Scene:
        """The scene, with supports and relations."""
        return self.related.scene

    def align(self, reference: AlignmentReference) -> Alignment:
        """Compares the scene with what a task requires, by its contacts."""
        r = self.related
        return align(r.scene, reference, contacts=r.contacts, footprints=r.footprints, containers=self.containers)


@dataclass(frozen=True, eq=False)
class RatingCase:
    """A scene to rate.

    Attributes:
        scene: The scene.
        clean: Whether it is clean; None if that is unknown.
        front: Its picture from the front, (H, W, 3) uint8; None if there is none.
        perspective: Its picture from the left of the front; None if there is none.
        audited: Its geometry and audit; None if there are none, as after :meth:`without_geometry`.
    """

    scene: Scene
    clean: bool | None
    front: Picture | None = None
    perspective: Picture | None = None
    audited: AuditedScene | None = None

    def __post_init__(self) -> None:
        """Refuses what is no picture (``picture_invalid``)."""
        for name, picture in (("front", self.front), ("perspective", self.perspective)):
            if picture is not None and not (
                isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
            ):
                shown = f"{picture.shape} {picture.dtype}" if isinstance(picture, np.ndarray) else type(picture).__name__
                raise SceneError(
                    f"{self.scene_id}: the {name} picture is {shown}, expected (H, W, 3) uint8; render it again",
                    "picture_invalid",
                )

    @classmethod
    def of(cls, geometry: SceneGeometry, front: Picture | None = None, perspective: Picture | None = None) -> "RatingCase":
        """Audits a scene and derives its relations.

        Raises:
            SceneError: A picture is none (``picture_invalid``).
        """
        audited = AuditedScene.of(geometry)
        return cls(audited.scene, audited.audit.card().clean, front, perspective, audited)

    @property
    def scene_id(self) -> str:
        """Its id."""
        return self.scene.scene_id

    def without_geometry(self) -> "RatingCase":
        """Returns the scene as a judge by pictures needs it, which can be sent to another process."""
        return replace(self, audited=None)
