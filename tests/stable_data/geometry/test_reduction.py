"""Meshes from triangles of any number."""

import igl
import numpy as np
import pytest

from stable_data.errors import MeshError
from stable_data.geometry import reduction
from stable_data.geometry.mesh import Edges, Mesh, signed_volumes
from stable_data.geometry.reduction import join_triangles, reduce_mesh
from stable_data.scene import FloatArray


def torus(n: int) -> FloatArray:
    """Triangles of a torus of radii 1 and 0.4, (2 n², 3, 3)."""
    u, v = np.meshgrid(*[np.linspace(0, 2 * np.pi, n + 1)] * 2, indexing="ij")
    p = np.stack([(1 + 0.4 * np.cos(v)) * np.cos(u), (1 + 0.4 * np.cos(v)) * np.sin(u), 0.4 * np.sin(v)], axis=-1)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    return np.concatenate([np.stack(each, axis=2).reshape(-1, 3, 3) for each in ((a, b, c), (a, c, d))])


VOLUME = 2 * np.pi**2 * 0.4**2


def test_surfaces_are_welded_into_one_closed_mesh() -> None:
    soup = torus(40) + np.array([5.0, 0.0, 0.0])
    mesh, moved = join_triangles([soup[:1000], soup[1000:]], "a")
    assert (len(mesh.faces), len(mesh.vertices), moved) == (3200, 1600, 0.0)
    assert Edges.of(mesh.faces).is_watertight
    assert mesh.vertices[:, 0].mean() == pytest.approx(5, abs=1e-6)


def test_a_reduced_mesh_is_near_the_source_and_says_how_near() -> None:
    mesh, _ = join_triangles([torus(120)], "a")
    reduced, distance = reduce_mesh(mesh, 2000)
    assert len(reduced.faces) <= 2010
    assert 0 < distance < 0.02
    assert float(signed_volumes(reduced.triangles).sum()) == pytest.approx(VOLUME, rel=0.02)
    assert reduce_mesh(reduced, 2010) == (reduced, 0.0)


def test_very_many_triangles_are_clustered_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reduction, "_MOST_EXACT", 30_000)
    monkeypatch.setattr(reduction, "_CHUNK", 7_000)
    soup = torus(160)
    mesh, moved = join_triangles([soup[:9], soup[9:]], "a")
    assert len(mesh.faces) <= 30_000
    assert 0 < moved < 0.1
    assert float(signed_volumes(mesh.triangles).sum()) == pytest.approx(VOLUME, rel=0.02)


@pytest.mark.parametrize(
    ("soups", "code"),
    [
        ([], "mesh_empty"),
        ([np.zeros((0, 3, 3))], "mesh_empty"),
        ([np.ones((4, 3, 3))], "mesh_empty"),
        ([np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]])], "mesh_empty"),
        ([np.full((1, 3, 3), np.nan)], "mesh_not_finite"),
        ([torus(3), np.full((1, 3, 3), np.inf)], "mesh_not_finite"),
        ([torus(3) * 1e200], "mesh_not_finite"),
    ],
)
def test_what_is_no_surface_is_refused(soups: list[FloatArray], code: str) -> None:
    with pytest.raises(MeshError, match="asset a") as error:
        join_triangles(soups, "a")
    assert error.value.code == code


def test_the_same_triangles_give_the_same_mesh() -> None:
    one, other = (reduce_mesh(join_triangles([torus(60)], "a")[0], 900)[0] for _ in range(2))
    assert isinstance(one, Mesh)
    assert (one.vertices == other.vertices).all()
    assert (one.faces == other.faces).all()


def test_a_triangle_that_is_listed_often_is_once_in_the_mesh() -> None:
    soup = torus(20)
    once, often = (join_triangles([np.tile(soup, (times, 1, 1))], "a")[0] for times in (1, 50))
    assert np.array_equal(once.faces, often.faces)
    assert np.array_equal(once.vertices, often.vertices)
    back = join_triangles([np.concatenate([soup, soup[:, ::-1]])], "a")[0]  # a sheet with two sides has both
    assert len(back.faces) == 2 * len(once.faces)


def test_triangles_that_lie_in_each_other_are_compared_at_few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    measure, points = igl.point_mesh_squared_distance, list[int]()

    def measured(*arguments: FloatArray) -> tuple[FloatArray, ...]:
        points.append(len(arguments[0]))
        found: tuple[FloatArray, ...] = measure(*arguments)
        return found

    monkeypatch.setattr(igl, "point_mesh_squared_distance", measured)
    soup, rng = torus(6), np.random.default_rng(0)
    layers = np.concatenate([soup + rng.normal(0, 1e-3, 3) for _ in range(500)])
    for triangles in (torus(100), layers):
        reduce_mesh(join_triangles([triangles], "a")[0], 2000)
    assert points[:2] == [8192, 8192]
    assert 256 <= points[2] < 4096
    assert points[3] < 8192
