"""The rectangle of a surface, and its picture."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import ConfigError, SceneError
from stable_data.geometry.mesh import join_meshes
from stable_data.rotations import rotate_xy
from stable_data.supports import SupportSurface, TabletopFit, as_tabletop, find_surfaces
from stable_data.supports.picture import draw_surfaces, region_triangles, surface_colour
from tests.stable_data.supports.furniture import box, counter_with_sink, desk, moved, shelf


def surface_of(shape: shapely.Polygon) -> SupportSurface:
    shape = shapely.orient_polygons(shape)
    outline, *holes = (shapely.get_coordinates(ring)[:-1] for ring in (shape.exterior, *shape.interiors))
    return SupportSurface("top", (0.0, 0.0, 0.7), 0.0, outline, tuple(holes), None, shape.area)


def test_a_rectangle_is_itself() -> None:
    fit = as_tabletop(find_surfaces(desk())[0], "office_table")
    assert fit.tabletop.table_type == "office_table"
    assert fit.tabletop.size_xy == pytest.approx((1.2, 0.6), abs=1e-6)
    assert fit.corner == pytest.approx((0.0, 0.0), abs=1e-9)
    assert fit.share == pytest.approx(1.0)


def test_the_corner_that_an_angle_lacks_is_its_restricted_zone() -> None:
    angle = join_meshes([box((0.0, 0.0, 0.7), (1.6, 0.6, 0.74)), box((0.0, 0.6, 0.7), (0.6, 1.4, 0.74))])
    fit = as_tabletop(find_surfaces(angle)[0])
    assert fit.tabletop.size_xy == pytest.approx((1.6, 1.4), abs=1e-5)
    assert fit.tabletop.restricted_zone == pytest.approx((0.6, 1.6, 0.6, 1.4), abs=1e-5)
    assert fit.share == pytest.approx(1.0, abs=1e-4)


def test_a_disc_has_its_square() -> None:
    disc = find_surfaces(moved(trimesh.creation.cylinder(0.5, 0.03, sections=128), 0.0, 0.0, 0.7))[0]
    fit = as_tabletop(disc)
    assert np.prod(fit.tabletop.size_xy) == pytest.approx(0.5, abs=0.02)
    assert fit.share == pytest.approx(2 / np.pi, abs=0.03)


def test_a_sink_is_the_restricted_zone() -> None:
    fit = as_tabletop(find_surfaces(counter_with_sink())[0])
    assert fit.tabletop.size_xy == pytest.approx((1.4, 0.6), abs=1e-5)
    assert fit.tabletop.restricted_zone == pytest.approx((0.3, 0.8, 0.1, 0.5), abs=0.004)


def test_holes_far_apart_are_avoided() -> None:
    holes = [shapely.box(0.1, 0.1, 0.2, 0.5), shapely.box(1.3, 0.1, 1.4, 0.5)]
    fit = as_tabletop(surface_of(shapely.difference(shapely.box(0, 0, 1.5, 0.6), shapely.union_all(holes))))
    assert fit.tabletop.restricted_zone is None
    assert fit.tabletop.size_xy == pytest.approx((1.1, 0.6), abs=1e-5)


@pytest.mark.parametrize("quarters", range(5))
def test_a_table_seen_from_another_side_is_the_same_rectangle(quarters: int) -> None:
    surface = replace(find_surfaces(counter_with_sink())[0], yaw=0.3)
    plain, fit = as_tabletop(surface), as_tabletop(surface).turned(quarters)

    def places(one: TabletopFit) -> list[tuple[float, float]]:
        """The corners of table and zone in the frame of the support."""
        frame = one.frame(surface)
        assert one.tabletop.restricted_zone is not None
        boxes = [(0.0, one.tabletop.size_xy[0], 0.0, one.tabletop.size_xy[1]), one.tabletop.restricted_zone]
        corners = np.array([[(x, y) for x in box[:2] for y in box[2:]] for box in boxes]).reshape(-1, 2)
        return sorted((round(x, 6), round(y, 6)) for x, y in (rotate_xy(corners, frame.yaw) + frame.origin[:2]).tolist())

    np.testing.assert_allclose(places(fit), places(plain), atol=2e-6)
    assert fit.tabletop.size_xy == (plain.tabletop.size_xy if quarters % 2 == 0 else plain.tabletop.size_xy[::-1])


def test_a_sliver_has_no_rectangle() -> None:
    with pytest.raises(SceneError, match="no rectangle"):
        as_tabletop(surface_of(shapely.Polygon([(0, 0), (1, 0.002), (1, 0.004)])))


@settings(max_examples=10)
@given(st.lists(st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.floats(0.02, 0.2)), max_size=4))
def test_the_rectangle_lies_in_the_region_and_is_no_smaller_than_any_tried(holes: list[tuple[float, float, float]]) -> None:
    region = shapely.difference(
        shapely.box(0, 0, 1, 1), shapely.union_all([shapely.Point(x, y).buffer(r, quad_segs=4) for x, y, r in holes])
    )
    region = max(shapely.get_parts(region), key=lambda p: p.area)
    x_min, y_min, _, _ = shapely.bounds(region)
    surface = surface_of(shapely.transform(region, lambda p: p - (x_min, y_min)))
    shape = shapely.Polygon(surface.outline, surface.holes)
    fit = as_tabletop(surface)
    (x, y), (width, depth) = fit.corner, fit.tabletop.size_xy
    free = shapely.box(x, y, x + width, y + depth)
    if (zone := fit.tabletop.restricted_zone) is not None:
        free = shapely.difference(free, shapely.box(x + zone[0], y + zone[2], x + zone[1], y + zone[3]))
    assert shapely.buffer(shape, 0.0015, join_style="mitre").covers(free)
    assert fit.share == pytest.approx(free.area / shape.area, abs=0.01)
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 1, (3000, 2))
    tried = shapely.box(*low.T, *(low + rng.uniform(0, 1, (3000, 2)) * (1 - low)).T)
    inside = tried[shapely.covers(shape, tried)]
    if len(inside):
        assert free.area > 0.9 * shapely.area(inside).max()


def test_the_triangles_of_a_region_have_its_area() -> None:
    for surface in find_surfaces(counter_with_sink()):
        triangles = region_triangles(surface)
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2
        assert (normals[:, 2] > 0).all()
        assert normals[:, 2].sum() == pytest.approx(surface.area, abs=1e-6)
        np.testing.assert_allclose(triangles[..., 2], surface.height, atol=1e-9)


@pytest.mark.sim
def test_a_picture_shows_each_surface_in_its_colour() -> None:
    mesh = shelf()
    surfaces = find_surfaces(mesh)
    try:
        bare, seen = (draw_surfaces(mesh, found, size=(160, 160)) for found in ((), surfaces))
    except ConfigError as error:
        pytest.skip(str(error))
    changed = seen[(seen != bare).any(axis=2)].astype(float)
    for number in range(len(surfaces)):
        colour = np.array([int(surface_colour(number)[k : k + 2], 16) for k in (1, 3, 5)])
        assert (np.abs(changed / changed.sum(axis=1, keepdims=True) - colour / colour.sum()).max(axis=1) < 0.06).sum() > 20
