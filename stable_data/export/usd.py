"""Exports to OpenUSD: a stage for each scene, and the SimReady packages of its objects beside it.

An export::

    props/<prop>/usd/<prop>.usd        a package, see :mod:`stable_data.export.usd_prop`
    furniture/<content>.usd            what is seen of the table and the room
    scenes/<scene>.usda                a stage, which references the others
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

from stable_data.atomic_files import safe_file_name
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry

Flavour: TypeAlias = Literal["neutral", "isaaclab"]

_ABOUT = """OpenUSD: `scenes/<scene>.usda` is a stage: metres, kilograms, z up, explicit gravity. Each object is a prim below
`/World/Objects` with the name of its instance, a pose (that of the centre of its base) and one rigid body; it references a package
below `props`, which follows the profile Robotics-Prop of SimReady. Where the size differs from that of the package, the stage states
the scale of `Geometry` and the mass. Colliders are convex parts with purpose `guide`; `/World/Table` is a static collider. Task,
relations and verdicts are `customData` of `/World`. Copy the folders `props` and `furniture` with the stages."""

_ABOUT_ISAACLAB = """OpenUSD for Isaac Lab: as the format usd, but every object has a package of its own size below `props`, so that
each file can be spawned as it is; and stages have no physics scene, lights, cameras and room, which Isaac Lab makes itself."""


@dataclass(frozen=True, slots=True)
class UsdFormat:
    """The format; see :class:`~stable_data.export.formats.ExportFormat`.

    Attributes:
        flavour: ``neutral`` for every program; ``isaaclab`` for the spawners of Isaac Lab.
    """

    NEEDS: ClassVar = ("pxr",)

    flavour: Flavour = "neutral"

    @property
    def ABOUT(self) -> str:  # noqa: N802 - the constant of a format
        """Description of an export and how to open it."""
        return _ABOUT if self.flavour == "neutral" else _ABOUT_ISAACLAB

    def scene_path(self, scene: Scene, out: Path) -> Path:
        """Returns the file of a scene: if it exists, the scene is exported."""
        return out / "scenes" / f"{safe_file_name(scene.scene_id)}.usda"

    def export_scene(self, geometry: SceneGeometry, out: Path) -> None:
        """Writes a scene, and those of its packages that do not exist yet.

        Raises:
            MeshError: An object has no solid part.
        """
        from stable_data.export.usd_stage import write_stage  # OpenUSD is an extra

        write_stage(geometry, out, self.scene_path(geometry.scene, out), is_whole=self.flavour == "neutral")
