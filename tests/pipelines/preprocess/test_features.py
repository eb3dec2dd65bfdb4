"""Point features: one for every use of an asset, of one encoder, the same however the run went."""

import json
import math
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models.point_encoder import PointCloud, Preprocessing, load, save
from models.point_encoder.cloud import MODELNET
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import describe
from pipelines.preprocess.features import FeatureUse, encoder_of, feature_rows, fingerprint_of
from pipelines.preprocess.job import PreprocessJob, preprocess
from pipelines.preprocess.plan import plan_run
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.assets.point_features import PointFeatures, feature_key, read_features
from stable_data.assets.store import AssetStore
from stable_data.embedded_world.modelling.family import LAID
from stable_data.errors import ConfigError
from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.asset_uses import ShapeUse
from stable_data.scene import UPRIGHT
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from tests.models.point_encoder.clouds import tiny_encoder
from tests.pipelines.runs import ROOT, SMALL, content, run_here


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An encoder of random weights."""
    path = tmp_path_factory.mktemp("weights") / "encoder.safetensors"
    save(tiny_encoder(), path)
    return path


@pytest.fixture(scope="module")
def with_features(weights: Path) -> PreprocessSettings:
    return replace(SMALL, features=str(weights), assets_per_shard=1)


@pytest.fixture(scope="module")
def run(tiny: Path, with_features: PreprocessSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over the one scene, features and all."""
    out = tmp_path_factory.mktemp("features") / "out"
    preprocess(str(tiny), str(out), with_features, WorkerPool())
    return out


def test_every_object_with_a_mesh_has_its_feature(tiny: Path, run: Path, weights: Path) -> None:
    folder, encoder = RunFolder(str(run)), load(weights)
    features, store = read_features(folder), AssetStore(MesaTaskDataset(tiny))
    assets = set(folder.table("assets", ["asset_id"])["asset_id"].to_pylist())
    scene = scene_from_row(folder.table("scenes").to_pylist()[0])
    used = [o for o in scene.objects if o.asset_id in assets]
    assert used
    assert features.fingerprint == encoder.fingerprint()
    for o in used:
        assert o.asset_id is not None and o.scale is not None  # noqa: PT018
        found = features.of(o.asset_id, o.scale, o.tilt_quat_xyzw)
        snapped = np.array(aspect_of(aspect_steps(o.scale))) * max(o.scale)
        shape = Shape.from_mesh(store.asset(o.asset_id).mesh, tuple(snapped.tolist()), o.tilt_quat_xyzw)
        wanted = encoder.encode([PointCloud.of_shape(shape, encoder.preprocessing.num_points)])
        assert np.allclose(found, wanted.codes[0], atol=1e-4)  # the scale of all uses is not this one's
        assert np.linalg.norm(found) > 0
        log_extents = features.log_extents[feature_key(o.asset_id, o.scale, o.tilt_quat_xyzw)]
        assert np.abs(log_extents - np.log(o.size)).max() < math.log(1.5)  # metres, at the usual scale
    with pytest.raises(ConfigError, match="no feature at aspect"):
        features.of(used[0].asset_id or "", (1.0, 0.1, 1.0), UPRIGHT)


def test_the_manifest_and_the_report_say_which_encoder(run: Path, weights: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text("utf-8"))
    fingerprint = load(weights).fingerprint()
    assert manifest["encoder"] == fingerprint
    assert manifest["counts"]["features"] == manifest["num_features"] > 0
    assert fingerprint[:8] in (run / "report" / "index.html").read_text("utf-8")


def test_features_are_added_to_a_run_without(tiny: Path, with_features: PreprocessSettings, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    preprocess(str(tiny), str(out), replace(with_features, features="none"), WorkerPool())
    before = content(out)
    assert not any(name.startswith("features/") for name in before)
    preprocess(str(tiny), str(out), with_features, WorkerPool())
    assert content(out) == content(run)
    assert before.items() <= content(out).items()


def test_what_is_missing_is_made_again(tiny: Path, with_features: PreprocessSettings, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(run, out)
    next(iter(sorted((out / "features").glob("part-*")))).unlink()
    preprocess(str(tiny), str(out), with_features, WorkerPool())
    assert content(out) == content(run)


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_bytes_as_this_process(tiny: Path, run: Path, weights: Path, tmp_path: Path) -> None:
    more = ("--workers", "2", f"--set=features={weights}", "--set=assets_per_shard=1")
    done = run_here(tiny, tmp_path / "ray", *more)
    assert done.exit_code == 0, done.output
    assert content(tmp_path / "ray") == content(run)


def test_another_encoder_is_refused(tiny: Path, with_features: PreprocessSettings, run: Path, tmp_path: Path) -> None:
    torch.manual_seed(1)
    other = tmp_path / "other.safetensors"
    save(tiny_encoder(preprocessing=Preprocessing(num_points=128, grid_size=1 / 5)), other)
    was = fingerprint_of(with_features.features)
    for features, now in ((str(other), fingerprint_of(str(other))), ("none", None)):
        with pytest.raises(ConfigError, match=f"encoder: {was} -> {now}"):
            preprocess(str(tiny), str(run), replace(with_features, features=features), WorkerPool())
    dataset = MesaTaskDataset(tiny)
    shards = [
        {shard.shard_id for shard in plan_run(dataset, with_features, fingerprint).features}
        for fingerprint in (was, fingerprint_of(str(other)), None)
    ]
    assert shards[0]
    assert not shards[0] & shards[1]
    assert not shards[2]


def test_a_worker_refuses_weights_that_are_not_the_plans(weights: Path) -> None:
    with pytest.raises(ConfigError, match="expected abc as on the driver"):
        encoder_of(str(weights), "abc")


def test_where_the_encoder_lies_is_no_setting_that_shapes_rows(
    tiny: Path, with_features: PreprocessSettings, run: Path, weights: Path, tmp_path: Path
) -> None:
    out, moved = tmp_path / "out", tmp_path / "moved.safetensors"
    shutil.copytree(run, out)
    shutil.copy(weights, moved)
    preprocess(str(tiny), str(out), replace(with_features, features=str(moved)), WorkerPool())
    assert content(out) == content(run)


def test_a_feature_does_not_depend_on_the_others(tiny: Path, with_features: PreprocessSettings) -> None:
    store, encoder = AssetStore(MesaTaskDataset(tiny)), load(Path(with_features.features))
    asset_id = next(iter(sorted(tiny.glob("Assets_library/*.glb")))).stem
    shapes = (ShapeUse((0, 0, 0), UPRIGHT, 0.1), ShapeUse((0, 4, 9), UPRIGHT, 0.1), ShapeUse((0, 4, 9), LAID, 0.2))
    rows = feature_rows(FeatureUse(asset_id, "", shapes), store, encoder, ItemProgress("read"))
    backwards = feature_rows(FeatureUse(asset_id, "", shapes[::-1]), store, encoder, ItemProgress("read"))[::-1]
    assert len({row["feature"].tobytes() for row in rows}) == len(shapes)  # aspect and tilt both tell
    for row, other in zip(rows, backwards, strict=True):
        assert row["feature"].tobytes() == other["feature"].tobytes()
        assert row["log_extents"] == other["log_extents"]


def test_an_encoder_that_takes_no_such_cloud_costs_the_feature_not_the_asset(tiny: Path, tmp_path: Path) -> None:
    weights = tmp_path / "fine.safetensors"
    save(tiny_encoder(preprocessing=Preprocessing(num_points=128, normalise="centre", grid_size=1e-7)), weights)
    out = tmp_path / "out"
    manifest = preprocess(str(tiny), str(out), replace(SMALL, features=str(weights)), WorkerPool())
    assert manifest["counts"]["failures_by_code"] == {"cloud_too_large": manifest["counts"]["assets"]}
    assert manifest["counts"]["failures_by_step"] == {"features": manifest["counts"]["assets"]}
    assert manifest["counts"]["failed_assets"] == manifest["counts"]["features"] == 0


def test_a_dataset_without_meshes_has_an_empty_table(bare: Path, with_features: PreprocessSettings, tmp_path: Path) -> None:
    for _ in range(2):
        assert preprocess(str(bare), str(tmp_path), with_features, WorkerPool())["counts"]["features"] == 0
    with pytest.raises(ConfigError, match="contains no features"):
        read_features(RunFolder(str(tmp_path)))


def test_published_weights_are_named_with_what_they_were_trained_on(tmp_path: Path) -> None:
    encoder = tiny_encoder(preprocessing=MODELNET)
    torch.save({f"module.backbone.{k}": v for k, v in encoder.backbone.state_dict().items()}, tmp_path / "published.pth")
    found = fingerprint_of(f"modelnet:{tmp_path / 'published.pth'}")
    assert found not in (None, fingerprint_of(f"scannet:{tmp_path / 'published.pth'}"))


@pytest.mark.parametrize(
    ("features", "message"), [("nothing.safetensors", "cannot be read"), ("sonata:nothing.pth", "cannot be read")]
)
def test_an_encoder_that_cannot_be_used_stops_the_run(bare: Path, tmp_path: Path, features: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        preprocess(str(bare), str(tmp_path), replace(SMALL, features=features), WorkerPool())
    with pytest.raises(ConfigError, match=message):
        describe(PreprocessJob(str(bare), replace(SMALL, features=features), WorkerPool()))


def test_without_features_torch_is_not_loaded(bare: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from pipelines.preprocess.job import preprocess; from pipelines.execution.ray_executor import WorkerPool; "
        "from tests.pipelines.runs import SMALL; "
        f"preprocess({str(bare)!r}, {str(tmp_path)!r}, SMALL, WorkerPool(), report=False); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.split() == ["False"], done.stderr


def test_features_of_two_encoders_are_refused(run: Path, tmp_path: Path) -> None:
    rows = RunFolder(str(run)).table("features").to_pylist()
    mixed = RunFolder(str(tmp_path))
    mixed.write_shard("features", "one", rows)
    assert isinstance(read_features(mixed), PointFeatures)
    mixed.write_shard("features", "two", [row | {"encoder_fingerprint": "another"} for row in rows[:1]])
    with pytest.raises(ConfigError, match=r"contains features of the encoders .*another"):
        read_features(mixed)
