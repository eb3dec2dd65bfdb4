"""Polygons of USD meshes as triangles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.geometry.mesh import area_vectors
from stable_data.importers.usd.shapes import triangulate


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 12), st.integers(0, 2**32 - 1))
def test_triangles_cover_a_polygon_with_inner_corners_once(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, count)) if count > 4 else np.arange(count) * 2 * np.pi / count
    assume_star = np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() < 3
    radius = rng.uniform(0.2, 1, count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = flat @ turn.T + rng.normal(size=3)
    triangles, polygons = triangulate(points, np.array([count]), np.arange(count))
    assert triangles.shape == (count - 2, 3)
    assert (polygons == 0).all()
    if not assume_star:
        return
    area = abs(np.sum(flat[:, 0] * np.roll(flat[:, 1], -1) - flat[:, 1] * np.roll(flat[:, 0], -1))) / 2
    areas = np.linalg.norm(area_vectors(points[triangles]), axis=1) / 2
    assert float(areas.sum()) == pytest.approx(area, rel=1e-6)


def test_polygons_of_all_sizes_keep_their_order() -> None:
    counts = np.array([4, 2, 3, 5, 0, 4])
    points = np.random.default_rng(0).normal(size=(18, 3))
    triangles, polygons = triangulate(points, counts, np.arange(18))
    assert polygons.tolist() == [0, 0, 2, 3, 3, 3, 5, 5]
    assert set(triangles[polygons == 3].ravel()) == {9, 10, 11, 12, 13}
