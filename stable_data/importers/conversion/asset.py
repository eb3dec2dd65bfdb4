"""What an asset becomes: from the asset of a source to the rows of the tables ``assets``, ``meshes`` and ``textures``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from stable_data.assets.asset_rows import file_columns, part_columns, shape_columns, volume_columns
from stable_data.assets.catalog import asset_sentence
from stable_data.assets.looks import look_rows, texture_rows
from stable_data.assets.text_embeddings import TextEncoder, embed_texts
from stable_data.errors import MeshError, Notice
from stable_data.geometry.convex_decomposition import hull_of_mesh, is_true_to
from stable_data.geometry.mesh import Mesh, drop_unused_vertices, signed_volumes
from stable_data.geometry.mesh_colors import Paint, paint_of
from stable_data.geometry.mesh_repair import MeshReport, drop_duplicate_faces, repair_mesh
from stable_data.geometry.reduction import join_triangles, reduce_mesh
from stable_data.geometry.shape_hash import shape_hash
from stable_data.geometry.surface import Surface
from stable_data.importers.conversion.inertials import AssetInertial, inertial_of
from stable_data.importers.conversion.licensing import Licence, judge_licence
from stable_data.importers.conversion.naming import Name, Vocabulary, words_of_name
from stable_data.importers.conversion.resting import StablePose, is_container, resting_poses
from stable_data.importers.conversion.scaling import choose_scale
from stable_data.importers.conversion.sizes import SetScale, SizeTable
from stable_data.importers.source import SourceAsset
from stable_data.instructions.wording.vocabulary import known_names
from stable_data.instructions.wording.words import type_words
from stable_data.scene import FloatArray, Vec3
from stable_data.storage import schemas

PERMISSIVE = (
    *("CC0-1.0", "CC-BY", "MIT", "MIT-0", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "Zlib", "ODC-By-1.0"),
    "Unlicense",
)
"""Licences that are allowed by default: all that ask for the naming of the author at most."""


_GRASPABLE = 0.08  # largest smallest side of what a usual gripper holds, metres
_CONVEX = 1.02  # volume of the hull of a convex collider, relative to its own
_MOST_PAINTED = 2_000_000  # triangles whose colours are looked at; of more, each second, third, … one


class Progress(Protocol):
    """Receives the name of the step that runs, so that a failure can name it."""

    step: str


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
        set_scale: The common unit of the folder's assets (:meth:`ConversionContext.set_scale`); None if there is none.
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
        without_sizes_of: Beginnings of the names of sources whose sizes are not used, to measure on them.
    """

    encoder: TextEncoder | None = None
    categories: Sequence[str] = ()
    without_sizes_of: Sequence[str] = ()

    @cached_property
    def sizes(self) -> SizeTable:
        """Sizes of categories."""
        return SizeTable(self.encoder, self.without_sizes_of)

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Categories that a name may mean: those with sizes, those that instructions know, and those of the libraries."""
        names = (name.replace(" ", "_") for name in known_names())
        return Vocabulary((*self.sizes.sizes, *names, *self.categories), self.encoder)

    def set_scale(self, assets: Sequence[tuple[SourceAsset, Sequence[float]]]) -> SetScale | None:
        """Estimates the common unit of assets whose files do not state one.

        A kit has one unit, and its own proportions count more than those of real things: lids go on pots.

        Args:
            assets: Assets, whose surfaces are not used, and the extents of their boxes in units of the file (:func:`extents_of`).
        """
        return self.sizes.set_scale(
            (self.vocabulary.name(asset).category, extents) for asset, extents in assets if 0 < max(extents) < math.inf
        )


@dataclass(frozen=True, slots=True)
class ConvertedAsset:
    """The rows of one asset, and remarks about it.

    Attributes:
        asset_row: Its row of ``assets``.
        mesh_row: Its row of ``meshes``.
        textures: Rows of ``textures``, each image once.
        notices: Warnings; the asset can be used.
    """

    asset_row: schemas.Row
    mesh_row: schemas.Row
    textures: tuple[schemas.Row, ...]
    notices: tuple[Notice, ...]


def extents_of(surfaces: Sequence[Surface]) -> Vec3:
    """Returns the extents of the box of surfaces, in their unit; zeros without a triangle."""
    soups = [surface.triangles for surface in surfaces if len(surface.triangles)]
    if not soups:
        return (0.0, 0.0, 0.0)
    low, high = (find([find(soup, axis=(0, 1)) for soup in soups], axis=0) for find in (np.min, np.max))
    x, y, z = np.subtract(high, low).tolist()
    return x, y, z


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
        MeshError: It cannot be used; ``code`` says why: ``articulated``, ``licence_refused``, ``licence_unknown``,
            ``licence_conflict``, ``mesh_empty``, ``mesh_not_finite``, ``scale_unknown``, ``unit_implausible``, or one of
            :func:`~stable_data.geometry.mesh_repair.repair_mesh` and
            :func:`~stable_data.geometry.convex_decomposition.convex_parts`.
    """
    progress.step = "licence"
    if asset.num_joints:
        message = f"asset {asset.asset_id}: has {asset.num_joints} movable joints, expected one rigid body; make them fixed in the file"
        raise MeshError(message, "articulated")
    licence, notices = judge_licence(asset.asset_id, asset.licences, settings.licence, settings.allowed_licences)
    notices = (*asset.notices, *notices)

    progress.step = "mesh"
    source, moved = join_triangles([surface.triangles for surface in asset.surfaces], asset.asset_id)

    progress.step = "name"
    name = context.vocabulary.name(asset)
    if name.category_source == "encoder":
        message = f"asset {asset.asset_id}: {name.description!r} is taken as {name.category}, the nearest known category"
        notices += (Notice(asset.asset_id, "name", "category_guessed", f"{message} (cosine {name.likeness:.2f})"),)

    progress.step = "scale"
    scale = choose_scale(
        asset,
        name.category,
        source.extents,
        context.sizes,
        set_scale=settings.set_scale,
        default_longest_m=settings.default_longest_m,
    )
    notices += scale.notices

    progress.step = "mesh"
    made = _made(asset, source, scale.unit_m, moved * scale.unit_m, settings.max_faces)
    notices += made.notices

    progress.step = "parts"
    parts, parts_source = _part_columns(asset, made, decomposes=settings.decomposes)

    progress.step = "inertial"
    # Without a unit the place of a centre of mass in metres has no meaning in the mesh.
    given = asset.inertial
    if given is not None and asset.unit_m is None:
        given = replace(given, center_of_mass=None, inertia=None)
    inertial, odd = inertial_of(
        given,
        made.mesh,
        made.report,
        asset_id=asset.asset_id,
        category=name.category,
        words=(
            *words_of_name(asset.name)[0],
            *type_words(asset.description),
            *(w for tag in asset.tags for w in type_words(tag)),
        ),
        center=made.center,
    )
    notices += odd
    mass = _mass_columns(inertial, made)

    friction, odd = _friction(asset)
    notices += odd

    progress.step = "rest"
    known = context.sizes.find(name.category)
    poses, rest_source = resting_poses(
        made.mesh,
        given=tuple(quat for quat in asset.rest_quats if _unit(quat) is not None),
        is_upright=asset.is_upright,
        vertical=() if known is None else known[0].vertical,
        center_of_mass=np.array(mass["center_of_mass"]),
        searches=settings.finds_poses,
    )

    progress.step = "points"
    file = file_columns(asset.asset_id, made.mesh, made.paint)
    asset_row = dict.fromkeys(schemas.SCHEMAS["assets"].names) | {
        "asset_id": asset.asset_id,
        **_origin_columns(asset, licence, source_path),
        **_name_columns(name, context.encoder),
        **shape_columns(asset.asset_id, made.mesh, made.report, settings.num_points),
        **scale.columns(float(made.mesh.extents.max())),
        **_rest_columns(poses, rest_source, made.mesh),
        **mass,
        "friction": friction,
        "on_table": not asset.is_static,
        "is_static": asset.is_static,
        "mark_deletion": False,
        "is_composite": False,
        "is_graspable": float(made.mesh.extents.min()) <= _GRASPABLE,
        "front": None if asset.front is None else _unit(asset.front),
        "geometry_hash": shape_hash(source),
        "mesh_sha256": file["sha256"],
    }

    progress.step = "look"
    look, textures, odd = _look(asset, made, settings)
    mesh_row = dict.fromkeys(schemas.SCHEMAS["meshes"].names) | {
        **file,
        **parts,
        **look,
        "parts_source": parts_source,
        "source_faces": sum(len(surface.triangles) for surface in asset.surfaces),
        "source_reduction": made.reduction,
    }
    return ConvertedAsset(asset_row, mesh_row, textures, (*notices, *odd))


@dataclass(frozen=True, slots=True, eq=False)
class _MadeMesh:
    """A repaired mesh, metres, centred on its box; the metres for each unit of its source; and that centre in the source, metres."""

    mesh: Mesh
    report: MeshReport
    unit_m: float
    center: FloatArray
    paint: Paint
    reduction: float
    notices: tuple[Notice, ...]


def _made(asset: SourceAsset, source: Mesh, unit_m: float, clustered: float, max_faces: int) -> _MadeMesh:
    """Reduces, repairs, centres and paints a welded mesh; ``clustered`` is the distance, metres, by which it was moved before."""
    notices: tuple[Notice, ...] = ()
    reduced, moved = reduce_mesh(Mesh(source.vertices * unit_m, source.faces), max_faces)
    moved += clustered
    if moved > 0:
        num = sum(len(surface.triangles) for surface in asset.surfaces)
        message = f"asset {asset.asset_id}: its mesh has {num} triangles, expected at most {max_faces}; it was reduced to "
        message += f"{len(reduced.faces)} and moved by up to {1000 * moved:.3g} mm"
        notices += (Notice(asset.asset_id, "mesh", "mesh_reduced", message),)
    # Duplicates are dropped here, so that the repair leaves the box, and with it the centre, as it is.
    vertices, faces = drop_unused_vertices(reduced.vertices, drop_duplicate_faces(reduced.faces))
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    mesh, report, odd = repair_mesh(Mesh(vertices - center, faces), asset.asset_id)
    notices += odd
    if report.is_sheet:
        message = f"asset {asset.asset_id}: its mesh is open ({report.num_boundary_edges} edges of one face); it is used as a thin shell"
        notices += (Notice(asset.asset_id, "mesh", "open_sheet", message),)
    try:
        own_unit = Mesh(mesh.vertices / unit_m, mesh.faces)
        paint = paint_of(_thinned(asset.surfaces), asset.asset_id, own_unit, center / unit_m)
    except MeshError as error:
        paint, notices = (), (*notices, Notice(asset.asset_id, "mesh", error.code, str(error)))
    return _MadeMesh(mesh, report, unit_m, center, paint, moved, notices)


def _thinned(surfaces: Sequence[Surface]) -> Sequence[Surface]:
    """Surfaces with so few triangles that their colours can be searched."""
    stride = math.ceil(sum(len(surface.triangles) for surface in surfaces) / _MOST_PAINTED)
    if stride <= 1:
        return surfaces
    return [
        replace(
            surface,
            triangles=surface.triangles[::stride],
            corner_colours=None if surface.corner_colours is None else surface.corner_colours[::stride],
            corner_uv=None if surface.corner_uv is None else surface.corner_uv[::stride],
        )
        for surface in surfaces
    ]


def _part_columns(asset: SourceAsset, made: _MadeMesh, *, decomposes: bool) -> tuple[schemas.Row, str | None]:
    """The columns of convex parts: those of the source if they are convex and follow the mesh, else computed ones."""
    given = [Mesh(each.vertices * made.unit_m - made.center, each.faces) for each in asset.colliders if _is_convex(each)]
    if given and is_true_to(made.mesh, given):
        return part_columns(made.mesh, given=given), "given"
    return (part_columns(made.mesh), "computed") if decomposes else ({}, None)


def _is_convex(collider: Mesh) -> bool:
    if not (len(collider.faces) and np.isfinite(collider.vertices).all() and collider.extents.min() > 0):
        return False
    volume = float(signed_volumes(collider.triangles).sum())
    try:
        return float(signed_volumes(hull_of_mesh(collider).triangles).sum()) <= _CONVEX * abs(volume)
    except MeshError:
        return False


def _origin_columns(asset: SourceAsset, licence: Licence, source_path: str) -> schemas.Row:
    return {
        "source": asset.source_set or asset.url or None,
        "author": asset.author or None,
        "source_url": asset.url or None,
        "source_set": asset.source_set or None,
        "source_path": source_path or None,
        "licence": licence.name,
        "licence_text": licence.text,
        "licence_where": licence.where,
    }


def _name_columns(name: Name, encoder: TextEncoder | None) -> schemas.Row:
    words = name.description or name.category.replace("_", " ")
    embedding = None if encoder is None else embed_texts([asset_sentence(words, name.category)], encoder)[0]
    return {
        "category": name.category,
        "category_source": name.category_source,
        "description": name.description,
        "description_source": name.description_source,
        "caption": "",
        "sentence_embedding": None if embedding is None else embedding.astype(np.float16),
        "sentence_encoder": None if encoder is None else encoder.fingerprint,
    }


def _rest_columns(poses: Sequence[StablePose], rest_source: str, mesh: Mesh) -> schemas.Row:
    return {
        "resting_tilts": [{"tilt_quat_xyzw": pose.quat_xyzw, "count": pose.count} for pose in poses],
        "rest_source": rest_source,
        "is_container": is_container(mesh, poses[0].quat_xyzw),
    }


def _mass_columns(inertial: AssetInertial, made: _MadeMesh) -> schemas.Row:
    """The columns of mass; where the source states no centre of mass or inertia, those of the homogeneous mesh."""
    homogeneous = volume_columns(made.mesh, made.report, (1.0, 1.0, 1.0))
    com, inertia = inertial.center_of_mass, inertial.inertia
    return homogeneous | {
        "mass": inertial.mass,
        "mass_source": inertial.mass_source,
        "material": inertial.material,
        **({} if com is None else {"center_of_mass": com.tolist()}),
        **({} if inertia is None else {"inertia_per_mass": (inertia / inertial.mass).ravel().tolist()}),
        "inertia": None if inertia is None else inertia.ravel().tolist(),
    }


def _friction(asset: SourceAsset) -> tuple[list[float] | None, tuple[Notice, ...]]:
    if asset.friction is None or all(0 <= value < math.inf for value in asset.friction):
        return None if asset.friction is None else list(asset.friction), ()
    message = (
        f"asset {asset.asset_id}: friction is {asset.friction}, expected finite values of at least 0; the usual one is used"
    )
    return None, (Notice(asset.asset_id, "inertial", "friction_invalid", message),)


def _unit(values: Sequence[float]) -> list[float] | None:
    """A vector or quaternion of unit length; None if it has no direction."""
    vector = np.asarray(values, np.float64)
    length = float(np.linalg.norm(vector))
    return (vector / length).tolist() if 1e-9 < length < math.inf else None


def _look(
    asset: SourceAsset, made: _MadeMesh, settings: ConversionSettings
) -> tuple[schemas.Row, tuple[schemas.Row, ...], tuple[Notice, ...]]:
    """The columns of the look, and the rows of its textures."""
    surfaces = [replace(surface, triangles=surface.triangles * made.unit_m) for surface in asset.surfaces]
    found = look_rows(
        surfaces,
        made.center,
        texture_side=settings.texture_side,
        max_faces=settings.look_faces,
        asset_id=asset.asset_id,
        mesh=made.mesh,
    )
    columns = {"look": found.glb, "look_distance": None if found.glb is None else found.distance}
    return columns, tuple(texture_rows(found.textures)), found.notices
