"""Bodies have the physics of their assets at their scale and tilt, where it is known; all others are as they always were."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.assets.physics import AssetPhysics
from stable_data.assets.store import AssetStore
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh
from stable_data.scene import QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from stable_data.simulation.collision_bodies import DENSITY, bodies_of
from stable_data.simulation.settling import Inertial, RigidBody, compile_bodies, hull_volume
from tests.scenes import box

pytestmark = pytest.mark.sim

TABLE = Tabletop("office_table", (1.0, 0.6))
SIDES = (0.1, 0.2, 0.4)
CENTRE = np.array([0.02, -0.03, 0.1])
TENSOR = np.array([[4.0, 0.5, -0.3], [0.5, 5.0, 0.2], [-0.3, 0.2, 3.0]]) * 1e-3
WEIGHED = AssetPhysics(0.7, (1.0, 1.0, 1.0), CENTRE, TENSOR, (0.3, 0.004, 0.0002))
UPRIGHT_TILT: QuatXyzw = (0.0, 0.0, 0.0, 1.0)
tilts = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
scales = st.tuples(*[st.floats(0.3, 2.0)] * 3)


class Shelf:
    """Blocks and wedges in files, and what is known of them."""

    def __init__(self, root: Path, known: AssetPhysics | None) -> None:
        self._root, self._known = root, known
        block = box(*SIDES)
        # A wedge: its box, tilted, is not centred where the tilted centre of its own box is.
        wedge = np.where((block.vertices[:, 2:] > 0) & (block.vertices[:, :1] > 0), block.vertices * (1, 1, -1), block.vertices)
        (root / "block.glb").write_bytes(write_glb(Mesh(block.vertices, block.faces)))
        (root / "wedge.glb").write_bytes(write_glb(Mesh(wedge, block.faces)))

    def asset_path(self, asset_id: str) -> Path | None:
        path = self._root / f"{asset_id}.glb"
        return path if path.is_file() else None

    def physics(self, asset_id: str) -> AssetPhysics | None:
        return self._known


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shelf")


def body(store: AssetStore, scale: Vec3 = (1.0, 1.0, 1.0), tilt: QuatXyzw = UPRIGHT_TILT, asset_id: str = "wedge") -> RigidBody:
    x, y, z = store.shape_at(asset_id, scale, tilt).size.tolist()
    o = SceneObject("0_thing_0", "thing", (0.5, 0.3, z / 2), 0.6, (x, y, z), asset_id, scale, tilt)
    scene, shapes, _ = store.resolved(Scene("a", TABLE, (o,)))
    (found,) = bodies_of(scene, shapes, store)
    return found


def inertial(found: RigidBody) -> Inertial:
    assert found.inertial is not None
    return found.inertial


def test_an_upright_block_weighs_what_is_known_of_it(root: Path) -> None:
    found = body(AssetStore(Shelf(root, WEIGHED)), asset_id="block")
    assert (found.mass, found.friction) == (0.7, WEIGHED.friction)
    np.testing.assert_allclose(inertial(found).center_of_mass, CENTRE, atol=1e-8)
    np.testing.assert_array_equal(inertial(found).inertia, TENSOR)


def test_twice_as_large_is_eight_times_as_heavy(root: Path) -> None:
    found = body(AssetStore(Shelf(root, WEIGHED)), (2.0, 2.0, 2.0), asset_id="block")
    assert found.mass == pytest.approx(8 * 0.7)
    np.testing.assert_allclose(inertial(found).center_of_mass, 2 * CENTRE, atol=1e-7)
    np.testing.assert_allclose(inertial(found).inertia, 32 * TENSOR)


@settings(max_examples=30)
@given(tilts, scales)
def test_a_homogeneous_mesh_has_the_inertial_of_its_parts_at_any_scale_and_tilt(
    root: Path, tilt: QuatXyzw, scale: Vec3
) -> None:
    """The wedge is one convex part: what is known of the mesh must be what MuJoCo would find."""
    tilt = tuple((np.array(tilt) / np.linalg.norm(tilt)).tolist())
    plain = AssetStore(Shelf(root, None))
    whole = mass_properties(plain.asset("wedge").mesh, density=DENSITY)
    known = AssetPhysics(whole.mass, (1.0, 1.0, 1.0), whole.center_of_mass, whole.inertia)
    store = AssetStore(Shelf(root, known))
    found, free = body(store, scale, tilt), body(plain, scale, tilt)
    assert found.mass == pytest.approx(free.mass)
    parts = mass_properties(found.parts[0], mass=found.mass)
    size = float(np.ptp(found.parts[0].vertices, axis=0).max())
    np.testing.assert_allclose(inertial(found).center_of_mass, parts.center_of_mass, atol=1e-6 * size)
    np.testing.assert_allclose(inertial(found).inertia, parts.inertia, atol=1e-6 * found.mass * size**2)
    given_model, free_model = compile_bodies([found], TABLE), compile_bodies([free], TABLE)
    np.testing.assert_allclose(given_model.body_ipos, free_model.body_ipos, atol=1e-6 * size)
    np.testing.assert_allclose(np.sort(given_model.body_inertia[1]), np.sort(free_model.body_inertia[1]), rtol=1e-4)
    centre = store.shape_at("wedge", scale, tilt).center_of_mass
    assert centre is not None
    np.testing.assert_allclose(centre, inertial(found).center_of_mass, atol=1e-12)


def test_a_tilt_turns_the_tensor_and_the_centre(root: Path) -> None:
    store = AssetStore(Shelf(root, WEIGHED))
    on_its_side = Rotation.from_euler("x", 90, degrees=True)
    x, y, z, w = on_its_side.as_quat().tolist()
    found, turn = inertial(body(store, tilt=(x, y, z, w), asset_id="block")), on_its_side.as_matrix()
    np.testing.assert_allclose(found.center_of_mass, (0.02, -0.1, -0.03), atol=1e-8)
    np.testing.assert_allclose(found.inertia, turn @ TENSOR @ turn.T, atol=1e-15)
    model = compile_bodies([body(store, tilt=(x, y, z, w), asset_id="block")], TABLE)
    axes = Rotation.from_quat(model.body_iquat[1][[1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(axes @ np.diag(model.body_inertia[1]) @ axes.T, found.inertia, atol=1e-12)


def test_what_is_not_known_is_that_of_homogeneous_parts(root: Path) -> None:
    mass_alone = body(AssetStore(Shelf(root, AssetPhysics(0.7, (1.0, 1.0, 1.0)))))
    assert (mass_alone.mass, mass_alone.inertial, mass_alone.friction) == (0.7, None, None)
    model = compile_bodies([mass_alone], TABLE)
    assert model.body_mass[1] == pytest.approx(0.7)
    parts = mass_properties(mass_alone.parts[0], mass=0.7)
    centred = inertial(body(AssetStore(Shelf(root, replace(WEIGHED, inertia=None)))))
    np.testing.assert_allclose(centred.center_of_mass, CENTRE, atol=1e-8)
    np.testing.assert_allclose(centred.inertia, parts.inertia)
    spread = inertial(body(AssetStore(Shelf(root, replace(WEIGHED, center_of_mass=None)))))
    np.testing.assert_allclose(spread.center_of_mass, parts.center_of_mass)
    np.testing.assert_array_equal(spread.inertia, TENSOR)


def test_a_body_has_at_least_a_gram(root: Path) -> None:
    found = body(AssetStore(Shelf(root, replace(WEIGHED, mass=1e-5, inertia=1e-4 * TENSOR))), asset_id="block")
    assert found.mass == 1e-3
    np.testing.assert_allclose(inertial(found).inertia, 1e-2 * TENSOR)
    compile_bodies([found], TABLE)


@pytest.mark.parametrize("asset_id", ["block", "wedge"])
def test_bodies_of_which_nothing_is_known_are_to_the_last_bit_as_before(root: Path, asset_id: str) -> None:
    """A source that knows no masses, and one that knows none of this asset."""

    class Plain:
        asset_path = Shelf(root, None).asset_path

    found = [body(AssetStore(source), (0.9, 1.1, 1.2), asset_id=asset_id) for source in (Plain(), Shelf(root, None))]
    mass = 400.0 * sum(map(hull_volume, found[0].parts))
    wanted = compile_bodies([RigidBody("0_thing_0", found[0].parts, mass, found[0].position, 0.6)], TABLE)
    arrays = [name for name in dir(wanted) if not name.startswith("_") and isinstance(getattr(wanted, name), np.ndarray)]
    for one in found:
        assert (one.mass, one.inertial, one.friction) == (mass, None, None)
        model = compile_bodies([one], TABLE)
        assert all(np.array_equal(getattr(model, name), getattr(wanted, name)) for name in arrays if name != "mesh_pathadr")


def test_a_box_in_place_of_a_missing_mesh_is_not_weighed(root: Path) -> None:
    store = AssetStore(Shelf(root, WEIGHED))
    o = SceneObject("0_thing_0", "thing", (0.5, 0.3, 0.05), 0.0, (0.1, 0.1, 0.1), "gone", (1.0, 1.0, 1.0))
    scene, shapes, _ = store.resolved(Scene("a", TABLE, (o,)))
    (found,) = bodies_of(scene, shapes, store)
    assert found.mass == pytest.approx(0.4)
    assert found.inertial is None
    assert found.friction is None
