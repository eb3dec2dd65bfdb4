"""The rows of one asset: repaired mesh, mass properties, surface points, convex parts and signed-distance grids."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from pipelines.execution.item_progress import ItemProgress
from stable_data.assets.asset_rows import file_columns, part_columns, shape_columns, volume_columns
from stable_data.assets.looks import LookRows, look_rows, texture_rows
from stable_data.assets.store import AssetMesh, AssetStore
from stable_data.errors import Notice
from stable_data.geometry.mesh_colors import Paint
from stable_data.geometry.sdf.aspects import aspect_of
from stable_data.geometry.sdf.second_opinion import (
    SdfBackend,
    SecondOpinion,
    build_grid_by_pysdf,
    has_pysdf,
    second_opinion,
)
from stable_data.mesatask import AssetAnnotation
from stable_data.scene import QuatXyzw, Vec3
from stable_data.storage import schemas

TextFeature: TypeAlias = npt.NDArray[np.float32]
"""An asset's row of the library's text features, (D,) float32."""


_IN_REGISTER = 1e-5  # of the largest extent: by which the boxes of a mesh and of its look may differ


@dataclass(frozen=True, slots=True)
class AssetUse:
    """How the scenes of a dataset use an asset.

    Attributes:
        asset_id: The asset.
        mesh_sha256: Hash of its mesh file.
        typical_scale: Median scale, metres per mesh unit, or None if no scene uses it.
        aspects: Aspects that get a grid, in steps of 5 % (``stable_data.geometry.sdf.aspects.aspect_steps``).
        tilts: Tilts with their counts, most frequent first.
    """

    asset_id: str
    mesh_sha256: str
    typical_scale: Vec3 | None
    aspects: tuple[tuple[int, int, int], ...]
    tilts: tuple[tuple[QuatXyzw, int], ...]


@dataclass(frozen=True, slots=True)
class AssetSettings:
    """Settings that shape the rows of an asset.

    Attributes:
        num_points: Surface points of an asset.
        sdf_backend: What computes the grids.
        decomposes: Whether a mesh that comes without convex parts is decomposed; otherwise its row has no parts, and whoever needs
            them computes them.
    """

    num_points: int = 1024
    sdf_backend: SdfBackend = "exact"
    decomposes: bool = True


@dataclass(frozen=True, slots=True)
class AssetRows:
    """The rows of one asset, by table."""

    asset: schemas.Row
    mesh: schemas.Row
    grids: tuple[schemas.Row, ...]
    textures: tuple[schemas.Row, ...]
    notices: tuple[Notice, ...]


def preprocess_asset(
    use: AssetUse,
    annotation: AssetAnnotation,
    store: AssetStore,
    settings: AssetSettings,
    progress: ItemProgress,
    embedding: TextFeature | None = None,
) -> AssetRows:
    """Computes all rows of one asset.

    Args:
        use: How the scenes use it.
        annotation: Its annotation in the library.
        store: The store that reads its mesh.
        settings: Settings that shape the rows.
        progress: Receives the name of each step.
        embedding: Its row of the library's text features.

    Raises:
        MeshError: The mesh cannot be used.
    """
    progress.step = "mesh"
    asset = store.asset(use.asset_id)
    progress.step = "sdf"
    grids = tuple(_grid_row(use.asset_id, steps, store, settings.sdf_backend) for steps in use.aspects)
    notices = asset.notices + tuple(notice for row in grids if (notice := _disagreement(row)) is not None)
    progress.step = "points"
    row = _asset_row(use, annotation, asset, settings, embedding)
    progress.step = "parts"
    paint, odd = store.paint(use.asset_id)
    mesh = _mesh_row(use.asset_id, asset, store, paint, decomposes=settings.decomposes)
    progress.step = "look"
    look = _look(use.asset_id, asset, store)
    if look.glb is not None:
        mesh |= {"look": look.glb, "look_distance": look.distance}
    return AssetRows(row, mesh, grids, tuple(texture_rows(look.textures)), notices + odd + look.notices)


def _look(asset_id: str, asset: AssetMesh, store: AssetStore) -> LookRows:
    """The look of an asset, from its file; none if the file cannot be read, as the notices of its colours say."""
    surfaces = store.surfaces(asset_id)
    if not surfaces:
        return LookRows(None)
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in surfaces])
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not np.allclose(high - low, asset.mesh.extents, rtol=0.0, atol=_IN_REGISTER * float(asset.mesh.extents.max())):
        return LookRows(None)  # faces at the border of the box were dropped, so that its centre is not that of the file
    return look_rows(surfaces, (low + high) / 2, asset_id=asset_id, mesh=asset.mesh)


def _asset_row(
    use: AssetUse, annotation: AssetAnnotation, asset: AssetMesh, settings: AssetSettings, embedding: TextFeature | None
) -> schemas.Row:
    return dict.fromkeys(schemas.SCHEMAS["assets"].names) | {
        "asset_id": use.asset_id,
        "category": annotation.category,
        "description": annotation.description,
        "caption": annotation.caption,
        "licence": annotation.licence,
        "source": annotation.source,
        "is_container": annotation.is_container,
        "on_table": annotation.on_table,
        "mark_deletion": annotation.mark_deletion,
        "is_composite": annotation.is_composite,
        "mass": annotation.mass,
        **use_columns(use, asset),
        **shape_columns(use.asset_id, asset.mesh, asset.report, settings.num_points),
        "text_embedding": embedding,
        "mesh_sha256": use.mesh_sha256,
    }


def use_columns(use: AssetUse, asset: AssetMesh) -> schemas.Row:
    """The columns of the table ``assets`` that say how the scenes use an asset, and what it is at its usual scale."""
    found: schemas.Row = {
        "typical_scale": use.typical_scale,
        "resting_tilts": [{"tilt_quat_xyzw": tilt, "count": count} for tilt, count in use.tilts],
        "volume": None,
        "center_of_mass": None,
        "inertia_per_mass": None,
    }
    if use.typical_scale is None:
        return found
    return found | volume_columns(asset.mesh, asset.report, use.typical_scale)


def _mesh_row(asset_id: str, asset: AssetMesh, store: AssetStore, paint: Paint, *, decomposes: bool) -> schemas.Row:
    row = dict.fromkeys(schemas.SCHEMAS["meshes"].names) | file_columns(asset_id, asset.mesh, paint)
    kept = store.stored_parts(asset_id)
    given = kept or store.colliders(asset_id)
    return row | part_columns(asset.mesh, given=given, kept=bool(kept)) if given or decomposes else row


def _grid_row(asset_id: str, steps: tuple[int, int, int], store: AssetStore, backend: SdfBackend) -> schemas.Row:
    aspect, asset = aspect_of(steps), store.asset(asset_id)
    is_exact, is_sheet = backend == "exact", asset.report.is_sheet
    grid = store.grid(asset_id, aspect) if is_exact else build_grid_by_pysdf(asset.mesh, aspect, is_sheet=is_sheet)
    # A sheet has no inside on which opinions could agree; grids of pysdf itself get no second opinion either.
    opinion = second_opinion(grid, asset.mesh, aspect) if has_pysdf() and is_exact and not is_sheet else None
    return {
        "asset_id": asset_id,
        "aspect": aspect,
        "values": grid.values.ravel(),
        "shape": grid.values.shape,
        "origin": grid.origin.tolist(),
        "spacing": grid.spacing,
        "extent": grid.extent,
        "shell_thickness": grid.shell_thickness,
        "wall_thickness": grid.wall_thickness,
        "mean_error": grid.mean_error,
        "max_error": grid.max_error,
        "far_error": grid.far_error,
        "sign_error": grid.sign_error,
        "sdf_agreement": None if opinion is None else opinion.agreement,
        "sign_disagreement": None if opinion is None else opinion.sign_disagreement,
    }


def _disagreement(row: schemas.Row) -> Notice | None:
    """The warning that a grid and pysdf disagree, if they do."""
    if row["sdf_agreement"] is None:
        return None
    opinion = SecondOpinion(row["sdf_agreement"], row["sign_disagreement"])
    if not opinion.disagrees:
        return None
    agreement, wrong = 100 * opinion.agreement, 100 * (opinion.sign_disagreement or 0.0)
    message = (
        f"asset {row['asset_id']}: pysdf agrees with {agreement:.1f} % of the distances of its grid, and disagrees with {wrong:.1f} % of "
        "the signs, expected at least 99 and at most 1 %; check whether the mesh is closed"
    )
    return Notice(row["asset_id"], "sdf", "sdf_disagrees", message)
