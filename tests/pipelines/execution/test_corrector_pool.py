"""Flow and refinement that workers share: the same results as alone, in batches of several workers, errors where they belong."""

import asyncio
import json
import pickle
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray

from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.learned_flow import load_flow
from models.physics_corrector.refinement.layouts import LayoutToRefine, RefinedLayout
from models.physics_corrector.refinement.refiner import Refiner
from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectorJobSettings, CorrectSettings
from pipelines.edit.settings import EditSettings
from pipelines.execution.corrector_pool import _CorrectorActor, corrector_pool
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.settings import resolve_settings
from pipelines.sources.generation_tasks import sample_tasks
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from tests.models.physics_corrector.geometry.shapes import scene, store, thing

CROWDED = scene(
    thing("plate", (0.4, 0.4, 0.005, 0.2), support="table"),
    thing("ball", (0.42, 0.4, 0.11, 0), support="plate"),
    thing("cube_0", (0.52, 0.42, 0.05, 0.4), support="table"),
    thing("cube_1", (0.55, 0.48, 0.05, 0), support="table"),
)


class BatchRecorder:
    """A slow refinement that notes its batches, and fails with one scene."""

    def __init__(self) -> None:
        self.batches: list[list[str]] = []

    def rest(self, layouts: Sequence[LayoutToRefine]) -> list[Scene]:
        time.sleep(0.2)
        self.batches.append([layout.scene.scene_id for layout in layouts])
        if any(layout.scene.scene_id == "bad" for layout in layouts):
            raise ConfigError("bad scene", "bad")
        assert all(len(layout.shapes) == len(layout.scene.objects) for layout in layouts)
        return [layout.scene for layout in layouts]

    def refine(self, layouts: Sequence[LayoutToRefine]) -> list[RefinedLayout | None]:
        return [None] * len(layouts)


def named(name: str) -> LayoutToRefine:
    return LayoutToRefine(replace(CROWDED, scene_id=name), ())


def test_calls_that_wait_become_one_batch_and_each_gets_its_own_answers() -> None:
    refiner = BatchRecorder()
    actor = _CorrectorActor(lambda: (PhysicsCorrector(refiner=refiner), store()))

    async def ask() -> list[list[Scene]]:
        first = asyncio.create_task(actor.compute("rest", [named("a"), named("b")]))
        await asyncio.sleep(0.05)
        others = [asyncio.create_task(actor.compute("rest", [named(n)])) for n in ("c", "d")]
        return [await first, *[await other for other in others]]

    found = asyncio.run(ask())
    assert [[one.scene_id for one in own] for own in found] == [["a", "b"], ["c"], ["d"]]
    assert refiner.batches == [["a", "b"], ["c", "d"]]


def test_an_error_goes_to_the_call_that_causes_it() -> None:
    actor = _CorrectorActor(lambda: (PhysicsCorrector(refiner=BatchRecorder()), store()))

    async def ask() -> list[object]:
        first = asyncio.create_task(actor.compute("rest", [named("a")]))
        await asyncio.sleep(0.05)
        others = [asyncio.create_task(actor.compute("rest", [named(n)])) for n in ("bad", "c")]
        return list(await asyncio.gather(first, *others, return_exceptions=True))

    first, bad, good = asyncio.run(ask())
    assert isinstance(first, list)
    assert isinstance(bad, ConfigError)
    assert isinstance(good, list)


def opened() -> tuple[PhysicsCorrector, AssetStore]:
    return PhysicsCorrector(load_flow(), refiner=Refiner(store(), ContactGrids())), store()


@pytest.mark.ray
@pytest.mark.slow
def test_actors_take_their_parts_of_a_gpu_and_give_what_this_process_gives(local_ray: None) -> None:
    alone, meshes = opened()
    with corrector_pool(opened, 2, 0.5, may_grow=False) as pool:
        assert ray.available_resources().get("GPU", 0) == 0
        shared = PhysicsCorrector(pool.flow, refiner=pool.refiner)
        for found, own in zip(*(c.correct([CROWDED, CROWDED], meshes) for c in (shared, alone)), strict=True):
            assert found.certified is not None
            assert own.certified is not None
            assert found.certified.poses() == pytest.approx(own.certified.poses(), abs=1e-5)
            assert found.solved_by == own.solved_by
        assert sum(counts.num_scenes for counts in pool.counts()) == 6  # moved, at exact heights to be judged, refined
    with (
        pytest.raises(ConfigError, match=r"correctors=3 with corrector_gpus=0.5 need 1.5 GPUs, .* has 1, enough for 2"),
        corrector_pool(opened, 3, 0.5, may_grow=False),
    ):
        pass


@pytest.mark.slow
@pytest.mark.ray
def test_an_actor_that_cannot_open_is_one_line(local_ray: None) -> None:
    def missing() -> tuple[PhysicsCorrector, AssetStore]:
        raise ConfigError("weights: no such file", "checkpoint_invalid")

    with (
        pytest.raises(ConfigError, match=r"cannot be opened by an actor .*no such file"),
        corrector_pool(missing, 1, 0.0, may_grow=False),
    ):
        pass


@pytest.mark.slow
@pytest.mark.ray
def test_the_error_of_a_worker_is_its_own(local_ray: None) -> None:
    with corrector_pool(lambda: (PhysicsCorrector(refiner=BatchRecorder()), store()), 1, 0.0, may_grow=False) as pool:
        assert pool.flow is None
        with pytest.raises(ConfigError, match="bad scene"):
            pool.rest([named("bad")])
        assert [one.scene_id for one in pool.rest([named("a")])] == ["a"]
        assert pool.rest([]) == []


def test_correctors_without_workers_are_refused_before_anything_is_written(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"correctors is 1, .* use more workers, or leave correctors at 0"):
        correct(str(dataset), str(tmp_path / "out"), CorrectSettings(correctors=1), WorkerPool())
    with pytest.raises(ConfigError, match="correctors is 2"):
        generate(sample_tasks(1, 0, ()), str(tmp_path / "out"), GenerateSettings(correctors=2), WorkerPool())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"correctors": 1, "corrector_gpus": 1.5, "device": "cuda"}, "expected a fraction of a GPU or a whole number"),
        ({"corrector_gpus": 0.5, "device": "cuda"}, "but correctors is 0"),
        ({"correctors": 1, "corrector_gpus": 0.5}, "but device is cpu"),
    ],
)
def test_gpus_that_nothing_would_use_are_refused(settings: dict[str, Any], said: str) -> None:
    for kind in (CorrectSettings, GenerateSettings, EditSettings):
        with pytest.raises(ConfigError, match=said):
            resolve_settings(kind, kind.section, None, [f"{key}={json.dumps(value)}" for key, value in settings.items()])


@pytest.mark.ray
@pytest.mark.slow
def test_scenes_are_generated_with_parts_of_a_gpu(local_ray: None, tmp_path: Path) -> None:
    """The device is the CPU by its other name, so that the actors with parts of Ray's GPU run without one."""
    settings = GenerateSettings(device="cpu:0", correctors=2, corrector_gpus=0.5, refine=True, num_pictures=0)
    manifest = generate(sample_tasks(2, 3, ()), str(tmp_path), settings, WorkerPool(2))
    assert manifest["counts"]["scenes"] + manifest["counts"]["rejected"] == 2
    assert manifest["counts"]["failures"] == 0


@pytest.mark.parametrize("kind", [CorrectSettings, GenerateSettings, EditSettings])
def test_a_separate_process_uses_no_gpu_and_no_actor(kind: type[CorrectorJobSettings]) -> None:
    shared = kind(device="cuda", correctors=2, corrector_gpus=0.5)
    assert shared.alone() == kind()
    assert kind(device="cuda").alone() == kind(device="cuda")


@pytest.mark.slow
@pytest.mark.ray
def test_each_actor_gets_each_step_and_another_pool_is_another_one(local_ray: None) -> None:
    def recorded() -> tuple[PhysicsCorrector, AssetStore]:
        return PhysicsCorrector(refiner=BatchRecorder()), store()

    with corrector_pool(recorded, 2, 0.0, may_grow=False) as pool, corrector_pool(recorded, 1, 0.0, may_grow=False) as other:
        for _ in range(2):
            pool.rest([named("a")])
            pool.refine([named("a")])
        assert [counts.num_calls for counts in pool.counts()] == [2, 2]
        copy = pickle.loads(pickle.dumps(pool))
        assert pool == copy
        assert hash(pool) == hash(copy)
        assert pool != other


@pytest.mark.ray
def test_a_lost_actor_ends_the_run_with_one_line(local_ray: None) -> None:
    with corrector_pool(lambda: (PhysicsCorrector(refiner=BatchRecorder()), store()), 1, 0.0, may_grow=False) as pool:
        ray.kill(pool.actors[0])
        with pytest.raises(ConfigError, match="a shared corrector was lost; run again to continue"):
            pool.rest([named("a")])


def rows_of(out: Path, table: str) -> list[Row]:
    return sorted(RunFolder(str(out)).table(table).to_pylist(), key=lambda row: row["scene_id"])


@pytest.mark.slow
@pytest.mark.ray
def test_shared_correctors_give_the_scenes_that_each_worker_alone_gives(real_data: Path, tmp_path: Path) -> None:
    settings = CorrectSettings(refine=True, num_pictures=0, write_dataset=False, scenes_per_shard=4)
    for count in (0, 1):
        manifest = correct(str(real_data), str(tmp_path / str(count)), replace(settings, correctors=count), WorkerPool(2))
        assert manifest["counts"]["failed_scenes"] == 0
    apart, shared = (rows_of(tmp_path / str(count), "corrections") for count in (0, 1))
    assert [row["scene_id"] for row in apart] == [row["scene_id"] for row in shared]
    assert [row["status"] for row in apart] == [row["status"] for row in shared]
    raws = [np.array([pose["position"] for row in rows for pose in row["raw"] or ()]) for rows in (apart, shared)]
    assert raws[0] == pytest.approx(raws[1], abs=1e-4)
    assert not ray.is_initialized()
