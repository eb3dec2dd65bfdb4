"""The point features of one asset, at every aspect and tilt in which the scenes use it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.execution.item_progress import ItemProgress
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.sdf.aspects import aspect_of
from stable_data.geometry.shape import Shape
from stable_data.mesatask.asset_uses import ShapeUse
from stable_data.storage import schemas

if TYPE_CHECKING:  # torch is loaded only if features are computed
    from models.point_encoder import PointEncoder

AUTO, NONE = "auto", "none"


@dataclass(frozen=True, slots=True)
class FeatureUse:
    """An asset and the shapes whose features are computed.

    Attributes:
        asset_id: The asset.
        mesh_sha256: Hash of its mesh file.
        shapes: The shapes, at least one.
    """

    asset_id: str
    mesh_sha256: str
    shapes: tuple[ShapeUse, ...]


def feature_rows(use: FeatureUse, store: AssetStore, encoder: PointEncoder, progress: ItemProgress) -> list[schemas.Row]:
    """Computes the features of an asset, one row for each shape.

    Args:
        use: How the scenes use it.
        store: The store that reads its mesh.
        encoder: The point encoder.
        progress: Receives the name of each step.

    Returns:
        The rows; none if the mesh cannot be used, because the step of assets reports that failure.

    Raises:
        MeshError: A shape has no point cloud that the encoder accepts.
    """
    from models.point_encoder import PointCloud

    progress.step = "features"
    try:
        mesh = store.asset(use.asset_id).mesh
    except MeshError:
        return []
    clouds = []
    for shape_use in use.shapes:
        x, y, z = (shape_use.scale * a for a in aspect_of(shape_use.steps))
        shape = Shape.from_mesh(mesh, (x, y, z), shape_use.tilt_quat_xyzw)
        clouds.append(PointCloud.of_shape(shape, encoder.preprocessing.num_points))
    found = encoder.encode(clouds)
    return [
        {
            "asset_id": use.asset_id,
            "aspect": aspect_of(shape_use.steps),
            "tilt_quat_xyzw": shape_use.tilt_quat_xyzw,
            "feature": code,
            "log_extents": log_extents.tolist(),
            "encoder_fingerprint": found.fingerprint,
        }
        for shape_use, code, log_extents in zip(use.shapes, found.codes, found.log_extents, strict=True)
    ]


def fingerprint_of(setting: str) -> str | None:
    """The fingerprint of the encoder that the setting ``features`` names, or None if no features are computed.

    Raises:
        ConfigError: The encoder cannot be used.
    """
    encoder = encoder_named(setting)
    return None if encoder is None else encoder.fingerprint()


def encoder_of(setting: str, fingerprint: str) -> PointEncoder:
    """The encoder that the setting ``features`` names; each process opens it once.

    Raises:
        ConfigError: The encoder cannot be used, or it differs from the encoder with which the run was planned.
    """
    encoder = encoder_named(setting)
    if encoder is None or encoder.fingerprint() != fingerprint:
        found = "none" if encoder is None else encoder.fingerprint()
        raise ConfigError(
            f"setting preprocess.features is {setting}: this node has encoder {found}, expected {fingerprint} as on the driver; "
            "use a file that every node can read",
            "encoder_differs",
        )
    return encoder


def encoder_named(setting: str) -> PointEncoder | None:
    """The encoder that a setting names: ``auto``, ``none``, a file, or ``KIND:FILE`` of published weights.

    Raises:
        ConfigError: The encoder cannot be used.
    """
    if setting == NONE:
        return None
    try:
        from models.point_encoder import DEFAULT_WEIGHTS, PUBLISHED
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"setting preprocess.features is {setting}, but {error.name} is not installed; install it or set features=none",
            "encoder_missing",
        ) from error
    kind, colon, file = setting.partition(":")
    kind = kind if colon and kind in PUBLISHED else ""
    path = DEFAULT_WEIGHTS if setting == AUTO else Path(file if kind else setting)
    if setting == AUTO and not path.is_file():
        return None
    try:
        changed = path.stat().st_mtime_ns
    except OSError as error:
        message = (
            f"setting preprocess.features is {setting}: {path} cannot be read ({error.strerror}), expected an encoder's weights"
        )
        raise ConfigError(message, "weights_invalid") from error
    return _load_encoder(path, kind, changed)


@lru_cache(maxsize=1)
def _load_encoder(path: Path, kind: str, changed: int) -> PointEncoder:
    """Loads an encoder; ``changed`` is part of the cache key, so that a replaced file is loaded again."""
    import torch

    from models.point_encoder import PUBLISHED, load, load_published

    device = "cuda" if torch.cuda.is_available() else "cpu"
    if not kind:
        return load(path).to(device)
    encoder = load_published(path, PUBLISHED[kind]).to(device)
    if encoder.needs_projection:
        raise ConfigError(
            f"{path} gives {encoder.config.out_channels} channels, expected 64; fit a projection on the shapes of a run with "
            "`python -m pipelines fit-encoder`, and use the file that it writes",
            "encoder_unprojected",
        )
    return encoder
