"""What the content of a mesh file says, and how a format's reader asks for the files beside it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np

from stable_data.errors import MeshError, StableDataError
from stable_data.geometry.surface import Surface
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray, IntArray

FileAxis: TypeAlias = Literal["", "x", "y", "z"]


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """The content of a mesh file.

    Attributes:
        surfaces: Its triangles with their looks. Unlike those of a :class:`~stable_data.importers.source.SourceAsset` they are in
            the axes and the unit of the file, nothing turned; transforms of the file's own nodes are applied.
        unit_m: Metres for each unit, if the file states it (COLLADA); glTF demands metres and files do not keep to it, so None.
        up: The upward axis of the file: as it states it (COLLADA) or its format demands it (glTF: y); empty if neither does.
        licence: Licence that the file states.
        copyright: Line of copyright that the file states; it may name an author, a licence or both.
        author: Author that the file states.
        names: For each surface the names under which a model may ask for it alone; empty where the format has none.
    """

    surfaces: tuple[Surface, ...]
    unit_m: float | None = None
    up: FileAxis = ""
    licence: str = ""
    copyright: str = ""
    author: str = ""
    names: tuple[frozenset[str], ...] = ()


class Companions(Protocol):
    """The files beside a mesh file."""

    def image(self, reference: str) -> bytes | None:
        """Returns the content of a texture; None without a reference, and if it is missing or refused, which is noted."""
        ...

    def material_library(self, reference: str) -> bytes | None:
        """Returns the content of the files of materials that a line names; without what was returned before.

        None if nothing is left, or all are missing or refused, which is noted.
        """
        ...

    def note_lost_look(self, reason: str) -> None:
        """Notes that the materials of the file are broken."""
        ...

    def part(self, reference: str) -> bytes:
        """Returns the content of a file without which there is no mesh.

        Raises:
            MeshError: It is missing or refused.
        """
        ...


@contextmanager
def parsing(path: str, expected: str) -> Iterator[None]:
    """Turns every exception of a parser into a MeshError.

    Args:
        path: The file, for the message.
        expected: What it should be, for the message.

    Raises:
        MeshError: ``model_unreadable``.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (StableDataError, MemoryError):
        raise
    except Exception as error:  # each library has exceptions of its own, and lets those of numpy through
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise MeshError(
            f"{path}: cannot be parsed ({reason:.200}), expected {expected}; export it again", "model_unreadable"
        ) from error


def check_face_count(path: str, count: int, most: int) -> None:
    """Refuses a file that describes too many triangles, before memory for them is allocated.

    Raises:
        MeshError: ``mesh_too_large``.
    """
    if count > most:
        raise MeshError(f"{path}: has {count:,} triangles, expected {faces_allowed(most)}; simplify it", "mesh_too_large")


def faces_allowed(most: int) -> str:
    """Says how many triangles a file may have, with the name of the limit if it is that of all files."""
    return at_most(LIMITS.model, "max_faces") if most == LIMITS.model.max_faces else f"at most {most:,}"


def fan(counts: IntArray) -> IntArray:
    """Divides polygons into triangles around their first corner.

    Args:
        counts: Number of corners of each polygon, (P,); those with fewer than 3 have no triangle.

    Returns:
        Rows of three positions in the list of all corners, (T, 3), in the order of the polygons.
    """
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    first = np.repeat(starts, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def taken(values: FloatArray, indices: IntArray, path: str, what: str) -> FloatArray:
    """Returns rows of an array by their indices.

    Raises:
        MeshError: ``model_unreadable``: an index is outside of the array; a negative one would count from the end.
    """
    if len(indices) and (int(indices.min()) < 0 or int(indices.max()) >= len(values)):
        found = f"a face refers to {what} {int(indices.max()) if int(indices.min()) >= 0 else int(indices.min())}"
        raise MeshError(f"{path}: {found}, the file has {len(values)}; export it again", "model_unreadable")
    return values[indices]
