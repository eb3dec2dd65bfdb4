"""Distance moved and the earth mover's distance: identities, and what must be refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import SceneError
from stable_data.metrics.rearrangement import distance_moved, emd_to_truth
from stable_data.rotations import YAW_ARM
from stable_data.scene import Scene, SceneObject, Tabletop

CUPS, PLATES = 4, 2


def scene_at(poses: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> Scene:
    """Four cups of one asset and two plates of another."""
    objects = []
    for n, (x, y, z, yaw) in enumerate(poses.tolist()):
        asset, size = ("cup", (0.08, 0.08, 0.1)) if n < CUPS else ("plate", (0.2, 0.2, 0.02))
        objects.append(SceneObject(f"{n}_{asset}", asset, (x, y, z), yaw, size, asset, (1.0, 1.0, 1.0)))
    return Scene("built", Tabletop("office_table", (1.0, 1.0)), tuple(objects))


def random_scene(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    return scene_at(rng.uniform((0, 0, 0, -np.pi), (1, 1, 0.1, np.pi), (CUPS + PLATES, 4)))


def permuted(scene: Scene, order: list[int]) -> Scene:
    """The same places, the objects exchanged."""
    poses = scene.poses()[order]
    moved = (o.moved(tuple(p[:3]), p[3]) for o, p in zip(scene.objects, poses.tolist(), strict=True))
    return replace(scene, objects=tuple(moved))


@given(st.integers(0, 10**6), st.permutations(range(CUPS)), st.permutations(range(CUPS, CUPS + PLATES)))
def test_identical_objects_may_take_each_other_s_places(seed: int, cups: list[int], plates: list[int]) -> None:
    scene = random_scene(seed)
    exchanged = permuted(scene, [*cups, *plates])
    found = emd_to_truth(exchanged, scene)
    assert found.cost == pytest.approx(0, abs=1e-12)
    assert (found.distance, found.turn) == pytest.approx((0, 0), abs=1e-12)
    assert distance_moved(scene, exchanged) == pytest.approx(0, abs=1e-12)
    assert sorted(found.matches.values()) == sorted(o.instance for o in scene.objects)


def test_the_order_of_the_objects_does_not_matter() -> None:
    scene, truth = random_scene(1), random_scene(2)
    turned = replace(scene, objects=scene.objects[::-1])
    assert emd_to_truth(turned, truth).cost == pytest.approx(emd_to_truth(scene, truth).cost)


def test_other_assets_may_not() -> None:
    scene = random_scene(3)
    exchanged = permuted(scene, [CUPS, 1, 2, 3, 0, CUPS + 1])
    assert emd_to_truth(exchanged, scene).cost > 0.01
    large = replace(scene, objects=(replace(scene.objects[0], size=(0.08, 0.08, 0.12)), *scene.objects[1:]))
    assert emd_to_truth(permuted(large, [1, 0, 2, 3, 4, 5]), large).matches["0_cup"] == "0_cup"
    lying = replace(scene, objects=(replace(scene.objects[0], tilt_quat_xyzw=(1.0, 0.0, 0.0, 0.0)), *scene.objects[1:]))
    assert emd_to_truth(permuted(lying, [1, 0, 2, 3, 4, 5]), lying).matches["0_cup"] == "0_cup"


def test_by_category_other_assets_of_it_may() -> None:
    scene = random_scene(3)
    first = replace(scene.objects[0], asset_id="glass", size=(0.06, 0.06, 0.16))
    mixed = replace(scene, objects=(first, *scene.objects[1:]))
    exchanged = permuted(mixed, [1, 0, 2, 3, 4, 5])
    assert emd_to_truth(exchanged, mixed).matches["0_cup"] == "0_cup"
    found = emd_to_truth(exchanged, mixed, "category")
    assert found.cost == pytest.approx(0, abs=1e-12)
    assert found.matches["0_cup"] == "1_cup"
    assert distance_moved(mixed, exchanged, "category") == pytest.approx(0, abs=1e-12)
    assert distance_moved(mixed, exchanged) > 0.01
    plates = permuted(mixed, [CUPS, 1, 2, 3, 0, CUPS + 1])
    assert emd_to_truth(plates, mixed, "category").cost > 0.01  # a cup is no plate


@given(st.integers(0, 10**6), st.integers(0, 10**6))
def test_by_category_a_scene_is_never_farther(one: int, other: int) -> None:
    scene, truth = random_scene(one), random_scene(other)
    renamed = replace(scene, objects=(replace(scene.objects[0], asset_id="glass"), *scene.objects[1:]))
    target = replace(truth, objects=(replace(truth.objects[0], asset_id="glass"), *truth.objects[1:]))
    assert emd_to_truth(renamed, target, "category").cost <= emd_to_truth(renamed, target).cost + 1e-12
    assert distance_moved(renamed, target, "category") <= distance_moved(renamed, target) + 1e-12


@given(st.integers(0, 10**6), st.integers(0, 10**6))
def test_it_is_symmetric_and_below_every_other_matching(one: int, other: int) -> None:
    scene, truth = random_scene(one), random_scene(other)
    found = emd_to_truth(scene, truth)
    assert found.cost == pytest.approx(emd_to_truth(truth, scene).cost)
    shift = np.linalg.norm(scene.poses()[:, :3] - truth.poses()[:, :3], axis=1)
    turn = np.abs((scene.poses()[:, 3] - truth.poses()[:, 3] + np.pi) % (2 * np.pi) - np.pi)
    assert found.cost <= np.hypot(shift, YAW_ARM * turn).mean() + 1e-12
    assert found.distance <= found.cost + 1e-12
    assert 0 <= found.turn <= np.pi
    assert distance_moved(scene, truth) <= found.distance + 1e-12


def test_a_known_move() -> None:
    start = scene_at(np.array([[0.2 * n, 0.5, 0.05, math.pi - 0.05] for n in range(CUPS + PLATES)]))
    moved = scene_at(start.poses() + np.array([0.003, 0.004, 0.0, 0.1]))  # past pi
    found = emd_to_truth(moved, start)
    assert found.distance == pytest.approx(0.005)
    assert found.turn == pytest.approx(0.1)
    assert found.cost == pytest.approx(math.hypot(0.005, 0.01))
    assert distance_moved(start, moved) == pytest.approx(0.005)


def test_missing_padded_and_exchanged_objects_are_refused() -> None:
    scene = random_scene(4)
    fewer = replace(scene, objects=scene.objects[1:])
    padded = replace(scene, objects=(*scene.objects, replace(scene.objects[0], instance="padding")))
    other = replace(scene, objects=(replace(scene.objects[0], asset_id="bowl"), *scene.objects[1:]))
    for changed in (fewer, padded, other):
        for pair in ((changed, scene), (scene, changed)):
            with pytest.raises(SceneError, match="expected") as caught:
                emd_to_truth(*pair)
            assert caught.value.code == "objects_differ"
    nothing = replace(scene, objects=())
    with pytest.raises(SceneError, match="no objects"):
        distance_moved(nothing, nothing)
