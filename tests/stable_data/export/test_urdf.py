"""Scenes as URDF files and a file of poses."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.export import scene_files, urdf
from stable_data.export.props import placed_props, prop_parts
from stable_data.scene import Relation, RelationKind, Scene
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import TABLE_DEPTH
from tests.stable_data.export.runs import EMPTY, ODD_INSTANCE, TABLE, at_rest, falling, thing, weighed, write_run

pytestmark = pytest.mark.sim


def opened(geometry: SceneGeometry, out: Path) -> tuple[dict[str, Any], Path]:
    """The file of a scene, and its folder."""
    urdf.export_scene(geometry, out)
    path = urdf.scene_path(geometry.scene, out)
    return json.loads(path.read_text("utf-8")), path.parent


def numbers(element: ET.Element | None, name: str) -> list[float]:
    assert element is not None
    return [float(n) for n in element.attrib[name].split()]


def tensor(link: ET.Element) -> np.ndarray[Any, np.dtype[np.float64]]:
    inertia = link.find("inertial/inertia")
    assert inertia is not None
    (xx, xy, xz, yy, yz, zz) = (float(inertia.attrib[key]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@pytest.mark.parametrize("scene", [at_rest(), falling(), EMPTY], ids=lambda scene: scene.scene_id)
def test_masses_poses_and_parts_read_back(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(scene, store)
    layout, folder = opened(geometry, tmp_path)
    for entry, placed in zip(layout["objects"], placed_props(geometry), strict=True):
        assert entry["name"] == placed.name
        assert entry["instance"] == placed.object.instance
        assert entry["position"] == list(placed.position)
        assert entry["quat_xyzw"] == list(placed.quat_xyzw)
        path = folder / entry["urdf"]
        robot = ET.fromstring(path.read_text("utf-8"))  # noqa: S314
        [link] = robot.findall("link")
        assert link.attrib["name"] == robot.attrib["name"] == path.stem
        assert numbers(link.find("inertial/mass"), "value") == [placed.mass.mass]
        assert numbers(link.find("inertial/origin"), "xyz") == list(placed.mass.center_of_mass)
        np.testing.assert_allclose(tensor(link), placed.mass.inertia, atol=1e-12 * placed.mass.moments[2])
        parts = prop_parts(placed.prop, store)
        assert len(link.findall("collision")) == len(parts)
        for mesh in link.iterfind(".//mesh"):
            assert (path.parent / mesh.attrib["filename"]).is_file()
            assert numbers(mesh, "scale") if placed.factor != 1 else "scale" not in mesh.attrib
            assert placed.factor == 1 or numbers(mesh, "scale") == [placed.factor] * 3


def test_the_table_is_a_box_in_the_frame_of_the_world(store: AssetStore, tmp_path: Path) -> None:
    layout, folder = opened(SceneGeometry.of(at_rest(), store), tmp_path)
    table = layout["table"]
    assert (table["position"], table["quat_xyzw"], table["fixed"]) == ([0, 0, 0], [0, 0, 0, 1], True)
    link = ET.fromstring((folder / table["urdf"]).read_text("utf-8")).find("link")  # noqa: S314
    assert link is not None
    [collision] = link.findall("collision")
    x, y = TABLE.size_xy
    assert numbers(collision.find("geometry/box"), "size") == [x, y, TABLE_DEPTH]
    assert numbers(collision.find("origin"), "xyz") == [x / 2, y / 2, -TABLE_DEPTH / 2]
    assert link.findall("visual")


def test_a_known_friction_and_what_does_not_move(tmp_path: Path) -> None:
    run = weighed(write_run(tmp_path / "run"), "can/0")
    store = AssetStore(RunAssets(run, tmp_path / "files"))
    scene = replace(at_rest(), fixed=frozenset({"2_plate_0"}))
    layout, folder = opened(SceneGeometry.of(scene, store), tmp_path / "out")
    entries = {entry["instance"]: entry for entry in layout["objects"]}
    assert [name for name, entry in entries.items() if entry["fixed"]] == ["2_plate_0"]
    assert (entries["0_can_0"]["friction"], entries["2_plate_0"]["friction"]) == (0.25, 0.8)
    text = (folder / entries["0_can_0"]["urdf"]).read_text("utf-8")
    assert '<lateral_friction value="0.25" />' in text
    assert '<drake:mu_static value="0.25" />' in text
    assert "<mu1>0.25</mu1>" in text


def test_facts_of_the_scene(store: AssetStore, tmp_path: Path) -> None:
    relation = Relation("4_can_1", RelationKind.ON, "3_cereal_box_0")
    geometry = SceneGeometry.of(replace(at_rest(), relations=(relation,)), store)
    geometry = replace(geometry, verdicts={"stable": True, "drift_mm": 0.5, "jitter_mm": None, "max_gap_mm": float("inf")})
    layout, _ = opened(geometry, tmp_path)
    assert layout["task"]["instruction"] == "Put the can on the plate."
    assert layout["relations"] == [{"subject": "4_can_1", "kind": "on", "target": "3_cereal_box_0"}]
    assert layout["verdicts"] == {"stable": True, "drift_mm": 0.5, "jitter_mm": None, "max_gap_mm": None}
    assert [camera["name"] for camera in layout["cameras"]] == ["front", "top"]


def test_objects_of_one_asset_share_meshes_and_files_of_one_size(store: AssetStore, tmp_path: Path) -> None:
    scene = at_rest()
    larger = thing("can/0", "larger", 0.9, 0.6, 0.0, scale=(1.5, 1.5, 1.5))
    layout, folder = opened(SceneGeometry.of(replace(scene, objects=(*scene.objects[:4], larger)), store), tmp_path)
    first, second = (folder / layout["objects"][k]["urdf"] for k in (0, 4))
    assert first.parent.resolve() == second.parent.resolve()
    assert first.name != second.name
    layout, _ = opened(SceneGeometry.of(replace(scene, scene_id="again"), store), tmp_path)
    assert layout["objects"][0]["urdf"] == layout["objects"][4]["urdf"]


def test_names_are_those_of_bodies_and_differ_without_case(store: AssetStore, tmp_path: Path) -> None:
    one, two, *_ = at_rest().objects
    objects = (replace(one, instance="Mug"), replace(two, instance="mug", position=(0.9, 0.6, 0.1)))
    layout, _ = opened(SceneGeometry.of(replace(at_rest(), objects=objects), store), tmp_path)
    assert len({entry["name"].lower() for entry in layout["objects"]}) == 2
    layout, _ = opened(SceneGeometry.of(replace(at_rest(), scene_id="b"), store), tmp_path)
    [odd] = [entry for entry in layout["objects"] if entry["instance"] == ODD_INSTANCE]
    assert odd["name"].isascii()
    assert not set(odd["name"]) & set('#<&"/ ')


def test_what_the_support_shows_is_not_drawn_twice(store: AssetStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    geometry = SceneGeometry.of(at_rest(), store)
    seen = placed_props(geometry)[0]
    monkeypatch.setattr(scene_files, "placed_props", lambda _: [seen, replace(seen, name="other", is_seen=False)])
    layout, folder = opened(geometry, tmp_path)
    drawn, unseen = (ET.fromstring((folder / o["urdf"]).read_text("utf-8")) for o in layout["objects"])  # noqa: S314
    assert len(drawn.findall(".//collision")) == len(unseen.findall(".//collision"))
    assert drawn.findall(".//visual//mesh")
    assert not unseen.findall(".//visual//mesh")
