"""The benchmarks of the corrector's flow: what it adds to `certify`, and what each part of its training is worth."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from benchmarks import corrector_ablation
from benchmarks.corrector_ablation import ARMS, FULL, Arm, arm
from benchmarks.flow_gain import ALONE, CoarseLayout, Gain, compared, held_out, perturbed
from benchmarks.flow_gain import table as gain_table
from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.certify.correction import Fixed
from models.physics_corrector.training.dataset import TrainingScenes, clean_targets
from models.physics_corrector.training.perturbation import KINDS, PerturbationSettings
from models.physics_corrector.training.settings import CorrectorTrainingSettings, training_preset
from models.physics_corrector.training.validation import Card
from pipelines.train.corrector import CorrectorMonitoring, CorrectorTrainingJob
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene
from tests.models.physics_corrector.training.training_scenes import TINY

SETTINGS = replace(TINY, steps=2, batch_size=4, chunk=4, num_surface=64, num_bottom=16)
WATCH = CorrectorMonitoring(log_every=2, card_every=9, final_scenes=2, exact_scenes=1)


def clean_scenes(run: Path, folder: Path) -> tuple[TrainingScenes, list[Scene]]:
    source = TrainingScenes(str(run), folder)
    return source, clean_targets(source.uri)[0]


@pytest.fixture(scope="module")
def layouts(clean_run: Path, tmp_path_factory: pytest.TempPathFactory) -> list[CoarseLayout]:
    source, scenes = clean_scenes(clean_run, tmp_path_factory.mktemp("meshes"))
    return list(perturbed(scenes[:1], source.store(), PerturbationSettings()))


def test_what_is_held_out_was_not_trained_on(clean_run: Path, tmp_path: Path) -> None:
    source, _ = clean_scenes(clean_run, tmp_path)
    scenes, splits, _ = clean_targets(source.uri)
    trained_on = {scene.scene_id for scene, split in zip(scenes, splits, strict=True) if split == 0}
    others = held_out(source, 100)
    assert len(others) == len(scenes) - len(trained_on)
    assert not trained_on & {scene.scene_id for scene in others}


def test_every_kind_of_error_is_made_and_shows_what_it_carries(layouts: list[CoarseLayout]) -> None:
    assert tuple(c.group for c in layouts) == KINDS
    first = layouts[0].scene
    assert all(c.scene.relations == () for c in layouts)
    assert len({c.scene.poses().tobytes() for c in layouts}) == len(KINDS)
    assert any(o.support not in (None, "table") for o in first.objects)


def stays(scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
    return list(scenes)


def turns(scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> list[Scene]:
    return [scene.with_poses(scene.poses() + np.array([0.0, 0.0, 0.0, 0.3])) for scene in scenes]


def timeless(gain: Gain) -> Gain:
    return replace(gain, method="", flow_seconds=0.0, certify_seconds=0.0)


def test_a_flow_that_does_nothing_adds_nothing(layouts: list[CoarseLayout]) -> None:
    chosen = [c for c in layouts if c.group in ("small", "pile")]
    gains = compared(chosen, {"stays": stays, "turns": turns})
    by = {(g.method, g.group): g for g in gains}
    assert len(by) == len(gains) == 6
    for group in ("small", "pile"):
        alone, still, turned = (by[name, group] for name in (ALONE, "stays", "turns"))
        assert timeless(still) == timeless(alone)
        assert alone.status is CorrectionStatus.CERTIFIED
        assert turned.turn_mean_deg is not None
    turns_of = [by["turns", group].turn_mean_deg or 0.0 for group in ("small", "pile")]
    assert max(turns_of) > 5  # in the other group the turned start may be given up for the layout as it was
    lines = gain_table(gains).splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [
        [group, name] for group in ("small", "pile", "all") for name in (ALONE, *sorted({"stays", "turns"}))
    ]


def test_what_is_infeasible_counts_as_not_clean() -> None:
    none = Gain("certify", "pile", "one", 3, CorrectionStatus.INFEASIBLE, 0, None, None, None, None, 0.0, 0.5)
    assert gain_table([none]).splitlines()[1].split() == ["pile", "certify", "0/1", "0", *"-----", "0", "500"]


def test_every_arm_changes_one_thing() -> None:
    full = training_preset("embedded_set").resolved(1)
    assert ARMS[FULL](full) == full
    changed = {
        name: {key for key, value in change(full).flat().items() if value != full.flat()[key]} for name, change in ARMS.items()
    }
    assert changed.pop(FULL) == set()
    assert changed["no support"] == {"losses.support_weight"}
    assert changed["no table"] == {"losses.table_factor"}
    assert changed["no objects"] == {"losses.object_factor"}
    assert changed["box features"] == {"features"}
    assert all(key.startswith("corrector.network.") for key in changed["unet"])
    assert all(key.startswith(("losses.", "physics.")) for key in changed["no physics"])
    assert all(changed.values())


def trained(run: Path, out: Path, settings: CorrectorTrainingSettings = SETTINGS, name: str = FULL) -> Arm:
    return arm(str(run), out, name, settings, WATCH)


def test_an_arm_is_trained_once(clean_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = trained(clean_run, tmp_path)
    assert "2 of 2 steps" in capsys.readouterr().out
    assert trained(clean_run, tmp_path) == first
    assert capsys.readouterr().out == ""
    second = trained(clean_run, tmp_path, name="no table")
    assert (first.name, first.steps, second.name) == (FULL, 2, "no table")
    assert (tmp_path / "no_table" / "cache").resolve() == (tmp_path / "cache").resolve()
    with pytest.raises(ConfigError, match="steps: 2 -> 3"):
        trained(clean_run, tmp_path, replace(SETTINGS, steps=3))
    shutil.rmtree(tmp_path / "no_table")


def test_an_arm_that_was_stopped_says_so(clean_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(CorrectorTrainingJob, "run", lambda _: "stopped")
        with pytest.raises(SystemExit, match="run the command again to resume it"):
            trained(clean_run, tmp_path)
    assert trained(clean_run, tmp_path).steps == 2


def test_figures_are_means_over_the_rows_and_unknown_ones_are_said() -> None:
    card: Card = {
        "small": {"coarse": {"oc": 0.2}, "raw": {"oc": 0.1, "float_rate": None}},
        "pile": {"coarse": {"oc": 0.4}, "raw": {"oc": 0.3, "float_rate": 0.5}},
    }
    found = Arm("full", 2, 4, 1000, card)
    assert found.figure("oc") == pytest.approx(0.2)
    assert found.figure("oc", "coarse") == pytest.approx(0.3)
    assert found.figure("float_rate") is None
    lines = corrector_ablation.table([found]).splitlines()
    assert lines[1].startswith("coarse layout")
    assert "30.00 %" in lines[1]
    assert lines[2].split()[:2] == ["full", "1,000"]


def test_arms_that_are_not_known_are_refused(tmp_path: Path) -> None:
    with pytest.raises(typer.BadParameter, match=r"nothing, expected of full"):
        corrector_ablation.main("run", tmp_path, ["nothing"])
