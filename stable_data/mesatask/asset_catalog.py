"""The asset library of a folder in the MesaTask-10K format."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.catalog import (
    Asset,
    AssetLibrary,
    RestingTilt,
    add_leaning_tilts,
    as_vec3,
    build_library,
    is_right_angled,
    merge_similar_tilts,
    resting_tilts,
)
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.mesatask.features import FEATURES_FILE, read_text_features
from stable_data.mesatask.library import AssetFolder
from stable_data.rotations import is_upright
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Scene, SceneObject, Vec3

SHOWN_RANGE = 1.25
"""Factor by which an asset may be smaller than the smallest or larger than the largest object that scenes make of it."""


def library_of_folder(
    root: Path,
    name: str | None = None,
    *,
    scenes: Iterable[Scene] = (),
    keeps_sizes: bool = False,
    own_features: bool = False,
) -> AssetLibrary:
    """Makes the asset library of a folder from Asset_annotation.json, and from the GLB files of assets without an annotated box.

    Args:
        root: A folder in the MesaTask-10K format.
        name: Name of the library; by default the folder's name.
        scenes: Scenes that show how the assets rest. An asset that is in none of them rests in the orientation of its mesh.
        keeps_sizes: Whether an asset of the scenes may only be :data:`SHOWN_RANGE` smaller or larger than in them.
        own_features: Use sbert_text_features.pkl. Otherwise call :meth:`AssetLibrary.embedded`.

    Raises:
        ConfigError: The folder is missing or has no usable asset, or its features cannot be read.
    """
    if not root.is_dir():
        raise ConfigError(f"{root} is not a folder; expected one in the MesaTask-10K format", "root_missing")
    folder = AssetFolder(root)
    features = dict(zip(*read_text_features(root / FEATURES_FILE), strict=True)) if own_features else None
    shown = _shown(scenes)
    assets, left_out = list[Asset](), dict[str, str]()
    for uid in folder.asset_ids:
        annotation, tilts = folder.annotation(uid), merge_similar_tilts(list(_tilts_of(shown.get(uid, ())).items()))
        extents, vertices = annotation.extents_z_up, None
        if extents is None:
            vertices = _mesh_vertices(folder, uid)
            extents = None if vertices is None else as_vec3(np.ptp(vertices, axis=0))
        tilts = tilts if extents is None else add_leaning_tilts(tilts, extents)
        # A tilt by right angles only permutes the extents; any other tilt needs the mesh.
        if vertices is None and any(not is_right_angled(quat) for quat, _ in tilts):
            vertices = _mesh_vertices(folder, uid)
        if extents is None:
            left_out[uid] = "without an annotated box or a readable mesh"
        else:
            asset = _annotated(annotation, uid, extents, resting_tilts(tilts, extents, vertices))
            assets.append(
                replace(asset, size_range=_size_range(shown[uid], extents)) if keeps_sizes and uid in shown else asset
            )
    return build_library(name or root.name, assets, features, left_out)


def _annotated(annotation: AssetAnnotation, uid: str, extents: Vec3, tilts: tuple[RestingTilt, ...]) -> Asset:
    return Asset(
        uid,
        annotation.category,
        annotation.description,
        extents,
        tilts,
        caption=annotation.caption,
        licence=annotation.licence,
        source=annotation.source,
        on_table=annotation.on_table,
        mark_deletion=annotation.mark_deletion,
        is_composite=annotation.is_composite,
        is_container=annotation.is_container,
    )


def _shown(scenes: Iterable[Scene]) -> dict[str, list[SceneObject]]:
    """The objects of scenes by asset."""
    found: dict[str, list[SceneObject]] = {}
    for scene in scenes:
        for o in scene.objects:
            if o.asset_id is not None:
                found.setdefault(o.asset_id, []).append(o)
    return found


def _tilts_of(objects: Iterable[SceneObject]) -> Counter[QuatXyzw]:
    """Counts the tilts of objects."""
    return Counter(UPRIGHT if is_upright(o.tilt_quat_xyzw) else o.tilt_quat_xyzw for o in objects)


def _size_range(objects: Iterable[SceneObject], extents: Vec3) -> tuple[float, float] | None:
    """The range of the longest side of an asset, metres; None if no object states its scale."""
    scales = [o.scale for o in objects if o.scale is not None]
    lengths = [max(s * e for s, e in zip(scale, extents, strict=True)) for scale in scales]
    return (min(lengths) / SHOWN_RANGE, max(lengths) * SHOWN_RANGE) if lengths else None


def _mesh_vertices(folder: AssetFolder, asset_id: str) -> FloatArray | None:
    """Vertices of an asset's mesh, or None if it has no readable mesh."""
    path = folder.path(asset_id)
    try:
        return None if path is None else load_glb(path, asset_id)[0].vertices
    except MeshError:
        return None
