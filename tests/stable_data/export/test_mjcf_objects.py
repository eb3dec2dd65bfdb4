"""Scenes as MJCF objects of robosuite and RoboCasa, and a file of poses; MuJoCo opens them."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from stable_data.assets.store import AssetStore
from stable_data.export import mjcf_objects
from stable_data.export.props import placed_props, prop_parts
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import TABLE_DEPTH
from tests.stable_data.export.runs import EMPTY, TABLE, at_rest, falling

pytestmark = pytest.mark.sim


def opened(geometry: SceneGeometry, out: Path) -> tuple[dict[str, Any], Path]:
    """The file of a scene, and its folder."""
    mjcf_objects.export_scene(geometry, out)
    path = mjcf_objects.scene_path(geometry.scene, out)
    return json.loads(path.read_text("utf-8")), path.parent


@pytest.mark.parametrize("scene", [at_rest(), falling(), EMPTY], ids=lambda scene: scene.scene_id)
def test_mujoco_opens_each_object_as_it_is(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(scene, store)
    layout, folder = opened(geometry, tmp_path)
    for entry, placed in zip(layout["objects"], placed_props(geometry), strict=True):
        assert (entry["position"], entry["quat_xyzw"]) == (list(placed.position), list(placed.quat_xyzw))
        model = mujoco.MjModel.from_xml_path(str(folder / entry["mjcf"]))
        body = model.body("object")
        np.testing.assert_allclose(body.mass, placed.mass.mass, rtol=1e-12)
        np.testing.assert_allclose(body.ipos, placed.mass.center_of_mass, atol=1e-12)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, body.iquat)
        turn = axes.reshape(3, 3)
        np.testing.assert_allclose((turn * body.inertia) @ turn.T, placed.mass.inertia, atol=1e-9 * placed.mass.moments[2])
        groups = {name: [k for k in range(model.ngeom) if model.geom_group[k] == n] for name, n in (("hit", 0), ("seen", 1))}
        assert len(groups["hit"]) == len(prop_parts(placed.prop, store))
        assert all(model.geom_contype[k] == 1 for k in groups["hit"])
        assert all(model.geom_contype[k] == model.geom_conaffinity[k] == 0 for k in groups["seen"])
        assert len(groups["hit"]) + len(groups["seen"]) == model.ngeom


def test_the_box_is_in_the_sites_and_in_the_region(store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(at_rest(), store)
    layout, folder = opened(geometry, tmp_path)
    for entry, placed in zip(layout["objects"], placed_props(geometry), strict=True):
        model = mujoco.MjModel.from_xml_path(str(folder / entry["mjcf"]))
        x, y, z = np.array(placed.prop.size) * placed.factor
        np.testing.assert_allclose(entry["size"], (x, y, z))
        np.testing.assert_allclose(model.site("bottom_site").pos, (0, 0, 0), atol=1e-12)
        np.testing.assert_allclose(model.site("top_site").pos, (0, 0, z), atol=1e-12)
        np.testing.assert_allclose(model.site("horizontal_radius_site").pos, (x / 2, y / 2, z / 2), atol=1e-12)
        region = model.geom("reg_bbox")
        np.testing.assert_allclose(region.pos, (0, 0, z / 2), atol=1e-12)
        np.testing.assert_allclose(region.size, (x / 2, y / 2, z / 2), atol=1e-12)
        # The box is that of the mesh.
        points = [
            model.mesh_vert[model.mesh_vertadr[m] : model.mesh_vertadr[m] + model.mesh_vertnum[m]] for m in range(model.nmesh)
        ]
        assert sum(map(len, points)) > 0


def test_a_table_is_a_box_that_collides(store: AssetStore, tmp_path: Path) -> None:
    layout, folder = opened(SceneGeometry.of(EMPTY, store), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(folder / layout["table"]["mjcf"]))
    top = model.geom("top")
    x, y = EMPTY.table.size_xy
    np.testing.assert_allclose(top.size, (x / 2, y / 2, TABLE_DEPTH / 2))
    np.testing.assert_allclose(top.pos, (x / 2, y / 2, -TABLE_DEPTH / 2))
    assert layout["table"]["size"] == [x, y, TABLE_DEPTH]
    assert TABLE.size_xy != (x, y)


def test_a_folder_of_an_object_is_complete(store: AssetStore, tmp_path: Path) -> None:
    layout, folder = opened(SceneGeometry.of(at_rest(), store), tmp_path / "out")
    first = (folder / layout["objects"][0]["mjcf"]).resolve()
    moved = first.parent.rename(tmp_path / "elsewhere")
    assert mujoco.MjModel.from_xml_path(str(moved / first.name)).nbody == 3
