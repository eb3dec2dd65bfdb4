"""The catalogue of the embedded world: each asset by category and variant, built once, weighed and named by its content."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import MappingProxyType

import numpy as np

from stable_data.assets.annotation import AssetAnnotation
from stable_data.embedded_world.families import FAMILIES
from stable_data.embedded_world.modelling.family import COLORS, DENSITY, Drawing, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.solids import box, coats, mesh_of, volume
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray, IntArray, QuatXyzw, Vec3

NUM_VARIANTS = 6
"""Number of assets of each category."""

BY_CATEGORY: Mapping[str, Drawing] = MappingProxyType({design.__name__: design for design in FAMILIES})
"""The design function of each category."""

LICENCE = "Apache-2.0"
"""Licence of all assets: that of this project, whose code makes them."""

KEYS: tuple[str, ...] = tuple(f"{category}/{n}" for category in BY_CATEGORY for n in range(NUM_VARIANTS))
"""All assets, as ``category/variant``."""

_UNITS = (1.0, 0.01, 0.001, 0.0254, 0.1, 0.37)  # metres per unit of a file; the variety tests readers of files in other units


@dataclass(frozen=True, eq=False)
class EmbeddedAsset:
    """An asset of the catalogue.

    Attributes:
        key: ``category/variant``.
        material: A key of ``DENSITY``.
        color_name: A key of ``COLORS``, or ``#rrggbb``.
        captions: Three or more names for it; the first is the plainest complete one.
        tilts: Its usual resting tilts; the first is the most usual.
        mesh: Closed, faces outward, metres, z up, centred on its box.
        parts: The convex parts whose union is the mesh, in the same frame.
        mass: Kilograms.
        unit: Metres per unit of its file.
        is_z_up: Whether its file stores the mesh z up below a node that rotates it, as many exporters do.
        paint: Colours of its faces: (``#rrggbb``, indices).
        top: The area that objects can stand on, in the frame of the mesh; None if there is none.
        hollow: The space that objects can be in, likewise.
        handle: Corners of the convex parts by which a hand holds it, (K, 3) each, in the frame of the mesh; empty without a handle.
    """

    key: str
    material: str
    color_name: str
    captions: tuple[str, ...]
    tilts: tuple[QuatXyzw, ...]
    mesh: Mesh
    parts: tuple[Mesh, ...]
    mass: float
    unit: float
    is_z_up: bool
    paint: tuple[tuple[str, IntArray], ...]
    top: SupportArea | None
    hollow: SupportArea | None
    handle: tuple[FloatArray, ...]

    @property
    def category(self) -> str:
        """Its category."""
        return self.key.split("/")[0]

    @property
    def color(self) -> str:
        """Its colour, ``#rrggbb``."""
        return _rgb(self.color_name)

    @property
    def glb(self) -> bytes:
        """The contents of its GLB file, made anew each time: a process may know all assets, and writes few."""
        return write_glb(self.mesh, unit=self.unit, is_z_up=self.is_z_up, paint=self.paint, parts=self.parts)

    @cached_property
    def uid(self) -> str:
        """32 hexadecimal digits, a hash of its file."""
        return hashlib.blake2b(self.glb, digest_size=16).hexdigest()

    @property
    def file_extents(self) -> Vec3:
        """Box of the mesh, file units, z up."""
        x, y, z = (self.mesh.extents / self.unit).tolist()
        return (x, y, z)

    @property
    def annotation(self) -> AssetAnnotation:
        """Its entry in Asset_annotation.json."""
        first = self.captions[0]
        return AssetAnnotation(
            self.uid,
            category=self.category,
            description=first,
            caption=f"{first[0].upper()}{first[1:]}.",
            source="synth",
            mass=round(self.mass, 4),
            is_container=self.hollow is not None,
            extents_z_up=self.file_extents,
            raw={"licence": LICENCE, "materials": [self.material], "color": self.color, "captions": list(self.captions)},
        )


@cache
def asset(key: str) -> EmbeddedAsset:
    """Returns an asset of the catalogue.

    Args:
        key: ``category/variant``, one of ``KEYS``.

    Raises:
        ConfigError: The key is unknown (``unknown_asset``).
    """
    category, _, number = key.partition("/")
    if key not in _KNOWN:
        raise ConfigError(f"asset {key!r} is not in the catalogue, expected one of {sorted(KEYS)}", "unknown_asset")
    variant = int(number)
    design = BY_CATEGORY[category](VariantSampler(category, variant))
    mesh, parts, centre = mesh_of(design.solid)
    mass = (design.density or DENSITY[design.material]) * volume(mesh)
    # Units vary between assets, not between runs.
    rng = np.random.default_rng([*category.encode(), variant])
    unit, is_z_up = float(rng.choice(_UNITS)), bool(rng.random() < 0.3)
    top, hollow = (_recentred(space, centre.tolist()) for space in (design.top, design.hollow))
    paint = tuple((_rgb(color or design.color), rows) for color, rows in coats(design.solid).items() if len(rows))
    return EmbeddedAsset(
        key=key,
        material=design.material,
        color_name=design.color,
        captions=design.captions,
        tilts=design.tilts,
        mesh=mesh,
        parts=parts,
        mass=mass,
        unit=unit,
        is_z_up=is_z_up,
        paint=paint,
        top=top,
        hollow=hollow,
        handle=tuple(part - centre for part in design.solid.handle),
    )


_KNOWN = frozenset(KEYS)


def _rgb(color: str) -> str:
    return COLORS.get(color, color)


def _recentred(space: SupportArea | None, centre: list[float]) -> SupportArea | None:
    if space is None:
        return None
    return replace(space, x=space.x - centre[0], y=space.y - centre[1], z=space.z - centre[2])


def unit_cube() -> Mesh:
    """The mesh of the table top and of the sink in the format: a centred cube with edges of length 1."""
    return mesh_of(box(1.0, 1.0, 1.0))[0]
