"""What a reader finds in a source folder: assets before they are converted."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias

from stable_data.errors import Notice
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface import Surface
from stable_data.importers.boundary import Boundary
from stable_data.limits import LIMITS
from stable_data.scene import FloatArray, QuatXyzw, Vec3

Axis: TypeAlias = Literal["", "x", "y", "z", "-x", "-y", "-z"]
"""A direction of a file's frame; empty if it is not known."""


@dataclass(frozen=True, slots=True)
class ReaderOptions:
    """What a user says about a source folder; every reader takes what applies to it.

    Attributes:
        preset: Name of a known layout of folders; empty for none.
        manifest: Path of a CSV or JSONL file with a row for each asset, relative to the folder; empty for none.
        up: The upward axis of files whose format does not say it.
        front: The axis that faces the user, in the file's frame.
        unit_m: Metres for each unit of files whose format does not say it; 0 if not known.
        max_faces: Triangles of an asset beyond which it is refused.
    """

    preset: str = ""
    manifest: str = ""
    up: Axis = ""
    front: Axis = ""
    unit_m: float = 0.0
    max_faces: int = LIMITS.model.max_faces

    @property
    def front_direction(self) -> Vec3 | None:
        """The unit vector of ``front``; None if it is not known."""
        if not self.front:
            return None
        x, y, z = ((-1.0 if self.front.startswith("-") else 1.0) * (name == self.front[-1]) for name in "xyz")
        return x, y, z


@dataclass(frozen=True, slots=True)
class SourceRef:
    """An asset that was found but not read; it is sent to a worker.

    Attributes:
        asset_id: Its identifier in the library: letters, digits, ``_``, ``-`` and ``.``; unique in the folder.
        path: Its main file, relative to the folder, with ``/``.
        files: All its files that are known without a look at their geometry, relative to the folder, ``path`` among them. Their
            contents name its shard.
        entry: What a manifest, a preset or a model file says about it, as plain JSON values; each reader knows its own.
    """

    asset_id: str
    path: str
    files: tuple[str, ...]
    entry: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class GivenInertial:
    """Mass properties that a source states.

    Attributes:
        mass: Kilograms.
        center_of_mass: Metres, in the frame of the asset's surfaces; None if not stated.
        inertia: Inertia tensor about the centre of mass, along the axes of the surfaces, (3, 3), kg m²; None if not stated.
        is_weighed: Whether the source states the mass itself; else it follows from a density that is a default of the format.
    """

    mass: float
    center_of_mass: Vec3 | None = None
    inertia: FloatArray | None = None
    is_weighed: bool = True


@dataclass(frozen=True, slots=True)
class GivenLicence:
    """A licence that a source states.

    Attributes:
        text: The words found, shortened to 1,000 characters.
        where: Where they stand, such as ``manifest``, ``model.config`` or ``LICENSE.txt``.
    """

    text: str
    where: str


@dataclass(frozen=True, slots=True, eq=False)
class SourceAsset:
    """An asset as its source gives it. What a source does not say is None or empty; nothing is guessed here.

    Attributes:
        asset_id: As in its :class:`SourceRef`.
        name: The name in the source, as written: words of a category are taken from it.
        surfaces: What is seen: at least one triangle, z up, transforms of nodes, links and files applied.
        unit_m: Metres for each unit of ``surfaces`` and ``colliders``; None if not known.
        size_m: The size of the box that the source states, z up, metres; None if it states none.
        is_upright: Whether the source says which way is up; else z is a guess.
        front: Direction that faces the user, unit vector in the frame of the surfaces; None if not known.
        colliders: Closed meshes that the source gives as collision shapes, in the frame and unit of the surfaces.
        inertial: Mass properties; None if not stated.
        friction: Sliding, torsional (metres) and rolling (metres) friction, as MuJoCo defines them; None if not stated.
        category: As the source states it.
        description: A sentence about it, as the source states it.
        tags: Further words that the source states.
        author: Who made it.
        url: Where it comes from.
        source_set: The set that it belongs to, such as ``YCB``.
        licences: All licences that the source states, the most specific first.
        num_joints: Joints that can move.
        is_static: Whether the source fixes it to the world, as furniture.
        rest_quats: Rotations of the surfaces that put it into a pose at rest, likeliest first, if the source states them.
        notices: Remarks of the reader, such as a texture that is missing.
    """

    asset_id: str
    name: str
    surfaces: tuple[Surface, ...]
    unit_m: float | None = None
    size_m: Vec3 | None = None
    is_upright: bool = False
    front: Vec3 | None = None
    colliders: tuple[Mesh, ...] = ()
    inertial: GivenInertial | None = None
    friction: Vec3 | None = None
    category: str = ""
    description: str = ""
    tags: tuple[str, ...] = ()
    author: str = ""
    url: str = ""
    source_set: str = ""
    licences: tuple[GivenLicence, ...] = ()
    num_joints: int = 0
    is_static: bool = False
    rest_quats: tuple[QuatXyzw, ...] = ()
    notices: tuple[Notice, ...] = ()


class Reader(Protocol):
    """Reads one kind of source folder."""

    def find(self, root: Boundary, options: ReaderOptions) -> Iterator[SourceRef | Notice]:
        """Lists the assets of a folder in a fixed order, without a look at their geometry; runs in the driver.

        Yields:
            An asset, or a notice about one that cannot be used.

        Raises:
            ConfigError: The options do not fit the folder, or the manifest cannot be read.
        """
        ...

    def read(self, root: Boundary, ref: SourceRef, options: ReaderOptions) -> SourceAsset:
        """Reads one asset; runs in a worker.

        Raises:
            MeshError: The asset cannot be used.
        """
        ...
