"""Trainings on several runs, on the proposals of a generate run, and on repaired targets."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from models.physics_corrector.flow.expected_error import PROPOSAL_ERROR
from models.physics_corrector.training.perturbation import PerturbationSettings, perturb
from models.physics_corrector.training.proposals import read_proposals
from models.physics_corrector.training.sources import TrainingScenes
from models.physics_corrector.training.stage_prefixes import drop_empty_slots
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.preprocess.job import preprocess
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from pipelines.train.corrector import CorrectorTrainingJob
from pipelines.train.layouts import LayoutMonitoring
from stable_data.assets.point_features import PointFeatures, feature_key, join_features
from stable_data.errors import ConfigError
from stable_data.scene import Tabletop
from stable_data.storage.run_folder import RunFolder
from tests.models.physics_corrector.training.training_scenes import TINY
from tests.pipelines.runs import SMALL
from tests.pipelines.scripts import one_thing_a_stage

SETTINGS = replace(TINY, steps=2, batch_size=4, chunk=4, num_surface=64, num_bottom=16, proposed=0.5)
WATCH = LayoutMonitoring(log_every=1, card_every=2, card_scenes=1, final_scenes=2, exact_scenes=1)


@pytest.fixture(scope="module")
def generated(clean_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes whose proposals collide: each stage puts its thing into that of the stage before."""
    root = tmp_path_factory.mktemp("generated")
    script = root / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(clean_run)]).libraries[0].assets[1:4])))
    found = TaskSource("tasks", [LayoutTask(f"task_{n}", "Lift it.", Tabletop("office_table", (1.2, 0.6))) for n in range(2)])
    settings = GenerateSettings(
        EngineSettings(f"scripted:{script}"), weights="none", settle=False, accept="clean", num_pictures=0
    )
    manifest = generate(found, str(root / "out"), settings, WorkerPool(), [str(clean_run)])
    assert manifest["counts"]["scenes"] == 2
    return root / "out"


def hashes(run: Path) -> dict[str, str]:
    return {row["asset_id"]: row["sha256"] for row in RunFolder(str(run)).table("meshes", ["asset_id", "sha256"]).to_pylist()}


def test_a_proposal_is_a_turn_before_and_after_its_correction(generated: Path, clean_run: Path) -> None:
    proposals, counts = read_proposals(str(generated), hashes(clean_run))
    turns = RunFolder(str(generated)).table("turns").to_pylist()
    corrected = [row for row in turns if row["corrected"] is not None]
    assert counts["proposals"] == len(turns)
    assert counts["proposals_used"] == len(proposals) == len(corrected) == 6
    for proposal, row in zip(proposals, sorted(corrected, key=lambda r: (r["scene_id"], r["turn"])), strict=True):
        after = {pose["instance"]: pose for pose in row["corrected"]}
        before = {pose["instance"]: pose for pose in row["coarse"]}
        for o, coarse in zip(proposal.scene.objects, proposal.coarse, strict=True):
            assert o.position == tuple(after[o.instance]["position"])
            assert coarse.tolist() == [*before[o.instance]["position"], before[o.instance]["yaw"]]
    assert any(np.abs(p.scene.poses() - p.coarse).max() > 1e-3 for p in proposals)  # things were parted


def test_rejected_attempts_are_no_samples(generated: Path, clean_run: Path, tmp_path: Path) -> None:
    """Names of a rejected attempt may mean other objects; unclean corrections are no targets."""
    other = Path(shutil.copytree(generated, tmp_path / "other"))
    (path,) = (other / "turns").glob("*.parquet")
    rows = pq.read_table(path)
    changed = rows.to_pylist()
    changed[0]["code"] = "relation_lost"
    changed[1]["card_after"]["clean"] = False
    pq.write_table(pa.Table.from_pylist(changed, rows.schema), path)
    proposals, counts = read_proposals(str(other), hashes(clean_run))
    assert len(proposals) == counts["proposals_used"] == 4
    assert counts["left_out_without_correction"] == 2


def test_proposals_on_other_meshes_are_left_out_and_counted(generated: Path, clean_run: Path) -> None:
    for known in ({}, dict.fromkeys(hashes(clean_run), "0" * 64)):
        proposals, counts = read_proposals(str(generated), known)
        assert proposals == []
        assert counts["left_out_of_other_assets"] == counts["proposals"] == 6


def test_coarse_layouts_of_proposals_are_the_proposed_ones(generated: Path, clean_run: Path, tmp_path: Path) -> None:
    data = TrainingScenes((str(clean_run),), tmp_path, 64, 16, (str(generated),)).load("box")
    alone = TrainingScenes((str(clean_run),), tmp_path, 64, 16).load("box")
    assert data.num_scenes == len(alone.batch)
    assert data.fingerprint != alone.fingerprint
    every = torch.arange(len(data.batch))
    batch = drop_empty_slots(data.take(every))
    assert batch.is_proposed.tolist() == [n >= data.num_scenes for n in every.tolist()]
    found = perturb(batch, PerturbationSettings(), torch.Generator().manual_seed(0))
    assert data.coarse is not None
    assert batch.coarse is not None
    assert found.poses[batch.is_proposed].equal(batch.coarse[batch.is_proposed])
    assert data.coarse[:, :3, 0].sum().isclose(batch.coarse[batch.is_proposed].sum(0)[:, 0].sum())  # no object is lost
    assert (found.error[batch.is_proposed] == torch.tensor([PROPOSAL_ERROR.position, PROPOSAL_ERROR.yaw])).all()
    again = TrainingScenes((str(clean_run),), tmp_path, 64, 16, (str(generated),)).load("box")  # from the cache
    assert again.coarse is not None
    assert again.coarse.equal(data.coarse)
    assert sorted([*data.of_split(0), *data.of_split(1), *data.of_split(2)]) == list(range(data.num_scenes))


def test_a_training_on_proposals_uses_them_and_says_so(generated: Path, clean_run: Path, tmp_path: Path) -> None:
    line = CorrectorTrainingJob(str(clean_run), tmp_path / "with", SETTINGS, WATCH, proposals=(str(generated),)).run()
    manifest = json.loads((tmp_path / "with" / "manifest.json").read_text("utf-8"))
    assert manifest["num_proposals"] > 0
    assert f"and {manifest['num_proposals']} proposals" in line
    CorrectorTrainingJob(str(clean_run), tmp_path / "without", SETTINGS, WATCH).run()
    weights = [(tmp_path / name / CorrectorTrainingJob.WEIGHTS).read_bytes() for name in ("with", "without")]
    assert weights[0] != weights[1]


def test_a_run_that_is_no_generate_run_is_refused(clean_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table turns, expected the folder of a generate run"):
        CorrectorTrainingJob(str(clean_run), tmp_path / "out", SETTINGS, WATCH, proposals=(str(clean_run),)).run()


@pytest.fixture(scope="module")
def real_run(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over real meshes, some of whose scenes are not clean."""
    root = tmp_path_factory.mktemp("real")
    chosen = root / "data"
    shutil.copytree(real_data, chosen, ignore=shutil.ignore_patterns("*.png"))
    for folder in sorted((chosen / "Layout_info").glob("*/*"))[3:]:
        shutil.rmtree(folder)
    preprocess(str(chosen), str(root / "out"), SMALL, WorkerPool())
    return root / "out"


@pytest.mark.slow
def test_a_training_on_two_runs_has_the_scenes_of_both(clean_run: Path, real_run: Path, tmp_path: Path) -> None:
    both = TrainingScenes((str(clean_run), str(real_run)), tmp_path, 64, 16).load("box")
    one = TrainingScenes((str(clean_run),), tmp_path, 64, 16).load("box")
    assert both.counts["scenes"] == one.counts["scenes"] + RunFolder(str(real_run)).num_rows("scenes")
    assert both.scene_ids[: len(one.scene_ids)] == one.scene_ids
    assert both.fingerprint != one.fingerprint


def test_features_of_several_runs_are_asked_together() -> None:
    def features(aspect: float, value: float) -> PointFeatures:
        key = feature_key("cup", (1.0, 1.0, aspect), (0.0, 0.0, 0.0, 1.0))
        row = np.full((1, 4), value, np.float32)
        tilts = np.array([[0.0, 0.0, 0.0, 1.0]])
        return PointFeatures(row, np.array([[1.0, 1.0, aspect]]), tilts, {key: np.zeros(3)}, {key: 0}, {"cup": [0]}, "one")

    joined = join_features([features(1.0, 1.0), features(0.5, 2.0)])
    for aspect, value in ((1.0, 1.0), (0.5, 2.0)):
        assert joined.nearest("cup", (1.0, 1.0, aspect), (0.0, 0.0, 0.0, 1.0))[0].tolist() == [value] * 4
        assert joined.of("cup", (1.0, 1.0, aspect), (0.0, 0.0, 0.0, 1.0)).tolist() == [value] * 4


def test_runs_with_another_mesh_of_an_asset_are_refused(clean_run: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(clean_run, tmp_path / "other"))
    path = sorted((other / "meshes").glob("*.parquet"))[0]
    table = pq.read_table(path)
    changed = [f"{n:064x}" for n in range(len(table))]
    index = table.schema.get_field_index("sha256")
    pq.write_table(table.set_column(index, table.schema.field(index), [changed]), path)
    with pytest.raises(ConfigError, match="is not the one of an earlier run"):
        TrainingScenes((str(clean_run), str(other)), tmp_path / "cache", 64, 16).load("box")


@pytest.mark.slow
def test_targets_that_are_not_clean_are_repaired(real_run: Path, clean_run: Path, tmp_path: Path) -> None:
    raw = TrainingScenes((str(clean_run), str(real_run)), tmp_path / "cache", 64, 16).load("box")
    left_out = raw.counts["left_out_not_clean"] + raw.counts["left_out_unknown"]
    assert left_out > 0
    job = CorrectorTrainingJob(
        str(clean_run), tmp_path / "out", replace(SETTINGS, targets="repair"), WATCH, also=(str(real_run),)
    )
    job.run()
    targets = json.loads((tmp_path / "out" / "manifest.json").read_text("utf-8"))["targets"]
    assert targets["left_out_not_clean"] == 0
    every = sum(RunFolder(str(run)).num_rows("scenes") for run in (clean_run, real_run))
    assert targets["kept"] + sum(v for name, v in targets.items() if name.startswith("left_out")) == every
    assert targets["kept"] > raw.counts["kept"]
    assert "2 of 2 steps" in job.run()  # the repaired scenes are there already
