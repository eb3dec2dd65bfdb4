import numpy as np
import pytest

from stable_data.embedded_world.modelling.solids import Solid, bar, box, coats, lathe, mesh_of, slab, turned_vessel, volume


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
    hollow = 8 * 0.04**2 * np.sin(np.pi / 8)
    assert volume(mesh_of(cup)[0]) == pytest.approx(area * 0.1 - hollow * 0.09)
    assert len(cup.parts) == 1 + 16


def test_turned_and_moved_solid_keeps_its_volume_and_its_colour() -> None:
    solid = slab(0.1, 0.08, 0.03, 0.004).painted("red")
    turned = solid.turned(20, 30, 40).moved(1, 2, 3)
    assert volume(mesh_of(turned)[0]) == pytest.approx(volume(mesh_of(solid)[0]))
    assert list(coats(turned)) == ["red"]


def test_mesh_is_centred_and_says_where_it_was() -> None:
    mesh, parts, centre = mesh_of(box(0.1, 0.2, 0.3).moved(x=1.0))
    np.testing.assert_allclose(centre, (1.0, 0.0, 0.15))
    np.testing.assert_allclose(mesh.vertices.max(axis=0), (0.05, 0.1, 0.15))
    np.testing.assert_allclose(parts[0].vertices.max(axis=0), (0.05, 0.1, 0.15))


def test_every_face_of_a_union_has_the_colour_of_its_solid() -> None:
    solid = box(0.1, 0.1, 0.02).painted("red") + box(0.02, 0.02, 0.1).painted("blue") + box(0.2, 0.01, 0.01)
    mesh, _, _ = mesh_of(solid)
    found = coats(solid)
    assert set(found) == {"red", "blue", None}
    assert sorted(np.concatenate(list(found.values())).tolist()) == list(range(len(mesh.faces)))
    blue_top = mesh.vertices[mesh.faces[found["blue"]]][..., 2].max()
    assert blue_top == pytest.approx(mesh.vertices[:, 2].max())
    assert mesh.vertices[mesh.faces[found["red"]]][..., 2].max() < blue_top
