"""The rearrangement benchmark on three small scenes: noise, failures, means over seeds, published figures apart from measured ones."""

import hashlib
import json
import math
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer
from typer.testing import CliRunner

from benchmarks.correction import judged
from benchmarks.corrector_parts import CorrectorParts, CorrectorTerms, SharedMover
from benchmarks.layouts import StartLayout, noisy_layouts
from benchmarks.rearrangement import (
    EQUAL,
    METHODS,
    PUBLISHED,
    WEIGHTS,
    figures_of,
    layouts_of,
    main,
    measure,
    open_methods,
    table,
    trained_on,
)
from benchmarks.result_log import MeasuredLayout, ResultLog, Share
from models.baselines.outcome import Baseline, BaselineResult
from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS
from models.rearrangement.rearranger import open_rearranger
from models.rearrangement.settings import METHODS as REARRANGERS
from models.training.weights_file import read_notes
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import TABLE, Scene
from tests.models.rearrangement.test_rearranger import weights_of

TERMS = CorrectorTerms(is_told=True, purpose="rearrange", keeps_all=True)


@pytest.fixture(scope="module")
def store(dataset: Path) -> AssetStore:
    return AssetStore(MesaTaskDataset(dataset))


@pytest.fixture(scope="module")
def scenes(dataset: Path, store: AssetStore) -> list[Scene]:
    """Three scenes of at most four objects on the table."""
    world, found = MesaTaskDataset(dataset), list[Scene]()
    for scene_id in world.scene_ids[:3]:
        scene = store.resolved(world.read(scene_id)[0])[0]
        standing = [o for o in scene.objects if o.position[2] - o.size[2] / 2 < 1e-3]
        objects = tuple(replace(o, support=TABLE) for o in standing[:4])
        found.append(replace(scene, objects=objects, relations=(), task=None))
    assert all(len(scene.objects) > 1 for scene in found)
    return found


class Broken:
    """Fails."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        raise MeshError("no such mesh", "mesh_missing")


class Lost:
    """A mover whose new poses are never finite."""

    def prepare(self, scene: Scene, shapes: Sequence[Shape]) -> None: ...

    def __call__(self, scenes: Sequence[Scene], *_: object) -> list[None]:
        return [None] * len(scenes)


class Perfect:
    """Knows the clean scenes."""

    def __init__(self, layouts: Sequence[StartLayout]) -> None:
        self._targets = {layout.start.scene_id: layout.target for layout in layouts}

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        target = self._targets[scene.scene_id]
        assert target is not None
        return BaselineResult(target, True, 0.25)


@pytest.fixture(scope="module")
def layouts(scenes: list[Scene], store: AssetStore) -> list[StartLayout]:
    return [x for seed in range(2) for x in noisy_layouts(scenes, store, 0.1, seed)]


@pytest.fixture(scope="module")
def results(layouts: list[StartLayout], store: AssetStore, tmp_path_factory: pytest.TempPathFactory) -> list[MeasuredLayout]:
    folder = tmp_path_factory.mktemp("weights")
    movers = {name: SharedMover(open_rearranger(weights_of(name, folder))) for name in REARRANGERS}
    methods: dict[str, Baseline] = {name: CorrectorParts(TERMS, True, False, False, mover) for name, mover in movers.items()}
    methods |= {"lego_net + refine + certify": CorrectorParts(TERMS, mover=movers["lego_net"])}
    methods |= {"certify": CorrectorParts(TERMS, False, False, True), "broken": Broken(), "perfect": Perfect(layouts)}
    log = ResultLog(None, {}, Share())
    measure(layouts, store, methods, log)
    found = [log.known(name, layout) for layout in layouts for name in ("start", *methods)]
    return [one for one in found if one is not None]


def test_the_noise_is_the_papers_and_depends_on_seed_and_scene_alone(scenes: list[Scene], store: AssetStore) -> None:
    many, count = [replace(scenes[0], scene_id=str(n)) for n in range(200)], len(scenes[0].objects)

    def noise(layouts: Sequence[StartLayout]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        found = []
        for layout in layouts:
            assert layout.target is not None
            found.append(layout.start.poses() - layout.target.poses())
        moved = np.concatenate(found)
        moved[:, 3] = (moved[:, 3] + math.pi) % (2 * math.pi) - math.pi
        return moved

    found = noise(list(noisy_layouts(many, store, 0.1, 0)))
    assert found.mean(axis=0) == pytest.approx(0, abs=0.02)
    assert found.std(axis=0) == pytest.approx(0.1, rel=0.15)
    assert noise(list(noisy_layouts(many[5:6], store, 0.1, 0))) == pytest.approx(found[5 * count : 6 * count])
    assert not np.allclose(noise(list(noisy_layouts(many[5:6], store, 0.1, 1))), found[5 * count : 6 * count])
    assert not noise(list(noisy_layouts(many[:3], store, 0.1, 0, along_z=False)))[:, 2].any()


def test_every_method_is_judged_on_every_scene_and_seed(results: list[MeasuredLayout]) -> None:
    figures = figures_of(results)
    assert [(f.method, f.seed, f.scenes) for f in figures] == [
        (name, seed, 3)
        for seed in range(2)
        for name in ("start", *REARRANGERS, "lego_net + refine + certify", "certify", "broken", "perfect")
    ]
    of = {(f.method, f.seed): f for f in figures}
    for seed in range(2):
        start, perfect = of["start", seed], of["perfect", seed]
        assert (start.moved, start.failed) == (0, 0)
        assert start.emd > 0.05
        assert perfect.emd == pytest.approx(0, abs=1e-9)
        assert perfect.moved > 0.05
        assert (perfect.clean, perfect.oc, perfect.seconds) == (1, 0, 0.25)
        assert of["certify", seed].clean == of["lego_net + refine + certify", seed].clean == 1
        for name in REARRANGERS:
            assert of[name, seed].moved > 0.001
            assert of[name, seed].failed == 0
        for f in figures:
            assert f.moved_category <= f.moved + 1e-9
            assert f.emd_category <= f.emd + 1e-9


def test_a_method_that_fails_is_counted_with_the_layout_as_it_was(results: list[MeasuredLayout]) -> None:
    broken, start = ([r for r in results if r.method == name] for name in ("broken", "start"))
    assert all(r.failed and r.reason == "no such mesh" for r in broken)
    assert not any(r.failed for r in results if r.method != "broken")
    for one, other in zip(broken, start, strict=True):
        assert (one.move_mean_mm, one.emd_mm, one.oc) == (0, other.emd_mm, other.oc)
    row = next(line for line in table(figures_of(results), ["broken"]).splitlines() if line.startswith("broken"))
    assert row.split()[1:4] == ["6", "6", "0"]


def test_scenes_of_which_a_verdict_is_unknown_are_counted(results: list[MeasuredLayout]) -> None:
    own = [r for r in results if r.method == "certify"]
    open_ = [replace(r, oc_sdf=None) if k == 0 else r for k, r in enumerate(own)]
    assert [f.unknown for f in figures_of(open_)] == [1, 0]
    row = next(line for line in table(figures_of(open_), ["certify"]).splitlines() if line.startswith("certify"))
    assert row.split()[1:4] == ["6", "0", "1"]


def test_poses_that_are_not_finite_are_a_failure(layouts: list[StartLayout], store: AssetStore) -> None:
    parts = CorrectorParts(TERMS, True, False, False, SharedMover(Lost()))  # type: ignore[arg-type]
    lost = judged("lost", parts, layouts[0], store)
    assert (lost.converged, lost.failed, lost.reason) == (False, True, "the new poses are not finite")
    assert lost.move_mean_mm == 0


def test_methods_that_share_a_mover_pay_its_time_each(scenes: list[Scene], store: AssetStore) -> None:
    class Slow:
        """A mover that takes 0.2 s and counts how often it is asked."""

        asked = 0

        def prepare(self, scene: Scene, shapes: Sequence[Shape]) -> None: ...

        def __call__(self, scenes: Sequence[Scene], *_: object) -> list[Scene | None]:
            self.asked += 1
            end = time.process_time() + 0.2
            while time.process_time() < end:
                pass
            return list(scenes)

    slow = Slow()
    shared = SharedMover(slow)  # type: ignore[arg-type]
    parts = [CorrectorParts(TERMS, True, repairs, repairs, shared) for repairs in (False, True)]
    for asked, layout in enumerate(noisy_layouts(scenes[:2], store, 0.1, 0), start=1):
        found = [judged("", method, layout, store) for method in parts]
        assert slow.asked == asked
        assert all(one.seconds >= 0.2 for one in found)


def test_published_figures_are_never_measured_ones(results: list[MeasuredLayout]) -> None:
    lines = table(figures_of(results)).splitlines()
    rows = {name: next(line for line in lines if line.startswith(f"{name} ")) for name in ("start", *METHODS)}
    assert rows["struct_diffusion"].split()[-3:] == ["0.21", "0.23", "0.25"]
    assert rows["flow + refine + certify"].split()[5:] == ["-", "-", "-", *["-"] * 8, "0.14", "0.08", "0"]  # not measured here
    assert "±" in rows["certify"]
    assert set(PUBLISHED) < set(METHODS)
    alone = table([f for f in figures_of(results) if f.seed == 0])
    assert "±" not in alone


def test_methods_without_weights_are_named(tmp_path: Path) -> None:
    files = {"lego_net": weights_of("lego_net", tmp_path), "struct_diffusion": None}
    methods, left_out = open_methods((), TERMS, files)
    known = [m for m in METHODS if not m.startswith(("struct_diffusion", EQUAL))]
    assert (list(methods), left_out) == (known, ["struct_diffusion", EQUAL])
    flow = open_methods((EQUAL,), TERMS, {EQUAL: DEFAULT_WEIGHTS})[0][EQUAL]
    assert isinstance(flow, CorrectorParts)
    assert (flow.terms.weights, flow.flows, flow.refines, flow.certifies) == (str(DEFAULT_WEIGHTS), True, False, False)
    with pytest.raises(ConfigError, match="equal flow has no weights, expected --equal-flow FILE"):
        open_methods((EQUAL,), TERMS, {})
    alone, repaired = methods["lego_net"], methods["lego_net + refine + certify"]
    assert isinstance(alone, CorrectorParts)
    assert isinstance(repaired, CorrectorParts)
    assert alone.mover is repaired.mover is not None
    assert [(p.flows, p.refines, p.certifies) for p in (alone, repaired)] == [(True, False, False), (True, True, True)]
    assert list(open_methods(("certify", "lego_net"), TERMS, files)[0]) == ["lego_net", "certify"]
    with pytest.raises(ConfigError, match="struct_diffusion has no weights, expected --struct-diffusion FILE"):
        open_methods(("struct_diffusion",), TERMS, files)
    with pytest.raises(ConfigError, match="--method lego, expected of lego_net"):
        open_methods(("lego",), TERMS, files)


def test_the_weights_beside_the_benchmark_are_of_equal_trainings() -> None:
    files = {path.stem: path for path in WEIGHTS.glob("*.safetensors")}
    assert files.keys() == {*REARRANGERS, "flow"}
    notes = [read_notes(path) for path in files.values()]
    assert len({(one["steps"], one["data_fingerprint"], one["seed"], one["features"]) for one in notes}) == 1
    assert all(json.loads(one["training"])["batch_size"] == json.loads(notes[0]["training"])["batch_size"] for one in notes)
    methods, left_out = open_methods((), TERMS, {**{name: files[name] for name in REARRANGERS}, EQUAL: files["flow"]})
    assert (list(methods), left_out) == (list(METHODS), [])
    assert sum(path.stat().st_size for path in files.values()) < 12e6


def of_split(run_folder: Path, to: Path, split: str) -> Path:
    """A copy of a run whose scenes are all of one split."""
    shutil.copytree(run_folder, to)
    for path in (to / "scenes").glob("*.parquet"):
        rows = pq.read_table(path)
        place = rows.schema.get_field_index("split")
        pq.write_table(rows.set_column(place, rows.schema.field(place), pa.array([split] * len(rows), pa.string())), path)
    return to


def test_the_command_measures_held_out_scenes_of_a_run(clean_run: Path, tmp_path: Path) -> None:
    app, file = typer.Typer(), tmp_path / "figures.json"
    app.command()(main)
    place = of_split(clean_run, tmp_path / "run", "test")
    weights = str(weights_of("lego_net", tmp_path))
    words = [str(place), "--count", "1", "--seeds", "2", "--method", "lego_net", "--lego-net", weights, "--json", str(file)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "2 layouts" in done.stdout
    found = json.loads(file.read_text("utf-8"))
    assert [(f["method"], f["seed"], f["scenes"]) for f in found["figures"]] == [
        (name, seed, 1) for seed in range(2) for name in ("start", "lego_net")
    ]
    assert found["published"]["lego_net"] == {"moved": 0.28, "emd": 0.43, "oc": 0.32}
    assert len(found["results"]) == 4
    digest = hashlib.sha256(Path(weights).read_bytes()).hexdigest()
    assert found["networks"] == {
        "lego_net": {"file": Path(weights).name, "sha256": digest, "steps": None, "data_fingerprint": "abc"}
    }
    assert "lego_net: unknown steps in its last training, data abc, " in done.stdout
    assert trained_on({"flow": DEFAULT_WEIGHTS})["flow"]["steps"] is not None
    train = of_split(clean_run, tmp_path / "train", "train")
    with pytest.raises(ConfigError, match="no clean scene of the split test"):
        layouts_of(str(train), 1, 0.1, 1)
    with pytest.raises(ConfigError, match="--split train, expected of test, validation, unseen"):
        layouts_of(str(train), 1, 0.1, 1, ["train"])
    chosen_on = of_split(clean_run, tmp_path / "validation", "validation")
    with pytest.raises(ConfigError, match="no clean scene of the split test"):
        layouts_of(str(chosen_on), 1, 0.1, 1)
    assert len(layouts_of(str(chosen_on), 1, 0.1, 1, ["test", "validation"])) == 1


def test_a_stopped_measurement_goes_on_and_shares_make_the_same_results(
    layouts: list[StartLayout], results: list[MeasuredLayout], store: AssetStore, tmp_path: Path
) -> None:
    methods: dict[str, Baseline] = {"broken": Broken(), "perfect": Perfect(layouts)}
    asked = {"noise": 0.1}
    for number in (1, 2):
        measure(layouts, store, methods, ResultLog(tmp_path, asked, Share(number, 2)))
    file = tmp_path / "results-2-of-2.jsonl"
    whole = file.read_bytes()
    assert len(whole.splitlines()) == 6  # one of three scenes, two seeds, three methods
    file.write_bytes(whole[:-40])  # a stop within a line
    measure(layouts, store, methods, ResultLog(tmp_path, asked, Share(2, 2)))
    log = ResultLog(tmp_path, asked, Share())
    found = [log.known(name, layout) for layout in layouts for name in ("start", *methods)]
    assert [replace(one, seconds=0.0) for one in found if one is not None] == [
        replace(one, seconds=0.0) for one in results if one.method in ("start", *methods)
    ]
    measure(layouts, store, {"perfect": Lost()}, log)  # type: ignore[dict-item]  # nothing is left to measure
    with pytest.raises(ConfigError, match=r"noise: 0\.1 -> 0\.2"):
        ResultLog(tmp_path, {"noise": 0.2}, Share())
    file.write_text("{}\n")
    with pytest.raises(ConfigError, match="line 1 is no result"):
        ResultLog(tmp_path, asked, Share())
    for wrong in ("", "3/2", "0/2", "1"):
        with pytest.raises(ConfigError, match="expected K/N"):
            Share.of(wrong)
