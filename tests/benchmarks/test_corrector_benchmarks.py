"""The benchmarks of the corrector's flow: what it adds to `certify`, and what each part of its training is worth."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import typer

from benchmarks import corrector_ablation
from benchmarks.correction import judged
from benchmarks.corrector_ablation import ARMS, FULL, Arm, arm, full_settings
from benchmarks.corrector_parts import CorrectorTerms, corrector_parts
from benchmarks.layouts import StartLayout, held_out_scenes, perturbed_layouts
from models.physics_corrector.training.perturbation import KINDS, PerturbationSettings
from models.physics_corrector.training.settings import CorrectorTrainingSettings
from models.physics_corrector.training.sources import clean_targets
from models.physics_corrector.training.validation import Card
from pipelines.sources.scenes import scene_source
from pipelines.train.corrector import CorrectorTrainingJob
from pipelines.train.layouts import LayoutMonitoring
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from tests.models.physics_corrector.training.training_scenes import TINY

SETTINGS = replace(TINY, steps=2, batch_size=4, chunk=4, num_surface=64, num_bottom=16)
WATCH = LayoutMonitoring(log_every=2, card_every=9, final_scenes=2, exact_scenes=1)


@pytest.fixture(scope="module")
def layouts(clean_run: Path) -> tuple[list[StartLayout], AssetStore]:
    store = scene_source(str(clean_run)).store
    scenes = clean_targets(str(clean_run))[0]
    return list(perturbed_layouts(scenes[:1], store, PerturbationSettings())), store


def test_every_kind_of_error_is_made(clean_run: Path, layouts: tuple[list[StartLayout], AssetStore]) -> None:
    found, _ = layouts
    assert tuple(layout.bucket for layout in found) == KINDS
    assert len({layout.start.poses().tobytes() for layout in found}) == len(KINDS)
    scenes, splits, _ = clean_targets(str(clean_run))
    trained_on = {scene.scene_id for scene, split in zip(scenes, splits, strict=True) if split == 0}
    others = held_out_scenes(str(clean_run), 100)
    assert len(others) == len(scenes) - len(trained_on)
    assert not trained_on & {scene.scene_id for scene in others}
    for layout in found:
        assert layout.target is not None
        assert {o.support for o in layout.start.objects} == {o.support for o in layout.target.objects}


@pytest.mark.slow
def test_the_parts_of_the_corrector_do_what_they_say(layouts: tuple[list[StartLayout], AssetStore]) -> None:
    found, store = layouts
    jitter = next(layout for layout in found if layout.bucket == "jitter")
    parts = corrector_parts(CorrectorTerms(is_told=True))
    assert list(parts) == [
        "flow", "refine", "flow + refine", "certify", "flow + certify", "refine + certify", "flow + refine + certify",
    ]  # fmt: skip
    results = {name: judged(name, method, jitter, store) for name, method in parts.items()}
    assert all(results[name].clean for name in parts if name.endswith("certify"))
    assert len({results[name].emd_mm for name in ("flow", "refine", "certify")}) == 3
    assert all(r.meant[0] > 0 for r in results.values())
    assert results["flow"].num_floating <= results["flow"].num_objects // 2  # heights are exact


def test_every_arm_changes_one_thing() -> None:
    full = full_settings(100, 0).resolved(1)
    assert ARMS[FULL](full) == full
    changed = {
        name: {key for key, value in change(full).flat().items() if value != full.flat()[key]} for name, change in ARMS.items()
    }
    assert changed.pop(FULL) == set()
    assert changed["no support"] == {"losses.support_weight"}
    assert changed["no table"] == {"losses.table_factor"}
    assert changed["no objects"] == {"losses.object_factor"}
    assert changed["box features"] == {"features"}
    assert changed["no texts"] == {"corrector.network.num_texts"}
    assert changed["no self-conditioning"] == {"corrector.flow.self_condition"}
    assert changed["geometric heights"] == {"corrector.flow.heights"}
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
    assert (tmp_path / "seed_0" / "no_table" / "cache").resolve() == (tmp_path / "cache").resolve()
    with pytest.raises(ConfigError, match="steps: 2 -> 3"):
        trained(clean_run, tmp_path, replace(SETTINGS, steps=3))
    shutil.rmtree(tmp_path / "seed_0" / "no_table")


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
    found = Arm("full", 0, 2, 4, 1000, card)
    assert found.figure("oc") == pytest.approx(0.2)
    assert found.figure("oc", "coarse") == pytest.approx(0.3)
    assert found.figure("float_rate") is None
    lines = corrector_ablation.table([found]).splitlines()
    assert lines[1].startswith("coarse layout")
    assert "30.00 %" in lines[1]
    assert lines[2].split()[:3] == ["full", "1,000", "1"]
    other = Arm("full", 1, 2, 4, 1000, {"small": {"coarse": {}, "raw": {"oc": 0.4}}})
    row = corrector_ablation.table([found, other]).splitlines()[2]
    assert row.split()[:3] == ["full", "1,000", "2"]
    assert "30.00 ±127.06 %" in row  # t of one degree of freedom, 12.706, times half of the distance of 20 % and 40 %


def test_arms_that_are_not_known_are_refused(tmp_path: Path) -> None:
    with pytest.raises(typer.BadParameter, match=r"nothing, expected of full"):
        corrector_ablation.main("run", tmp_path, ["nothing"])
