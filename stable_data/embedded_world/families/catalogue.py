"""The catalogue of the embedded world: every asset by category and variant, built once, weighed, named by content."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import MappingProxyType

import numpy as np

from stable_data.assets.annotation import AssetAnnotation
from stable_data.embedded_world.families import FAMILIES
from stable_data.embedded_world.modelling.family import COLORS, DENSITY, AssetFamily, SupportArea, VariantSampler
from stable_data.embedded_world.modelling.solids import box, coats, mesh_of, volume
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.scene import IntArray, QuatXyzw, Vec3

NUM_VARIANTS = 6
"""Assets of each category."""

BY_CATEGORY: Mapping[str, AssetFamily] = MappingProxyType({family.category: family for family in FAMILIES})
"""Every family, by category."""

LICENCE = "Apache-2.0"
"""Of every asset: that of this project, whose code makes it."""

KEYS: tuple[str, ...] = tuple(f"{category}/{n}" for category in BY_CATEGORY for n in range(NUM_VARIANTS))
"""Every asset, as ``category/variant``."""

_UNITS = (1.0, 0.01, 0.001, 0.0254, 0.1, 0.37)  # metres in one unit of a file: files come in all units


@dataclass(frozen=True, eq=False)
class EmbeddedAsset:
    """An asset, ready to be placed.

    Attributes:
        key: ``category/variant``.
        material: A key of ``DENSITY``.
        color_name: A key of ``COLORS``, or ``#rrggbb``.
        captions: Three or more ways to name it, the first the plainest full one.
        tilts: Its usual resting tilts; the first is the most usual.
        mesh: Closed, outward, metres, z up, centred on its box.
        parts: The convex parts whose union it is, in the same frame.
        mass: Kilograms.
        unit: Metres in one unit of its file.
        is_z_up: Its file keeps the mesh z up under a node that turns it, as many exporters do.
        paint: Colours of its faces: (``#rrggbb``, indices).
        top: Where things can stand on it, in the mesh's frame; None where nothing does.
        hollow: Where things can be in it, likewise.
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

    @property
    def category(self) -> str:
        """Its kind."""
        return self.key.split("/")[0]

    @property
    def color(self) -> str:
        """``#rrggbb``."""
        return _rgb(self.color_name)

    @cached_property
    def glb(self) -> bytes:
        """Its file."""
        return write_glb(self.mesh, unit=self.unit, is_z_up=self.is_z_up, paint=self.paint, parts=self.parts)

    @cached_property
    def uid(self) -> str:
        """32 hexadecimal digits, a hash of its file."""
        return hashlib.blake2b(self.glb, digest_size=16).hexdigest()

    @property
    def file_extents(self) -> Vec3:
        """Box of its file's mesh, file units, z up."""
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
    """The asset of that name.

    Args:
        key: ``category/variant``, one of ``KEYS``.

    Raises:
        ConfigError: There is none.
    """
    category, _, number = key.partition("/")
    if key not in _KNOWN:
        raise ConfigError(f"asset {key!r} is not in the catalogue, expected one of {sorted(KEYS)}", "unknown_asset")
    variant = int(number)
    design = BY_CATEGORY[category].design(VariantSampler(category, variant))
    mesh, parts, centre = mesh_of(design.solid)
    mass = (design.density or DENSITY[design.material]) * volume(mesh)
    rng = np.random.default_rng([*category.encode(), variant])
    unit, is_z_up = float(rng.choice(_UNITS)), bool(rng.random() < 0.3)
    top, hollow = (_moved(space, centre.tolist()) for space in (design.top, design.hollow))
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
    )


_KNOWN = frozenset(KEYS)


def _rgb(color: str) -> str:
    return COLORS.get(color, color)


def _moved(space: SupportArea | None, centre: list[float]) -> SupportArea | None:
    if space is None:
        return None
    return replace(space, x=space.x - centre[0], y=space.y - centre[1], z=space.z - centre[2])


def unit_cube() -> Mesh:
    """What the format uses as table top and sink: a cube of edge 1, centred."""
    return mesh_of(box(1.0, 1.0, 1.0))[0]
