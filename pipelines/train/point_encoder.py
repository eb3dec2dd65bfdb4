"""Encoders of a run's point features: fits a projection to published weights, and finds the encoder that made a run's features."""

from pathlib import Path

from tqdm import tqdm

from models.physics_corrector.scene_reading import ENCODER_FILE
from models.point_encoder import PUBLISHED, PointCloud, PointEncoder, load_published, save
from pipelines.preprocess.features import AUTO, NONE, encoder_named
from stable_data.assets.point_features import FeatureKey, feature_key
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import SceneObject
from stable_data.storage.manifest import read_manifest
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SCENE_LEAVES, scenes_from_table

_MOST_SHAPES = 1000


def fit_encoder(uri: str, weights: str, out: Path, cache: Path, device: str = "cpu") -> str:
    """Reads published weights, fits their projection to 64 channels on the shapes of a run, and writes an encoder.

    Args:
        uri: A preprocess run, with the meshes that are to be encoded.
        weights: ``KIND:FILE``, KIND of ``scannet``, ``modelnet`` and ``sonata``: the file and the preprocessing of its training.
        out: The file to write.
        cache: Folder for the run's meshes.
        device: Device of the encoder.

    Returns:
        One line on what was done.

    Raises:
        ConfigError: The weights cannot be read (``weights_invalid`` and others), the run has no shapes (``set_empty``), or too few
            (``encoder_rank``).
    """
    kind, _, file = weights.partition(":")
    if kind not in PUBLISHED or not file:
        raise ConfigError(f"--weights is {weights}, expected KIND:FILE with KIND of {', '.join(PUBLISHED)}", "weights_invalid")
    encoder = load_published(Path(file).expanduser(), PUBLISHED[kind])
    if not encoder.needs_projection:
        save(encoder, out)
        return f"{out}: the weights give 64 channels, no projection is needed"
    encoder.to(device)
    clouds = list(_clouds(uri, cache, encoder))
    if not clouds:
        raise ConfigError(f"{uri}: no object with a mesh in its scenes, expected shapes to fit the projection on", "set_empty")
    encoder.fit_projection(clouds)
    save(encoder, out)
    return f"{out}: projection of {encoder.config.out_channels} channels to 64, fitted on {len(clouds)} shapes"


def _clouds(uri: str, cache: Path, encoder: PointEncoder) -> list[PointCloud]:
    """Clouds of at most 1,000 shapes of a run's scenes, evenly spread over its assets."""
    run = RunFolder(uri)
    table = TableFiles(uri, "scenes", list(SCENE_LEAVES))
    shapes = dict[FeatureKey, SceneObject]()
    for group in range(len(table.groups)):
        for scene in scenes_from_table(table.read([group])):
            for o in scene.objects:
                if o.asset_id is not None and o.scale is not None:
                    shapes.setdefault(feature_key(o.asset_id, o.scale, o.tilt_quat_xyzw), o)
    chosen = [shapes[key] for key in sorted(shapes)]
    store, clouds = AssetStore(RunAssets(run, cache)), []
    for o in tqdm(chosen[:: max(1, -(-len(chosen) // _MOST_SHAPES))], desc="shapes", unit="shape", leave=False):
        assert o.asset_id is not None
        assert o.scale is not None
        try:
            shape = Shape.from_mesh(store.asset(o.asset_id).mesh, o.scale, o.tilt_quat_xyzw)
            clouds.append(PointCloud.of_shape(shape, encoder.preprocessing.num_points))
        except MeshError:
            continue
    return clouds


def encoder_of_features(uri: str, fingerprint: str, named: str) -> PointEncoder:
    """Finds the encoder that made a run's features.

    Args:
        uri: The run.
        fingerprint: Fingerprint of the encoder, from its table ``features``.
        named: An encoder as in ``preprocess.features``; ``auto`` tries the one that the run's settings name, then the default.

    Raises:
        ConfigError: None of them made the features (``encoder_missing``).
    """
    tried = [named] if named != AUTO else [_setting_of(uri), AUTO]
    for setting in tried:
        if setting == NONE:
            continue
        try:
            encoder = encoder_named(setting)
        except ConfigError:
            if named != AUTO:
                raise
            continue
        if encoder is not None and encoder.fingerprint() == fingerprint:
            return encoder
    raise ConfigError(
        f"{uri}: its features are of encoder {fingerprint}, which is not {' or '.join(dict.fromkeys(tried))}; name the encoder's file "
        "with --encoder, so that it is saved beside the weights",
        "encoder_missing",
    )


def _setting_of(uri: str) -> str:
    """The encoder that a run's manifest names; ``auto`` if it names none."""
    manifest = read_manifest(RunFolder(uri))
    return AUTO if manifest is None else str(manifest["settings"].get("features", AUTO))


def save_beside(encoder: PointEncoder, weights: Path) -> None:
    """Writes an encoder beside the weights of a corrector, where the corrector looks for it."""
    save(encoder, weights.with_name(ENCODER_FILE))
