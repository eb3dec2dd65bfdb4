"""Handles of embedded assets: which faces they have, at any scale and tilt."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.embedded_world.families.catalogue import asset
from stable_data.embedded_world.handles import handle_of, is_of_handle
from stable_data.embedded_world.modelling.solids import box
from stable_data.geometry.mesh import Mesh
from stable_data.mesatask import MesaTaskDataset
from stable_data.rotations import quat_of
from stable_data.scene import SceneObject, Vec3


def held(key: str, factor: float = 1.0, angles: Vec3 = (0.0, 0.0, 0.0)) -> tuple[SceneObject, Mesh]:
    """An object of an asset, and its mesh in its yaw frame."""
    made, tilt = asset(key), Rotation.from_euler("xyz", angles)
    side = made.unit * factor
    vertices = tilt.apply(made.mesh.vertices * factor)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    width, depth, height = (high - low).tolist()
    size: Vec3 = (width, depth, height)
    category = key.split("/")[0]
    o = SceneObject("o", category, (0, 0, 0), 0.0, size, made.uid, scale=(side, side, side), tilt_quat_xyzw=quat_of(tilt))
    return o, Mesh(vertices - (low + high) / 2, made.mesh.faces)


@pytest.mark.parametrize("category", ["kettle", "fork", "mug", "teapot", "saucepan", "kitchen_knife"])
def test_things_with_a_handle_have_one_in_all_variants(category: str) -> None:
    assert all(asset(f"{category}/{n}").handle for n in range(6))


def test_the_handle_of_a_fork_is_its_near_end_and_that_of_a_mug_is_on_its_right() -> None:
    o, mesh = held("fork/0")
    middles = mesh.triangles.mean(axis=1)
    is_handle = is_of_handle(mesh, handle_of(o))
    assert middles[is_handle, 1].max() < 0.2 * o.size[1] < middles[~is_handle, 1].mean()
    o, mesh = held("mug/0")
    middles = mesh.triangles.mean(axis=1)
    assert middles[is_of_handle(mesh, handle_of(o)), 0].min() > 0


@pytest.mark.parametrize("key", ["kettle/0", "fork/3", "teapot/1"])
def test_scale_and_tilt_move_the_handle_with_the_mesh(key: str) -> None:
    o, mesh = held(key)
    expected = is_of_handle(mesh, handle_of(o))
    other, moved = held(key, 1.7, (0.4, -1.1, 0.3))
    assert (is_of_handle(moved, handle_of(other)) == expected).all()


def test_without_a_handle_or_with_another_asset_there_is_none() -> None:
    o, mesh = held("plate/0")
    assert handle_of(o) == ()
    assert not is_of_handle(mesh, ()).any()
    mug, _ = held("mug/0")
    changed: tuple[dict[str, Any], ...] = ({"asset_id": "other"}, {"asset_id": None}, {"category": "thing"}, {"scale": None})
    assert all(handle_of(replace(mug, **changes)) == () for changes in changed)


def test_a_union_keeps_the_handles_of_its_parts() -> None:
    handle = box(0.1, 0.1, 0.1).as_handle()
    made = (box(1.0, 1.0, 1.0) + handle.painted("red").turned(z=90).moved(x=0.5)).resized(2.0).grounded()
    [part] = made.handle
    assert part.mean(axis=0) == pytest.approx([1.0, 0.0, 0.1])


def test_handles_are_found_in_scenes_as_they_are_stored(tmp_path_factory: pytest.TempPathFactory) -> None:
    root = tmp_path_factory.mktemp("world")
    write_world(root, 6, EmbeddedWorld(pictures=False))
    dataset = MesaTaskDataset(root)
    store, found = AssetStore(dataset), 0
    for scene_id in dataset.scene_ids:
        scene, shapes, _ = store.resolved(dataset.read(scene_id)[0])
        for o, shape in zip(scene.objects, shapes, strict=True):
            handle = handle_of(o)
            if handle:
                corners = np.concatenate(handle)
                inside = (np.abs(corners) <= np.array(o.size) / 2 + 2e-3).all(axis=1)
                assert inside.mean() > 0.95, o  # corners inside of a wall are inside of the box too
                assert is_of_handle(Mesh(shape.vertices, shape.faces), handle).any(), o
                found += 1
    assert found
