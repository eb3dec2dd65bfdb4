"""Scenes as binary glTF, as trimesh reads them."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from stable_data.assets.store import AssetStore
from stable_data.export import glb
from stable_data.scene import Scene
from stable_data.simulation.room import design_of
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
    assert node_names(loaded) == {"table", "restricted_zone", *(o.instance for o in scene.objects)}
    for o in scene.objects:
        world_from_node, geometry = loaded.graph[o.instance]
        corners = trimesh.transform_points(loaded.geometry[geometry].vertices, world_from_node)
        expected = posed(solid, o.instance).vertices
        np.testing.assert_allclose(corners.min(axis=0), expected.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(corners.max(axis=0), expected.max(axis=0), atol=1e-6)
    table = np.concatenate([loaded.geometry[name].vertices for name in loaded.geometry if name.startswith("table")])
    np.testing.assert_allclose(table.max(axis=0), [*scene.table.size_xy, 0.0], atol=1e-7)
    np.testing.assert_allclose(table.min(axis=0)[0], 0.0, atol=1e-7)
    assert table.min(axis=0)[2] < -0.4  # it has legs


def test_the_table_has_the_material_of_pictures(store: AssetStore, tmp_path: Path) -> None:
    top = load(EMPTY, store, tmp_path).geometry["table"]
    material = design_of(EMPTY.table.table_type).top
    assert material.image is not None
    image = top.visual.material.baseColorTexture
    assert (image.width, image.height) == Image.open(io.BytesIO(material.image)).size
    upper = top.triangles[(top.face_normals[:, 2] > 0.99) & (top.triangles_center[:, 2] > -1e-6)]
    np.testing.assert_allclose(upper.reshape(-1, 3).max(axis=0)[:2], EMPTY.table.size_xy, atol=0.005)


def node_names(loaded: trimesh.Scene) -> set[str]:
    """Nodes with a mesh; trimesh makes a node below them for each material."""
    parents = loaded.graph.transforms.parents
    return {node if parents[node] == "scene" else parents[node] for node in loaded.graph.nodes_geometry}


def test_objects_of_one_asset_share_its_mesh(store: AssetStore, tmp_path: Path) -> None:
    loaded = load(at_rest(), store, tmp_path)
    assert loaded.graph["0_can_0"][1] == loaded.graph["4_can_1"][1]
    of_table = {name for name in loaded.geometry if name.startswith(("table", "restricted_zone"))}
    assert len(loaded.geometry) - len(of_table) == 4 + 1  # four assets, a box


def test_a_node_says_what_it_is(store: AssetStore, tmp_path: Path) -> None:
    loaded = load(at_rest(), store, tmp_path)
    extras = loaded.graph.transforms.edge_data["scene", ODD_INSTANCE]["metadata"]
    assert extras["category"] == "mug"
    assert extras["description"] == "such a thing"
    assert "fixed" not in extras
    fixed = load(replace(at_rest(), fixed=frozenset({ODD_INSTANCE})), store, tmp_path)
    assert fixed.graph.transforms.edge_data["scene", ODD_INSTANCE]["metadata"]["fixed"] is True


def test_an_empty_scene_is_a_table(store: AssetStore, tmp_path: Path) -> None:
    assert node_names(load(EMPTY, store, tmp_path)) == {"table"}


def test_the_same_scene_gives_the_same_bytes(store: AssetStore) -> None:
    first, second = (glb.scene_glb(SceneGeometry.of(at_rest(), store)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("name", ["a/b", "..", "", "x" * 300])
def test_any_name_of_a_scene_is_a_file_of_the_folder(name: str, store: AssetStore, tmp_path: Path) -> None:
    scene = Scene(name, EMPTY.table, ())
    glb.export_scene(SceneGeometry.of(scene, store), tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
