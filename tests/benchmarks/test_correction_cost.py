"""What a correction costs: the layouts that it is measured on, and how the figures are made of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import correction_cost
from benchmarks.correction_cost import Bench, Cost, Throughput, crowd, exponent, growth_table
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import SceneError
from stable_data.scene import TABLE, Scene


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    write_world(folder, 3, EmbeddedWorld(pictures=False))
    return folder


@pytest.fixture(scope="module")
def bench(root: Path) -> Bench:
    return Bench(root, 2)


@pytest.mark.slow
def test_scenes_are_jittered_differently_each_round_and_come_out_clean(bench: Bench) -> None:
    first, again, second = bench.jittered(1), bench.jittered(1), bench.jittered(2)
    for clean, one, same, other in zip(bench.scenes, first, again, second, strict=True):
        assert (one.poses() == same.poses()).all()
        assert (one.poses() != other.poses()).any()
        assert np.abs(one.poses() - clean.poses())[:, :2].max() > 1e-3
    costs = bench.costs("certify", first)
    assert [c.num_objects for c in costs] == [len(scene.objects) for scene in first]
    assert all(c.is_clean and c.seconds > 0 for c in costs)
    assert "certify" in bench.methods


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 7, 40])
def test_crowds_are_as_dense_whatever_their_number(bench: Bench, count: int, rng: np.random.Generator) -> None:
    scene = crowd(bench.scenes, count, rng)
    assert len({o.instance for o in scene.objects}) == count
    standing = [o for o in scene.objects if o.support == TABLE]
    share = sum(o.size[0] * o.size[1] for o in standing) / np.prod(scene.table.size_xy)
    assert share == pytest.approx(correction_cost._OCCUPANCY)
    assert all(0 < x < scene.table.size_xy[0] and 0 < y < scene.table.size_xy[1] for x, y, _ in (o.position for o in standing))


@pytest.mark.slow
def test_what_is_carried_goes_along(bench: Bench, rng: np.random.Generator) -> None:
    known = np.array([offset for scene in bench.scenes for offset in _offsets(scene)])
    found = _offsets(crowd(bench.scenes, 40, rng))
    assert len(found)
    assert all(np.abs(known - offset).max(axis=1).min() < 1e-9 for offset in found)


def _offsets(scene: Scene) -> list[np.ndarray]:
    """Where carried objects are from what carries them."""
    names = {o.instance for o in scene.objects}
    return [np.subtract(o.position, scene[o.support].position) for o in scene.objects if o.support and o.support in names]


@pytest.mark.slow
def test_a_number_that_cannot_be_met_is_refused(bench: Bench, rng: np.random.Generator) -> None:
    scene = bench.scenes[0]
    first, second, *_ = scene.objects
    pair = replace(
        scene, objects=(replace(first, support=TABLE), replace(second, support=first.instance)), relations=(), task=None
    )
    assert len(crowd([pair], 4, rng).objects) == 4
    with pytest.raises(SceneError, match="carries at least 1"):
        crowd([pair], 3, rng)


def test_the_exponent_is_that_of_the_law() -> None:
    costs = [Cost("certify", "", n, is_clean=n < 60, seconds=0.01 * n**1.5) for n in (5, 15, 60)]
    assert exponent(costs) == pytest.approx(1.5)
    lines = growth_table(costs).splitlines()
    assert [line.split()[-1] for line in lines] == ["clean", "1/1", "1/1", "0/1", "1.50"]


@pytest.mark.slow
def test_what_has_no_place_on_a_full_table_is_counted(bench: Bench, rng: np.random.Generator) -> None:
    cost = bench.cost("certify", crowd(bench.scenes, 16, rng, 2.5), 2.5)
    assert cost.is_clean
    assert 0 < cost.num_dropped < 16
    assert (cost.num_objects, cost.occupancy) == (16, 2.5)


def test_only_clean_scenes_count() -> None:
    costs = tuple(Cost("certify", "", 15, is_clean=n > 0, seconds=0.5) for n in range(5))
    assert "4 of 5 scenes of 15 to 15 objects (15.0) clean, 0.80 scenes/s with 2 processes (3.20 by processor time)" in str(
        Throughput(2, 5.0, costs)
    )


@pytest.mark.slow
def test_processes_share_the_scenes(root: Path) -> None:
    rates = correction_cost.throughput(root, 2, 2, 2)
    assert {rate.costs[0].method for rate in rates} >= {"certify"}
    assert all(len(rate.costs) == 4 and rate.wall_seconds > 0 for rate in rates)
