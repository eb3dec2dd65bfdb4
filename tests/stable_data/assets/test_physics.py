"""Mass, centre of mass, inertia and friction of an asset at other scales, and from rows that may be wrong."""

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from stable_data.assets.physics import AssetPhysics, physics_of_row
from stable_data.geometry.mass_properties import second_moments
from stable_data.scene import FloatArray, Vec3

BOX = (0.1, 0.2, 0.4)
NOT_A_TENSOR: dict[str, list[Any]] = {
    "no thickness": [1e-3, 0, 0, 0, 1e-3, 0, 0, 0, 0],
    "none": [0.0] * 9,
    "negative": [-1e-3, 0, 0, 0, 1e-3, 0, 0, 0, 1e-3],
    "unbalanced": [1e-3, 0, 0, 0, 1e-3, 0, 0, 0, 3e-3],
    "not finite": [float("nan")] * 9,
    "null": [None] * 9,
    "infinite": [float("inf")] * 9,
    "huge": [1e308, 0, 0, 0, 1e308, 0, 0, 0, 1e308],
    "short": [1e-3] * 6,
    "empty": [],
}


def row(**columns: object) -> dict[str, Any]:
    """A weighed box whose mesh has sides of 10, 20 and 40 units of 1 cm."""
    scale = (0.01, 0.01, 0.01)
    known = {"mass_source": "given", "typical_scale": scale, "mass": 0.5, "center_of_mass": [0.01, 0.0, -0.05]}
    return known | {"inertia": None, "inertia_per_mass": box_inertia(1.0, BOX).ravel().tolist(), "friction": None} | columns


def box_inertia(mass: float, sides: Vec3) -> FloatArray:
    x, y, z = np.square(sides)
    return mass / 12 * np.diag([y + z, x + z, x + y])


def centre_of(found: AssetPhysics) -> FloatArray:
    assert found.center_of_mass is not None
    return found.center_of_mass


def inertia_of(found: AssetPhysics) -> FloatArray:
    assert found.inertia is not None
    return found.inertia


def physics(**columns: object) -> AssetPhysics:
    found = physics_of_row(row(**columns))
    assert found is not None
    return found


def test_a_row_states_mass_centre_inertia_and_friction() -> None:
    found = physics(inertia=(2 * box_inertia(0.5, BOX)).ravel().tolist(), friction=[0.3, 0.01, 0.0])
    assert (found.mass, found.typical_scale, found.friction) == (0.5, (0.01, 0.01, 0.01), (0.3, 0.01, 0.0))
    np.testing.assert_array_equal(centre_of(found), (0.01, 0.0, -0.05))
    np.testing.assert_array_equal(inertia_of(found), 2 * box_inertia(0.5, BOX))


def test_at_its_own_scale_nothing_is_computed() -> None:
    found = physics()
    assert found.at((0.01, 0.01, 0.01)) is found


def test_twice_the_size_is_eight_times_the_mass_and_thirty_two_times_the_inertia() -> None:
    small = physics()
    large = small.at((0.02, 0.02, 0.02))
    assert large.mass == pytest.approx(8 * small.mass)
    np.testing.assert_allclose(centre_of(large), (0.02, 0.0, -0.1))
    np.testing.assert_allclose(inertia_of(large), 32 * box_inertia(0.5, BOX), atol=1e-18)


scales = st.tuples(*[st.floats(0.002, 0.05)] * 3)


@given(scales)
def test_a_box_of_other_proportions_has_the_inertia_of_the_textbook(scale: Vec3) -> None:
    found = physics().at(scale)
    sides = 10 * scale[0], 20 * scale[1], 40 * scale[2]
    assert found.mass == pytest.approx(0.5 * np.prod(sides) / np.prod(BOX))
    np.testing.assert_allclose(inertia_of(found), box_inertia(found.mass, sides), rtol=1e-9, atol=1e-15)


@given(scales)
def test_a_turned_body_is_stretched_as_its_mesh(scale: Vec3) -> None:
    """Against trimesh, which integrates over the stretched triangles: no axis of the body is one of the mesh."""
    mesh = trimesh.creation.cone(1.0, 3.0, sections=24)
    mesh.apply_transform(trimesh.transformations.euler_matrix(0.4, 1.0, -0.3))
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    start = AssetPhysics(mesh.mass, (1.0, 1.0, 1.0), np.array(mesh.center_mass), np.array(mesh.moment_inertia))
    stretched = mesh.copy()
    stretched.apply_transform(np.diag([*scale, 1.0]))
    found = start.at(scale)
    assert found.mass == pytest.approx(stretched.mass)
    np.testing.assert_allclose(centre_of(found), stretched.center_mass, atol=1e-9)
    np.testing.assert_allclose(inertia_of(found), stretched.moment_inertia, rtol=1e-6, atol=1e-6 * inertia_of(found).max())


@pytest.mark.parametrize(
    "columns",
    [
        {"mass_source": None},
        {"mass": None},
        {"mass": 0.0},
        {"mass": float("nan")},
        {"mass": float("inf")},
        {"mass": 1e300},
        {"typical_scale": None},
        {"typical_scale": [0.01, 0.0, 0.01]},
        {"typical_scale": [0.01, None, 0.01]},
    ],
)
def test_without_a_usable_mass_nothing_is_known(columns: dict[str, object]) -> None:
    assert physics_of_row(row(**columns)) is None


@pytest.mark.parametrize("tensor", NOT_A_TENSOR.values(), ids=NOT_A_TENSOR)
def test_a_tensor_that_no_body_has_is_replaced_by_that_of_the_mesh(tensor: list[Any]) -> None:
    np.testing.assert_allclose(inertia_of(physics(inertia=tensor)), box_inertia(0.5, BOX))
    assert physics(inertia=tensor, inertia_per_mass=tensor).inertia is None


def test_a_thin_plate_whose_numbers_were_rounded_is_a_body() -> None:
    found = inertia_of(physics(inertia=[1e-3, 0, 0, 0, 2e-3, 0, 0, 0, 3.001e-3]))
    np.testing.assert_allclose(found, np.diag([1e-3, 2e-3, 3e-3]), rtol=1e-3)
    assert np.linalg.eigvalsh(second_moments(found)).min() > 0


@pytest.mark.parametrize("values", [[0.5, 0.1], [0.5, -0.1, 0.0], [float("nan"), 0.1, 0.0], [None, None, None]])
def test_a_friction_that_no_contact_has_is_not_known(values: list[Any]) -> None:
    found = physics(friction=values)
    assert (found.friction, found.mass) == (None, 0.5)


def test_a_centre_that_is_no_point_is_not_known() -> None:
    assert physics(center_of_mass=[0.0, None, 0.0]).center_of_mass is None
