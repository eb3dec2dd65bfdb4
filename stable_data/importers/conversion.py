"""What an asset becomes: from the asset of a source to the rows of the tables ``assets``, ``meshes`` and ``textures``."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from stable_data.assets.text_embeddings import TextEncoder
from stable_data.errors import Notice
from stable_data.importers.source import SourceAsset
from stable_data.storage.schemas import Row

PERMISSIVE = (
    *("CC0-1.0", "CC-BY", "MIT", "MIT-0", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "Zlib", "ODC-By-1.0"),
    "Unlicense",
)
"""Licences that are allowed by default: all that ask for the naming of the author at most."""


class Progress(Protocol):
    """Receives the name of the step that runs, so that a failure can name it."""

    step: str


@dataclass(frozen=True, slots=True)
class SetScale:
    """The common unit of a set of assets, whose files do not state one.

    Attributes:
        unit_m: Metres for each unit.
        confidence: Estimated probability that it is right within a factor of 1.5.
        num: Assets that it rests on.
    """

    unit_m: float
    confidence: float
    num: int


@dataclass(frozen=True, slots=True)
class ConversionSettings:
    """Settings that shape the rows of an asset.

    Attributes:
        allowed_licences: Licences whose assets are converted, in any usual spelling; one without a version allows all versions.
        licence: What the user states about assets without a stated licence; empty for nothing.
        decomposes: Whether a mesh that comes without usable convex parts is decomposed.
        num_points: Surface points of an asset.
        max_faces: Triangles of a mesh; larger ones are reduced.
        look_faces: Triangles of a look; larger ones are reduced.
        texture_side: Largest side of an image, pixels.
        set_scale: The common unit of the folder's assets (:func:`stable_data.importers.sizes.set_scale`); None if none was found.
        default_longest_m: Longest side of an asset whose size cannot be estimated, metres; 0 refuses it.
        finds_poses: Whether resting poses are sought by physics where the source states none; otherwise the source's up axis counts.
    """

    allowed_licences: tuple[str, ...] = PERMISSIVE
    licence: str = ""
    decomposes: bool = True
    num_points: int = 1024
    max_faces: int = 100_000
    look_faces: int = 60_000
    texture_side: int = 1024
    set_scale: SetScale | None = None
    default_longest_m: float = 0.0
    finds_poses: bool = True


@dataclass(frozen=True)
class ConversionContext:
    """What is the same for all assets of a worker; made once.

    Attributes:
        encoder: Encodes names and sentences; None: categories are found by words alone, and ``sentence_embedding`` is null.
        categories: Categories of libraries beside the known ones, such as those of ``--assets``.
    """

    encoder: TextEncoder | None = None
    categories: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class ConvertedAsset:
    """The rows of one asset, and remarks about it.

    Attributes:
        asset_row: Its row of ``assets``.
        mesh_row: Its row of ``meshes``.
        textures: Rows of ``textures``, each image once.
        notices: Warnings; the asset can be used.
    """

    asset_row: Row
    mesh_row: Row
    textures: tuple[Row, ...]
    notices: tuple[Notice, ...]


def convert(
    asset: SourceAsset,
    settings: ConversionSettings,
    context: ConversionContext,
    progress: Progress,
    *,
    source_path: str = "",
) -> ConvertedAsset:
    """Converts an asset of a source to rows of a library.

    Args:
        asset: As a reader gives it.
        settings: Settings that shape the rows.
        context: The text encoder and what else is made once.
        progress: Receives the name of each step.
        source_path: Its main file, relative to the source folder, for the column of that name.

    Raises:
        MeshError: It cannot be used; ``code`` says why: ``licence_refused``, ``licence_unknown``, ``licence_conflict``,
            ``articulated``, ``scale_unknown``, ``unit_implausible``, ``mesh_empty``, ``mesh_not_finite``, or one of
            :func:`stable_data.geometry.mesh_repair.repair_mesh` and :func:`stable_data.geometry.convex_decomposition.convex_parts`.
    """
    raise NotImplementedError
