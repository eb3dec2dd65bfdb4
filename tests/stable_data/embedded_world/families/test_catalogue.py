"""Every asset: a closed solid, the union of its convex parts, at rest where it stands, named, and read back from its file."""

from pathlib import Path

import manifold3d
import numpy as np
import pytest

from stable_data.embedded_world.families import FAMILIES
from stable_data.embedded_world.families.catalogue import BY_CATEGORY, KEYS, NUM_VARIANTS, asset, unit_cube
from stable_data.embedded_world.handles import is_of_handle
from stable_data.embedded_world.modelling.family import COLORS, DENSITY, LAID, STANDING
from stable_data.embedded_world.modelling.solids import volume
from stable_data.embedded_world.placing import yaw_frame_parts
from stable_data.errors import ConfigError
from stable_data.geometry.convex_decomposition import convex_parts
from stable_data.geometry.gltf_reader import load_colliders, load_glb
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import area_vectors
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.scene import Tabletop
from stable_data.simulation.settling import PhysicsOptions, RigidBody, settle

pytestmark = pytest.mark.sim

CATEGORIES = tuple(BY_CATEGORY)


def test_there_are_enough_kinds_of_assets() -> None:
    assert len(CATEGORIES) >= 80
    assert NUM_VARIANTS >= 4
    assert len(BY_CATEGORY) == len(FAMILIES)


@pytest.mark.parametrize("category", CATEGORIES)
def test_assets_of_a_family_are_sound(category: str) -> None:
    for number in range(NUM_VARIANTS):
        made = asset(f"{category}/{number}")
        edges = np.sort(made.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
        np.testing.assert_allclose(made.mesh.vertices.min(axis=0), -made.mesh.vertices.max(axis=0), atol=1e-12)
        hulls = [manifold3d.Manifold.hull_points(part.vertices) for part in made.parts]
        union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
        assert union.volume() == pytest.approx(volume(made.mesh), rel=1e-5)
        assert 0.001 < made.mass < 12.0
        assert 0.008 < max(made.mesh.extents) < 0.75
        assert made.material in DENSITY
        assert made.color.startswith("#")
        assert len(set(made.captions)) >= 3
        assert all(caption == caption.strip(". ") and caption[0].islower() for caption in made.captions)
        assert sum(len(rows) for _, rows in made.paint) == len(made.mesh.faces)
        for space in (made.top, made.hollow):
            if space is not None:
                assert -made.mesh.extents[2] / 2 < space.z <= made.mesh.extents[2] / 2 + 1e-9
                assert (np.array([space.width, space.depth]) <= made.mesh.extents[:2] + 1e-9).all()
        if made.handle:  # a part of the surface, and not all of it
            areas = np.linalg.norm(area_vectors(made.mesh.triangles), axis=1)
            assert 0.02 < areas[is_of_handle(made.mesh, made.handle)].sum() / areas.sum() < 0.9


@pytest.mark.parametrize("category", CATEGORIES)
def test_variants_of_a_family_differ_and_stand_still(category: str) -> None:
    made = [asset(f"{category}/{number}") for number in range(NUM_VARIANTS)]
    sizes = {tuple(np.round(1e3 * one.mesh.extents).tolist()) for one in made}
    assert len(sizes) >= 4
    one = made[sum(map(ord, category)) % NUM_VARIANTS]
    parts = yaw_frame_parts(one, (1.0, 1.0, 1.0), one.tilts[0])
    height = np.concatenate([part.vertices for part in parts])[:, 2].max()
    options = PhysicsOptions(settle_seconds=0.5, watch_seconds=0.1)
    result = settle(
        [RigidBody("it", parts, one.mass, (0.5, 0.5, height + 5e-5))], Tabletop("office_table", (1.0, 1.0)), options
    )
    assert result.settle_move_max_mm is not None
    assert result.settle_move_max_mm < 3.0
    assert result.settle_turn_max_deg is not None
    assert result.settle_turn_max_deg < 2.0


def test_asset_is_one_connected_solid() -> None:
    for category in CATEGORIES:
        key = f"{category}/{len(category) % NUM_VARIANTS}"
        assert repair_mesh(asset(key).mesh, key)[1].num_components == 1, key


def test_uids_are_hexadecimal_and_distinct() -> None:
    uids = {asset(key).uid for key in KEYS}
    assert len(uids) == len(KEYS)
    assert all(len(uid) == 32 and int(uid, 16) >= 0 for uid in uids)


@pytest.mark.parametrize("category", ["mug", "laptop", "fork", "desk_lamp", "apple"])
def test_file_reads_back_at_its_unit_with_its_parts_whatever_its_nodes(category: str) -> None:
    for number in range(NUM_VARIANTS):
        made = asset(f"{category}/{number}")
        mesh, notices = load_glb(made.glb, made.key)
        assert not notices
        np.testing.assert_allclose(mesh.extents * made.unit, made.mesh.extents, rtol=1e-5)
        assert volume(mesh) * made.unit**3 == pytest.approx(volume(made.mesh), rel=1e-4)
        parts = load_colliders(made.glb, made.key)
        assert len(parts) == len(made.parts)
        for part, original in zip(parts, made.parts, strict=True):
            np.testing.assert_allclose(part.vertices.mean(axis=0) * made.unit, original.vertices.mean(axis=0), atol=1e-6)
            assert volume(part) * made.unit**3 == pytest.approx(volume(original), rel=1e-3)


def test_parts_that_come_with_a_file_are_taken_for_the_engine(tmp_path: Path) -> None:
    made = asset("mug/0")
    path = tmp_path / "mug.glb"
    path.write_bytes(made.glb)
    mesh, _ = load_glb(path, "mug")
    found = convex_parts(mesh, given=load_colliders(path, "mug"))
    assert found.method == "given"
    assert max(found.overfill_max, found.uncovered_max) * made.unit < 1e-6
    assert convex_parts(mesh, given=load_colliders(asset("plate/0").glb, "plate")).method != "given"


def test_file_without_parts_has_none() -> None:
    assert load_colliders(write_glb(unit_cube()), "cube") == ()


def test_glb_is_the_same_bytes_every_time() -> None:
    assert write_glb(unit_cube(), is_z_up=True) == write_glb(unit_cube(), is_z_up=True)
    assert asset("mug/1").glb == asset.__wrapped__("mug/1").glb


def test_unknown_asset_is_named() -> None:
    with pytest.raises(ConfigError, match="'mug/99' is not in the catalogue"):
        asset("mug/99")


def test_tilted_parts_stay_around_the_box_centre() -> None:
    made = asset("bottle/0")
    corners = np.concatenate([part.vertices for part in yaw_frame_parts(made, (1.1, 1.1, 1.1), LAID)])
    np.testing.assert_allclose(corners.min(axis=0), -corners.max(axis=0), atol=1e-9)
    assert np.ptp(corners, axis=0)[1] == pytest.approx(1.1 * made.mesh.extents[2])


def test_some_assets_rest_in_several_ways() -> None:
    assert sum(asset(f"{category}/0").tilts != STANDING for category in CATEGORIES) >= 6
    assert all(color.startswith("#") and len(color) == 7 for color in COLORS.values())
