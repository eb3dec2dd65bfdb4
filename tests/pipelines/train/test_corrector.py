import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from typer.testing import CliRunner

from models.physics_corrector.flow.checkpoint import load_corrector
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.learned_flow import load_flow
from models.physics_corrector.training.settings import CorrectorTrainingSettings
from models.physics_corrector.training.sources import TrainingScenes
from models.point_encoder import load as load_encoder
from models.point_encoder import save as save_encoder
from pipelines.__main__ import app
from pipelines.train.corrector import CorrectorTrainingJob
from pipelines.train.layouts import LayoutMonitoring
from pipelines.train.run import STATE
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from tests.models.physics_corrector.training.training_scenes import TINY
from tests.models.point_encoder.clouds import tiny_encoder

SETTINGS = replace(TINY, steps=4, batch_size=4, chunk=2, num_surface=64, num_bottom=16)
WATCH = LayoutMonitoring(log_every=2, card_every=2, card_scenes=1, final_scenes=2, exact_scenes=1)


@pytest.fixture(scope="module")
def cache(clean_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a training computes of the run first."""
    root = tmp_path_factory.mktemp("cache")
    TrainingScenes((str(clean_run),), root / "cache", 64, 16).load("box")
    return root


@pytest.fixture
def out(cache: Path, tmp_path: Path) -> Path:
    """A folder in which that is done."""
    return Path(shutil.copytree(cache, tmp_path / "out"))


def job(
    run: Path, out: Path, settings: CorrectorTrainingSettings = SETTINGS, minutes: float = 0.0, encoder: str = "auto"
) -> CorrectorTrainingJob:
    return CorrectorTrainingJob(str(run), out, settings, WATCH, minutes, encoder)


def copied(run: Path, to: Path) -> Path:
    return Path(shutil.copytree(run, to))


def write_features(run: Path, fingerprints: tuple[str, ...] = ("one",), skip: int = 0) -> None:
    folder = RunFolder(str(run))
    rows = []
    for n, asset_id in enumerate(folder.table("assets", ["asset_id"])["asset_id"].to_pylist()[skip:]):
        row = dict.fromkeys(SCHEMAS["features"].names) | {"asset_id": asset_id, "aspect": [1.0, 1.0, 1.0]}
        row |= {"tilt_quat_xyzw": [0.0, 0.0, 0.0, 1.0], "feature": [float(n)] * 64, "log_extents": [0.0, 0.0, 0.0]}
        rows.append(row | {"encoder_fingerprint": fingerprints[n % len(fingerprints)]})
    folder.write_shard("features", "0" * 16, rows)


def test_a_training_leaves_weights_logs_card_and_manifest(clean_run: Path, out: Path) -> None:
    line = job(clean_run, out).run()
    assert "4 of 4 steps" in line
    checkpoint = load_corrector(out / CorrectorTrainingJob.WEIGHTS, SETTINGS.corrector)
    run = TrainingScenes((str(clean_run),), out / "cache", 64, 16)
    assert checkpoint.notes["steps"] == "4"
    assert checkpoint.notes["data_fingerprint"] == run.fingerprint()
    assert json.loads(checkpoint.notes["training"])["seed"] == 0
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    assert (manifest["status"], manifest["steps_done"]) == ("complete", 4)
    targets = manifest["targets"]
    assert targets["scenes"] == 4 == targets["kept"] + sum(v for k, v in targets.items() if k.startswith("left_out"))
    card = json.loads((out / "card.json").read_text("utf-8"))
    log = EventAccumulator(str(out / "logs"))
    log.Reload()
    assert [event.step for event in log.Scalars("loss/flow")] == [2, 4]
    if card["rows"]:  # four scenes need not have one that is held out
        assert "card/pile/grid_oc/raw" in log.Tags()["scalars"]


def test_stopped_and_run_again_it_gives_the_bytes_of_one_run(clean_run: Path, out: Path, tmp_path: Path, cache: Path) -> None:
    other = copied(cache, tmp_path / "other")
    job(clean_run, other).run()
    stopped = job(clean_run, out, minutes=1e-9).run()
    assert "1 of 4 steps" in stopped
    assert not (out / "card.json").exists()
    assert json.loads((out / "manifest.json").read_text("utf-8"))["status"] == "stopped"
    assert "4 of 4 steps" in job(clean_run, out).run()
    assert (out / CorrectorTrainingJob.WEIGHTS).read_bytes() == (other / CorrectorTrainingJob.WEIGHTS).read_bytes()
    before = (out / CorrectorTrainingJob.WEIGHTS).read_bytes()
    job(clean_run, out).run()  # done already
    assert (out / CorrectorTrainingJob.WEIGHTS).read_bytes() == before


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.*")  # of Ray about itself
@pytest.mark.parametrize("workers", [1, 2])
def test_ray_gives_what_this_process_gives(clean_run: Path, out: Path, tmp_path: Path, cache: Path, workers: int) -> None:
    other = copied(cache, tmp_path / "other")
    job(clean_run, other).run()
    job(clean_run, out).run(workers)
    if workers == 1:
        assert (out / CorrectorTrainingJob.WEIGHTS).read_bytes() == (other / CorrectorTrainingJob.WEIGHTS).read_bytes()
    here, there = (load_corrector(folder / CorrectorTrainingJob.WEIGHTS).network.state_dict() for folder in (other, out))
    assert all(here[name].allclose(value, atol=1e-3) for name, value in there.items())


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.*")  # of Ray about itself
def test_what_a_process_of_ray_says_is_said(clean_run: Path, out: Path) -> None:
    (out / STATE).parent.mkdir()
    (out / STATE).write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="cannot be read as a checkpoint"):
        job(clean_run, out).run(1)


def test_other_settings_are_refused_and_named(clean_run: Path, out: Path) -> None:
    job(clean_run, out, minutes=1e-9).run()
    other = replace(SETTINGS, physics=replace(SETTINGS.physics, share=0.5))
    with pytest.raises(ConfigError, match=r"physics.share: 0.25 -> 0.5"):
        job(clean_run, out, other).run()


@pytest.mark.parametrize("table", ["sdf", "meshes", "scenes"])
def test_a_run_that_lacks_a_table_is_refused(clean_run: Path, tmp_path: Path, table: str) -> None:
    run = copied(clean_run, tmp_path / "run")
    shutil.rmtree(run / table)
    with pytest.raises(ConfigError, match=f"no table {table}"):
        job(run, tmp_path / "out").run()


def test_a_run_without_a_clean_scene_is_refused(bare_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no clean scene"):
        job(bare_run, tmp_path / "out").run()


def test_point_features_are_read_and_their_encoder_is_noted(clean_run: Path, cache: Path, tmp_path: Path) -> None:
    run = copied(clean_run, tmp_path / "run")
    point = replace(
        SETTINGS,
        features="point",
        corrector=CorrectorSettings(replace(SETTINGS.corrector.network, num_features=64), SETTINGS.corrector.flow),
    )
    with pytest.raises(ConfigError, match="no table features"):
        job(run, copied(cache, tmp_path / "none"), point).run()
    encoder, file = tiny_encoder(), tmp_path / "encoder.safetensors"
    save_encoder(encoder, file)
    write_features(run, (encoder.fingerprint(),))
    out = copied(cache, tmp_path / "out")
    with pytest.raises(ConfigError, match="name the encoder's file with --encoder"):
        job(run, out, point).run()
    job(run, out, point, encoder=str(file)).run()
    weights = out / CorrectorTrainingJob.WEIGHTS
    assert load_corrector(weights).notes["encoder_fingerprint"] == encoder.fingerprint()
    assert load_encoder(weights.with_name("point_encoder.safetensors")).fingerprint() == encoder.fingerprint()
    assert load_flow(str(weights)) is not None  # the encoder beside the weights is the one that is used
    write_features(run, ("two",))
    with pytest.raises(ConfigError, match="its features are of encoder two"):
        job(run, out, point, encoder=str(file)).run()
    write_features(run, ("one", "two"))
    with pytest.raises(ConfigError, match="of the encoders one, two"):
        job(run, out, point).run()
    write_features(run, skip=1)
    used = {o.asset_id for scene in TrainingScenes((str(run),), out / "cache").scenes(_scene_ids(run)) for o in scene.objects}
    first = RunFolder(str(run)).table("assets", ["asset_id"])["asset_id"].to_pylist()[0]
    assert first in used
    with pytest.raises(ConfigError, match=f"asset {first} has no features"):
        job(run, copied(cache, tmp_path / "lacking"), point).run()


def _scene_ids(run: Path) -> list[str]:
    found: list[str] = RunFolder(str(run)).table("scenes", ["scene_id"])["scene_id"].to_pylist()
    return found


def test_the_kept_set_is_the_computed_one(clean_run: Path, out: Path, tmp_path: Path) -> None:
    kept = TrainingScenes((str(clean_run),), out / "cache", 64, 16).load("box")
    made = TrainingScenes((str(clean_run),), tmp_path / "new", 64, 16).load("box")
    assert kept.scene_ids == made.scene_ids
    assert kept.counts == made.counts
    for name in ("poses", "mask", "shape_index", "parent", "sizes"):
        assert getattr(kept.batch, name).equal(getattr(made.batch, name))
    for name in ("surface", "bottom", "unit_from_yaw"):
        assert getattr(kept.geometry, name).equal(getattr(made.geometry, name))
    assert kept.geometry.atlas.values.equal(made.geometry.atlas.values)


def test_the_command_shows_its_plan_and_names_mistakes(clean_run: Path, tmp_path: Path) -> None:
    command = ["train-corrector", "--data", str(clean_run), "--out", str(tmp_path / "out")]
    shown = CliRunner().invoke(app, [*command, "--preset", "embedded", "--set", "losses.sdf_weight=0.5", "--dry-run"])
    assert shown.exit_code == 0
    plan = json.loads(shown.stdout)
    assert plan["settings"]["losses"]["sdf_weight"] == 0.5
    assert plan["num_scenes"] == 4
    assert not (tmp_path / "out").exists()
    for wrong, said in (
        ("losses.sdf_wieght=1", "did you mean losses.sdf_weight"),
        ("losses=1", "expected a table"),
        ("steps.more=1", "is a value"),
        ('features="shape"', "expected point or box"),
        ("corrector.flow.source=noise", "expected coarse, expected or gaussian"),
    ):
        result = CliRunner().invoke(app, [*command, "--set", wrong])
        assert result.exit_code == 2
        assert said in result.stderr
    result = CliRunner().invoke(app, [*command, "--preset", "tiny"])
    assert result.exit_code == 2
    assert "corrector preset 'tiny' is unknown" in result.stderr
