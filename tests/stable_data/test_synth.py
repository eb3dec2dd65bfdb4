import json
from pathlib import Path

import manifold3d
import numpy as np
import pytest

from stable_data.errors import ConfigError, SceneError
from stable_data.export.glb import write_glb
from stable_data.glb import load_glb
from stable_data.mesatask import MesaTaskDataset
from stable_data.repair import repair
from stable_data.scene import Tabletop
from stable_data.synth import arrangement, write_embedded_set
from stable_data.synth.assets import asset, unit_cube
from stable_data.synth.catalogue import CATALOGUE, LAID
from stable_data.synth.placing import place, yaw_frame_parts
from stable_data.synth.plans import TABLES, Spot
from stable_data.synth.scenes import TABLE_UID, make_scene, scene_id_of, table_type_of
from stable_data.synth.settling import audit, instance_names, is_at_rest
from stable_data.synth.solids import Solid, bar, box, lathe, mesh_of, slab, turned_vessel, volume

pytestmark = pytest.mark.sim

NUM_WRITTEN = 2


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("embedded")
    assert write_embedded_set(out, NUM_WRITTEN, pictures=False) == NUM_WRITTEN
    return out


@pytest.mark.parametrize(
    ("solid", "expected"),
    [
        (box(0.1, 0.2, 0.3), 0.006),
        (lathe([(0.1, 0.0), (0.1, 0.2)]), 24 * 0.01 * np.sin(np.pi / 24) * 0.2),
        (bar([(0.0, 0.0), (0.1, 0.0)], 0.02, 0.02, corners=4), 0.1 * 0.02**2 / 2),
    ],
)
def test_volume_of_a_solid_is_the_analytic_one(solid: Solid, expected: float) -> None:
    assert volume(mesh_of(solid)[0]) == pytest.approx(expected)


def test_slab_is_one_convex_part() -> None:
    assert len(slab(0.1, 0.08, 0.03, 0.004).parts) == 1


def test_vessel_is_hollow() -> None:
    cup = turned_vessel([(0.05, 0.0), (0.05, 0.1)], [(0.04, 0.01), (0.04, 0.1)])
    area = 24 * 0.05**2 * np.sin(np.pi / 24)
    hollow = 12 * 0.04**2 * np.sin(np.pi / 12)
    assert volume(mesh_of(cup)[0]) == pytest.approx(area * 0.1 - hollow * 0.09)
    assert len(cup.parts) == 1 + 24


def test_turned_and_moved_solid_keeps_its_volume() -> None:
    solid = slab(0.1, 0.08, 0.03, 0.004)
    assert volume(mesh_of(solid.turned(20, 30, 40).moved(1, 2, 3))[0]) == pytest.approx(volume(mesh_of(solid)[0]))


@pytest.mark.parametrize("key", CATALOGUE)
def test_asset_is_closed_centred_and_the_union_of_its_convex_parts(key: str) -> None:
    made = asset(key)
    edges = np.sort(made.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    np.testing.assert_allclose(made.mesh.vertices.min(axis=0), -made.mesh.vertices.max(axis=0), atol=1e-12)
    hulls = [manifold3d.Manifold.hull_points(part.vertices) for part in made.parts]
    union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
    assert union.volume() == pytest.approx(volume(made.mesh), rel=1e-6)
    for part, hull in zip(made.parts, hulls, strict=True):
        assert volume(part) == pytest.approx(hull.volume(), rel=1e-9)
    assert 0.002 < made.mass < 4.0


def test_asset_has_one_connected_solid() -> None:
    for key in CATALOGUE:
        mesh = asset(key).mesh
        assert repair(mesh, key)[1].num_components == 1, key


@pytest.mark.parametrize("key", ["mug/tall", "mug/wide", "bowl/fruit", "plate/side", "lamp/desk"])
def test_glb_reads_back_at_its_unit_whatever_its_nodes(key: str) -> None:
    made = asset(key)
    mesh, notices = load_glb(made.glb, key)
    assert not notices
    np.testing.assert_allclose(mesh.extents * made.spec.unit, made.mesh.extents, rtol=1e-6)
    assert volume(mesh) * made.spec.unit**3 == pytest.approx(volume(made.mesh), rel=1e-5)
    handle_side = made.mesh.vertices[np.abs(made.mesh.vertices[:, 0]).argmax(), 0]
    assert np.isclose(mesh.vertices[:, 0] * made.spec.unit, handle_side, rtol=1e-5).any()


def test_uids_are_hexadecimal_and_distinct() -> None:
    uids = {asset(key).uid for key in CATALOGUE}
    assert len(uids) == len(CATALOGUE)
    assert all(len(uid) == 32 and int(uid, 16) >= 0 for uid in uids)


def test_glb_is_the_same_bytes_every_time() -> None:
    assert write_glb(unit_cube(), is_z_up=True) == write_glb(unit_cube(), is_z_up=True)


def test_unknown_asset_is_named() -> None:
    with pytest.raises(ConfigError, match="'mug/none' is not in the catalogue"):
        asset("mug/none")


def test_tilted_parts_stay_around_the_box_centre() -> None:
    made = asset("bottle/wine")
    corners = np.concatenate([part.vertices for part in yaw_frame_parts(made, 1.1, LAID)])
    np.testing.assert_allclose(corners.min(axis=0), -corners.max(axis=0), atol=1e-9)
    assert np.ptp(corners, axis=0)[1] == pytest.approx(1.1 * made.mesh.extents[2])


def test_group_that_does_not_fit_is_left_out_or_fatal(rng: np.random.Generator) -> None:
    table = Tabletop("office_table", (0.2, 0.2))
    tray = Spot(arrangement.tea_tray, (0.5, 0.5), (0.5, 0.5))
    assert place([tray], table, rng) == []
    assert place([Spot(tray.arrange, tray.x, tray.y, may_miss=False)], table, rng) is None


def test_lowered_things_are_just_clear(rng: np.random.Generator) -> None:
    placed = place([Spot(arrangement.boxes, (0.5, 0.5), (0.5, 0.5))], Tabletop("office_table", (1.0, 0.6)), rng)
    assert placed is not None
    low, high = placed
    gap = high.z - high.shape.size[2] / 2 - (low.z + low.shape.size[2] / 2)
    assert 0 < gap < 1e-4


def test_instance_names_count_all_and_each_kind() -> None:
    assert instance_names(["mug", "pen", "mug"]) == ["1_mug_0", "2_pen_0", "3_mug_1"]


def test_tables_are_taken_in_turn() -> None:
    assert {table_type_of(k) for k in range(len(TABLES))} == set(TABLES)
    assert scene_id_of(7) == "coffee_table_0007"


def test_made_scene_is_clean_at_rest_and_repeats() -> None:
    made, again = make_scene(17, seed=3), make_scene(17, seed=3)
    assert made.scene == again.scene
    assert audit(made.scene, made.placed).card().clean
    assert is_at_rest(made.scene, made.placed)
    assert make_scene(17, seed=4).scene != made.scene


def test_kitchen_crate_holds_a_bowl_that_holds_a_fruit() -> None:
    made = make_scene(4)
    verdicts = {o.instance: o.supports for o in audit(made.scene, made.placed).objects}
    fruit = next(name for name in verdicts if "orange" in name or "apple" in name)
    (bowl,) = verdicts[fruit]
    assert "bowl" in bowl
    assert "crate" in verdicts[bowl][0]


def test_scene_that_never_passes_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.synth.scenes._ATTEMPTS", 2)
    with pytest.raises(SceneError, match="came to rest clean") as caught:
        make_scene(9, is_clean=lambda _: False)
    assert caught.value.code == "synth_failed"


def test_written_set_reads_back_as_made(written: Path) -> None:
    dataset = MesaTaskDataset(written)
    for number in range(NUM_WRITTEN):
        made = make_scene(number).scene
        scene, notices = _read(dataset, number)
        assert not notices
        assert scene.table == made.table
        np.testing.assert_allclose(scene.poses(), made.poses(), atol=1e-12)
        assert [o.asset_id for o in scene.objects] == [o.asset_id for o in made.objects]


def _read(dataset: MesaTaskDataset, number: int):  # type: ignore[no-untyped-def]
    scene_id = next(found for found in dataset.scene_ids if scene_id_of(number) in found)
    return dataset.read(scene_id)


def test_written_set_has_the_format_s_files(written: Path) -> None:
    annotations = json.loads((written / "Asset_annotation.json").read_text())
    assert annotations[asset("mug/tall").uid]["isContainer"] is True
    assert annotations[TABLE_UID]["onTable"] is False
    assert {path.stem for path in (written / "Assets_library").iterdir()} == set(annotations)
    layout = json.loads((written / "Layout_info/bathroom_vanity/bathroom_vanity_0000/layout.json").read_text())
    assert len(layout["restricted_zone"]) == 4
    for entry in layout["objects"]:
        assert len(entry["original_size"]) == len(entry["scale_factor"]) == 3


def test_task_info_lies_beside_every_second_scene(written: Path) -> None:
    assert (written / "Layout_info/bathroom_vanity/bathroom_vanity_0000/task_info.json").is_file()
    assert not (written / "Layout_info/coffee_table/coffee_table_0001/task_info.json").exists()


def test_second_run_leaves_what_is_there_and_adds_what_is_missing(written: Path) -> None:
    kept = written / "Layout_info/bathroom_vanity/bathroom_vanity_0000/layout.json"
    missing = written / "Layout_info/coffee_table/coffee_table_0001"
    before = (missing / "layout.json").read_bytes()
    for path in missing.iterdir():
        path.unlink()
    stamp, done = kept.stat().st_mtime_ns, []
    write_embedded_set(written, NUM_WRITTEN, progress=lambda k, n: done.append((k, n)), pictures=False)
    assert kept.stat().st_mtime_ns == stamp
    assert (missing / "layout.json").read_bytes() == before
    assert done == [(1, 2), (2, 2)]
    assert not [path for path in written.iterdir() if path.name.startswith(".")]


def test_count_below_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="num_scenes is 0"):
        write_embedded_set(tmp_path, 0)
