"""Scenes as binary glTF, as trimesh reads them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from stable_data.assets.store import AssetStore
from stable_data.export import glb
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.stable_data.export.runs import EMPTY, ODD_INSTANCE, at_rest, posed

Z_UP = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])


def load(scene: Scene, store: AssetStore, out: Path) -> trimesh.Scene:
    """A scene written, and read by trimesh, turned back to z up."""
    glb.export_scene(SceneGeometry.of(scene, store), out)
    loaded = trimesh.load(glb.scene_path(scene, out))
    loaded.apply_transform(Z_UP)
    return loaded


def test_names_poses_and_extents_are_the_scenes(store: AssetStore, tmp_path: Path) -> None:
    scene = at_rest()
    loaded, solid = load(scene, store, tmp_path), SceneGeometry.of(scene, store)
    assert set(loaded.graph.nodes_geometry) == {"table", "restricted_zone", *(o.instance for o in scene.objects)}
    for o in scene.objects:
        world_from_node, geometry = loaded.graph[o.instance]
        corners = trimesh.transform_points(loaded.geometry[geometry].vertices, world_from_node)
        expected = posed(solid, o.instance).vertices
        np.testing.assert_allclose(corners.min(axis=0), expected.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(corners.max(axis=0), expected.max(axis=0), atol=1e-6)
    world_from_table, geometry = loaded.graph["table"]
    top = trimesh.transform_points(loaded.geometry[geometry].vertices, world_from_table)
    np.testing.assert_allclose(top.max(axis=0), [*scene.table.size_xy, 0.0], atol=1e-7)
    np.testing.assert_allclose(top.min(axis=0)[:2], 0.0, atol=1e-7)


def test_objects_of_one_asset_share_its_mesh(store: AssetStore, tmp_path: Path) -> None:
    loaded = load(at_rest(), store, tmp_path)
    assert loaded.graph["0_can_0"][1] == loaded.graph["4_can_1"][1]
    assert len(loaded.geometry) == 2 + 4 + 1  # table and zone, four assets, a box


def test_a_node_says_what_it_is(store: AssetStore, tmp_path: Path) -> None:
    loaded = load(at_rest(), store, tmp_path)
    extras = loaded.graph.transforms.edge_data["scene", ODD_INSTANCE]["metadata"]
    assert extras["category"] == "mug"
    assert extras["description"] == "such a thing"


def test_an_empty_scene_is_a_table(store: AssetStore, tmp_path: Path) -> None:
    assert load(EMPTY, store, tmp_path).graph.nodes_geometry == ["table"]


def test_the_same_scene_gives_the_same_bytes(store: AssetStore) -> None:
    first, second = (glb.scene_glb(SceneGeometry.of(at_rest(), store)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("name", ["a/b", "..", "", "x" * 300])
def test_any_name_of_a_scene_is_a_file_of_the_folder(name: str, store: AssetStore, tmp_path: Path) -> None:
    scene = Scene(name, EMPTY.table, ())
    glb.export_scene(SceneGeometry.of(scene, store), tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
