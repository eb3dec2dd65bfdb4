"""Scenes as worlds of SDFormat."""

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.export import sdformat
from stable_data.export.props import placed_props, prop_parts
from stable_data.export.scene_files import camera_poses
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import TABLE_DEPTH
from tests.stable_data.export.runs import EMPTY, TABLE, at_rest, falling

pytestmark = pytest.mark.sim

NAMES = {"stable_data": "urn:stable-data", "drake": "http://drake.mit.edu"}


def opened(geometry: SceneGeometry, out: Path) -> tuple[ET.Element, Path]:
    """The world of a scene, and its folder."""
    sdformat.export_scene(geometry, out)
    path = sdformat.scene_path(geometry.scene, out)
    root = ET.fromstring(path.read_text("utf-8"))  # noqa: S314
    assert root.attrib["version"] == "1.9"
    world = root.find("world")
    assert world is not None
    return world, path.parent


def numbers(element: ET.Element, path: str) -> list[float]:
    text = element.findtext(path)
    assert text is not None
    return [float(n) for n in text.split()]


def meshes_exist(element: ET.Element, folder: Path) -> bool:
    uris = [uri.text or "" for uri in element.iter("uri")]
    return bool(uris) and all((folder / uri).is_file() for uri in uris)


@pytest.mark.parametrize("scene", [at_rest(), falling(), EMPTY], ids=lambda scene: scene.scene_id)
def test_masses_poses_and_parts_read_back(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(replace(scene, fixed=frozenset({"2_plate_0"})), store)
    world, folder = opened(geometry, tmp_path)
    table, *models = world.findall("model")
    assert table.attrib["name"] == "table"
    for model, placed in zip(models, placed_props(geometry), strict=True):
        assert model.attrib["name"] == placed.name
        assert model.findtext("static") == ("true" if placed.is_fixed else "false")
        assert numbers(model, "pose") == [*placed.position, *placed.quat_xyzw]
        [link] = model.findall("link")
        assert numbers(link, "inertial/mass") == [placed.mass.mass]
        assert numbers(link, "inertial/pose") == [*placed.mass.center_of_mass, 0, 0, 0]
        found = [numbers(link, f"inertial/inertia/{name}")[0] for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
        np.testing.assert_array_equal(found, placed.mass.inertia[np.triu_indices(3)])
        collisions = link.findall("collision")
        assert len(collisions) == len(prop_parts(placed.prop, store))
        for collision in collisions:
            assert collision.find("geometry/mesh/drake:declare_convex", NAMES) is not None
            assert numbers(collision, "surface/friction/ode/mu") == [0.8]
            scale = [1.0] * 3 if collision.find("geometry/mesh/scale") is None else numbers(collision, "geometry/mesh/scale")
            assert scale == [placed.factor] * 3
        assert meshes_exist(model, folder)


def test_physics_gravity_table_and_facts_are_explicit(store: AssetStore, tmp_path: Path) -> None:
    world, folder = opened(SceneGeometry.of(at_rest(), store), tmp_path)
    assert numbers(world, "gravity") == [0, 0, -9.81]
    assert numbers(world, "physics/max_step_size") == [0.002]
    [table] = [model for model in world.findall("model") if model.attrib["name"] == "table"]
    assert table.findtext("static") == "true"
    assert numbers(table, "link/collision/geometry/box/size") == [*TABLE.size_xy, TABLE_DEPTH]
    assert meshes_exist(table, folder)
    facts = json.loads(world.findtext("stable_data:scene", None, NAMES) or "")
    assert facts["task"]["instruction"] == "Put the can on the plate."
    assert [known["instance"] for known in facts["objects"].values()] == [o.instance for o in at_rest().objects]


def test_the_camera_looks_along_its_x(store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(at_rest(), store)
    world, _ = opened(geometry, tmp_path)
    found = numbers(world, "gui/camera/pose")
    (_, position, quat_xyzw), *_ = camera_poses(geometry)
    assert found[:3] == list(position)
    theirs, ours = Rotation.from_quat(found[3:]), Rotation.from_quat(quat_xyzw)
    np.testing.assert_allclose(theirs.apply([[1, 0, 0], [0, 0, 1]]), ours.apply([[0, 0, -1], [0, 1, 0]]), atol=1e-12)


def test_a_model_is_the_object_of_the_world_at_its_size(store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(at_rest(), store)
    world, _ = opened(geometry, tmp_path)
    masses = {numbers(model, "link/inertial/mass")[0] for model in world.findall("model") if model.find("link/inertial")}
    folders = sorted((tmp_path / "models").iterdir())
    assert len(folders) == 5  # two cans are one model
    for folder in folders:
        model = ET.fromstring((folder / "model.sdf").read_text("utf-8")).find("model")  # noqa: S314
        assert model is not None
        assert model.attrib["name"] == folder.name
        assert numbers(model, "link/inertial/mass")[0] in masses
        assert meshes_exist(model, folder)
        config = ET.fromstring((folder / "model.config").read_text("utf-8"))  # noqa: S314
        assert config.findtext("sdf") == "model.sdf"


def test_words_that_xml_does_not_take(store: AssetStore, tmp_path: Path) -> None:
    odd = "a\x00\ufffe <b> ]]> &amp; é"
    first = replace(at_rest().objects[0], description=odd)
    world, _ = opened(SceneGeometry.of(replace(at_rest(), objects=(first,)), store), tmp_path)
    facts = json.loads(world.findtext("stable_data:scene", None, NAMES) or "")
    assert [known["description"] for known in facts["objects"].values()] == [odd]
    assert sdformat._plain("\x01mug\x02;\ufffe\n é") == "mug ; é"


def test_what_the_support_shows_is_not_drawn_twice(store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(at_rest(), store)
    unseen = replace(placed_props(geometry)[0], is_seen=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sdformat, "placed_props", lambda _: [unseen])
        world, _ = opened(geometry, tmp_path)
    _, model = world.findall("model")
    assert not model.findall("link/visual")
    assert model.findall("link/collision")
