"""Objects as props: the same bodies as those of the verdict, in a frame that stands on its base."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.embedded_world.families.catalogue import asset
from stable_data.export.props import PlacedProp, placed_props, prop_mass, prop_parts, prop_surfaces, sized_prop
from stable_data.scene import FloatArray, Scene, Vec3
from stable_data.simulation.mujoco_model import engine_spec
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_spec
from tests.stable_data.export.runs import LYING, TABLE, at_rest, falling, posed, thing, weighed, write_run

pytestmark = pytest.mark.sim


def in_world(placed: PlacedProp, points: FloatArray | Vec3) -> FloatArray:
    return np.asarray(Rotation.from_quat(placed.quat_xyzw).apply(np.asarray(points)) + placed.position)


def assert_as_in_mujoco(geometry: SceneGeometry) -> None:
    """Mass, centre of mass and inertia in the world are those of the engine's model."""
    model = compile_spec(engine_spec(geometry))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for k, placed in enumerate(placed_props(geometry), start=1):
        assert model.body(k).name == placed.name
        assert placed.mass.mass == pytest.approx(model.body_mass[k], rel=1e-9)
        np.testing.assert_allclose(in_world(placed, placed.mass.center_of_mass), data.xipos[k], atol=1e-7)
        turn = Rotation.from_quat(placed.quat_xyzw).as_matrix()
        axes = data.ximat[k].reshape(3, 3)
        expected = (axes * model.body_inertia[k]) @ axes.T
        np.testing.assert_allclose(turn @ placed.mass.inertia @ turn.T, expected, atol=1e-6 * np.trace(expected))


@pytest.mark.parametrize("scene", [at_rest(), falling()], ids=lambda scene: scene.scene_id)
def test_props_weigh_what_the_engine_weighs(scene: Scene, store: AssetStore) -> None:
    assert_as_in_mujoco(SceneGeometry.of(scene, store))


def test_a_weighed_mug_in_any_pose_weighs_what_the_engine_weighs(tmp_path: Path) -> None:
    run = weighed(write_run(tmp_path / "run"), "mug/0")
    store = AssetStore(RunAssets(run, tmp_path / "files"))
    mugs = (
        thing("mug/0", "0_mug_0", 0.3, 0.3, 0.0, 0.7, scale=(1.2, 1.1, 0.9)),
        thing("mug/0", "1_mug_0", 0.6, 0.3, 0.0, -2.0, scale=(1.3, 1.3, 1.3), tilt_quat_xyzw=LYING),
    )
    known = AssetAnnotation(asset("mug/0").uid, "mug", typical_scale=(0.9, 0.9, 0.9), resting_tilt=(0.0, 0.6, 0.0, 0.8))
    geometry = replace(SceneGeometry.of(Scene("mugs", TABLE, mugs), store), annotations={known.asset_id: known})
    assert_as_in_mujoco(geometry)
    for placed in placed_props(geometry):
        mass, friction = prop_mass(placed.prop, store)
        scaled = mass.scaled(placed.factor)
        assert friction == placed.friction == (0.25, 0.004, 0.0001)
        assert scaled.mass == pytest.approx(placed.mass.mass, rel=1e-7)  # scales have nine digits
        np.testing.assert_allclose(scaled.center_of_mass, placed.mass.center_of_mass, atol=1e-8)
        np.testing.assert_allclose(scaled.inertia, placed.mass.inertia, atol=1e-12)


@pytest.mark.parametrize("scene", [at_rest(), falling()], ids=lambda scene: scene.scene_id)
def test_what_is_seen_and_what_collides_is_where_the_object_is(scene: Scene, store: AssetStore) -> None:
    geometry = SceneGeometry.of(scene, store)
    for k, placed in enumerate(placed_props(geometry)):
        expected = posed(geometry, placed.object.instance).vertices
        seen = np.concatenate([s.triangles.reshape(-1, 3) for s in prop_surfaces(placed.prop, store)])
        shown = in_world(placed, placed.factor * seen)
        np.testing.assert_allclose(
            [shown.min(axis=0), shown.max(axis=0)], [expected.min(axis=0), expected.max(axis=0)], atol=1e-9
        )
        own = [in_world(placed, placed.factor * part.vertices) for part in prop_parts(placed.prop, store)]
        body = geometry.bodies[k]
        yaw = Rotation.from_euler("z", body.yaw)
        for part, found in zip(body.parts, own, strict=True):
            np.testing.assert_allclose(found, yaw.apply(part.vertices) + body.position, atol=1e-9)


def test_objects_of_one_asset_share_a_prop_that_stands_on_its_base(store: AssetStore) -> None:
    objects = [thing("can/0", f"{k}_can_0", 0.2 * (k + 1), 0.3, 0.0, k, scale=(s, s, s)) for k, s in enumerate((0.7, 1.0, 1.3))]
    first, *others = placed_props(SceneGeometry.of(Scene("cans", TABLE, tuple(objects)), store))
    assert all(other.prop is first.prop for other in others)
    corners = np.concatenate([s.triangles.reshape(-1, 3) for s in prop_surfaces(first.prop, store)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose((low + high)[:2], 0.0, atol=1e-9)
    assert low[2] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(high - low, first.prop.size, atol=1e-9)
    assert first.position[2] == pytest.approx(0.0, abs=1e-9)


@given(factor=st.floats(0.1, 10.0))
def test_a_sized_prop_is_the_prop_at_that_size(factor: float, store: AssetStore) -> None:
    prop = placed_props(SceneGeometry.of(falling(), store))[0].prop
    sized = sized_prop(prop, factor)
    assert (sized.name == prop.name) is (factor == 1.0)
    for small, large in zip(prop_parts(prop, store), prop_parts(sized, store), strict=True):
        np.testing.assert_allclose(large.vertices, factor * small.vertices, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("names", [("Can_0", "can_0"), ("CAN-2", "can", "CAN"), ("can", "CAN", "can-1", "Can")])
def test_names_that_differ_by_case_alone_stay_apart(names: tuple[str, ...], store: AssetStore) -> None:
    objects = [thing("can/0", name, 0.2 * (k + 1), 0.3, 0.0) for k, name in enumerate(names)]
    found = [p.name for p in placed_props(SceneGeometry.of(Scene("cans", TABLE, tuple(objects)), store))]
    assert len({name.lower() for name in found}) == len(names)
    assert found[0] == names[0]


def test_a_prop_is_named_after_its_asset_whatever_object_comes_first(store: AssetStore) -> None:
    size = (0.77, 0.77, 0.77)  # which no other test has made a prop of
    known = AssetAnnotation(asset("can/0").uid, "tin", typical_scale=size)
    cans = [replace(thing("can/0", f"{k}_can_0", 0.2 * (k + 1), 0.3, 0.0, scale=size), category=f"kind_{k}") for k in range(2)]
    for objects in (cans, cans[::-1]):
        geometry = replace(SceneGeometry.of(Scene("cans", TABLE, tuple(objects)), store), annotations={known.asset_id: known})
        assert {p.prop.category for p in placed_props(geometry)} == {"tin"}
