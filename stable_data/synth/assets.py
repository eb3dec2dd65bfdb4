"""Assets of the embedded world: built once, weighed, named by content, written as GLB."""

import hashlib
from dataclasses import dataclass
from functools import cache

from stable_data.errors import ConfigError
from stable_data.export.glb import write_glb
from stable_data.mesatask.library import AssetAnnotation
from stable_data.mesh import Mesh
from stable_data.synth.catalogue import CATALOGUE, DENSITY, AssetSpec
from stable_data.synth.solids import box, mesh_of, volume


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """An asset, ready to be placed.

    Attributes:
        uid: 32 hexadecimal digits, a hash of its file.
        spec: How it was made.
        mesh: Closed, outward, metres, z up, centred on its box.
        parts: The convex parts whose union it is, in the same frame.
        mass: Kilograms.
        glb: Its file.
    """

    uid: str
    spec: AssetSpec
    mesh: Mesh
    parts: tuple[Mesh, ...]
    mass: float
    glb: bytes

    @property
    def annotation(self) -> AssetAnnotation:
        """Its entry in Asset_annotation.json."""
        x, y, z = (self.mesh.extents / self.spec.unit).tolist()
        return AssetAnnotation(
            self.uid,
            category=self.spec.category,
            description=self.spec.caption.rstrip(".").lower(),
            caption=self.spec.caption,
            source="synth",
            mass=round(self.mass, 4),
            is_container=self.spec.is_container,
            extents_z_up=(x, y, z),
            raw={"materials": [self.spec.material]},
        )


@cache
def asset(key: str) -> Asset:
    """The asset of that name.

    Args:
        key: ``category/variant``, a key of the catalogue.

    Raises:
        ConfigError: There is none.
    """
    if key not in CATALOGUE:
        raise ConfigError(f"asset {key!r} is not in the catalogue, expected one of {sorted(CATALOGUE)}", "unknown_asset")
    spec = CATALOGUE[key]
    mesh, parts = mesh_of(spec.build())
    glb = write_glb(mesh, unit=spec.unit, is_z_up=spec.is_z_up)
    return Asset(uid_of(glb), spec, mesh, parts, DENSITY[spec.material] * volume(mesh), glb)


def uid_of(glb: bytes) -> str:
    """32 hexadecimal digits that name a file by its content."""
    return hashlib.blake2b(glb, digest_size=16).hexdigest()


def unit_cube() -> Mesh:
    """What the format uses as table top and sink: a cube of edge 1, centred."""
    return mesh_of(box(1.0, 1.0, 1.0))[0]
