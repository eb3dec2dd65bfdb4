"""What rises from a surface of a support."""

import numpy as np
import pytest
import shapely
import trimesh

from stable_data.geometry.convex_decomposition import inside_convex
from stable_data.geometry.mesh import Mesh, is_closed, join_meshes, signed_volumes
from stable_data.geometry.surface_sampling import sample_surface
from stable_data.supports import as_tabletop, find_obstacles, find_surfaces, seen_from_open_side, to_frame
from tests.stable_data.supports.furniture import box, counter_with_sink, desk, lamp, shelf, tray, turned

SUPPORTS = {
    "desk with a lamp": join_meshes([desk(), lamp()]),
    "shelf": shelf(),
    "turned shelf": turned(shelf(), 33.0, (0.0, 0.0, 1.0)),
    "tray": tray(),
    "counter": counter_with_sink(),
}


def hull_of(part: Mesh) -> float:
    return float(trimesh.convex.convex_hull(part.vertices).volume)


@pytest.mark.parametrize("support", SUPPORTS.values(), ids=SUPPORTS)
def test_obstacles_contain_what_rises_near_a_table_and_leave_its_room_free(support: Mesh) -> None:
    for surface in find_surfaces(support):
        fit = as_tabletop(surface)
        frame, table = fit.frame(surface), fit.tabletop
        parts = find_obstacles(support, frame, table)
        for part in parts:
            assert is_closed(part)
            assert float(signed_volumes(part.triangles).sum()) == pytest.approx(
                hull_of(part), rel=1e-6
            )  # convex, faces outward
        # All points of the mesh that rise beside the table or over it are in a body.
        points = sample_surface(to_frame(support, frame), 20_000)
        (width, depth), high = table.size_xy, min(1.0, table.clearance or 1.0)
        is_near = ((points[:, :2] > -0.029) & (points[:, :2] < (width + 0.029, depth + 0.029))).all(axis=1)
        rising = points[is_near & (points[:, 2] > 0.0031) & (points[:, 2] < high - 1e-6)]
        covered = np.zeros(len(rising), bool)
        for part in parts:
            grown = Mesh((part.vertices - part.vertices.mean(axis=0)) * (1 + 1e-6) + part.vertices.mean(axis=0), part.faces)
            covered |= inside_convex(grown, rising)
        assert covered.all()
        # Nothing stands where objects may.
        free = shapely.box(0.0, 0.0, width, depth).buffer(-0.006)
        if table.restricted_zone is not None:
            x_min, x_max, y_min, y_max = table.restricted_zone
            free = shapely.difference(free, shapely.box(x_min, y_min, x_max, y_max))
        for part in parts:
            outline = shapely.convex_hull(shapely.multipoints(part.vertices[:, :2]))
            assert part.vertices[:, 2].min() >= 0.002 - 1e-9
            if part.vertices[:, 2].min() < (table.clearance or 1.0) - 0.008:
                assert shapely.intersection(outline, free).area < 1e-4


def test_a_fine_mesh_has_obstacles_as_narrow_as_a_coarse_one() -> None:
    """Below the shade of a lamp there is room, although the corners of its mesh lie at all heights."""
    fine = lamp()
    for _ in range(3):
        fine = Mesh(*trimesh.remesh.subdivide(fine.vertices, fine.faces))
    support = join_meshes([desk(), fine])
    surface = find_surfaces(support)[0]
    fit = as_tabletop(surface)
    parts = find_obstacles(support, fit.frame(surface), fit.tabletop)
    assert len(parts) < 30
    radius = {
        height: max(np.ptp(p.vertices[:, 0]) / 2 for p in parts if p.vertices[:, 2].min() <= height <= p.vertices[:, 2].max())
        for height in (0.01, 0.2, 0.41)
    }
    assert radius[0.01] == pytest.approx(0.08, abs=0.004)  # the foot
    assert radius[0.2] == pytest.approx(0.01, abs=0.004)  # the pole
    assert radius[0.41] == pytest.approx(0.1, abs=0.02)  # the shade


def test_a_plain_table_has_no_obstacles() -> None:
    surface = find_surfaces(desk())[0]
    fit = as_tabletop(surface)
    assert find_obstacles(desk(), fit.frame(surface), fit.tabletop) == ()


def test_things_on_a_support_are_obstacles() -> None:
    vase = box((0.2, 0.2, 0.75), (0.3, 0.3, 1.0))
    surface = find_surfaces(desk(), [vase])[0]
    fit = as_tabletop(surface)
    (found,) = find_obstacles(desk(), fit.frame(surface), fit.tabletop, [vase])
    low, high = found.vertices.min(axis=0), found.vertices.max(axis=0)
    assert low == pytest.approx((0.2, 0.2, 0.002), abs=0.0011)
    assert high == pytest.approx((0.3, 0.3, 0.25), abs=0.0011)


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 270.0, 20.0])
def test_a_shelf_is_seen_from_its_open_side(degrees: float) -> None:
    """The open side of the shelf faces -y before it is turned."""
    support = turned(shelf(), degrees, (0.0, 0.0, 1.0))
    for surface in find_surfaces(support):
        fit = seen_from_open_side(support, surface, as_tabletop(surface))
        assert fit.tabletop.size_xy[0] > fit.tabletop.size_xy[1]
        if surface.clearance is not None:
            assert np.degrees(fit.frame(surface).yaw) % 360 == pytest.approx(degrees, abs=0.1)


def test_a_table_is_seen_from_a_long_side() -> None:
    support = desk(0.5, 1.1)
    surface = find_surfaces(support)[0]
    assert seen_from_open_side(support, surface, as_tabletop(surface)).tabletop.size_xy == pytest.approx((1.1, 0.5))
