"""Surfaces of furniture whose surfaces are known."""

from pathlib import Path

import igl
import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.scene import FloatArray
from stable_data.supports import SupportLimits, SupportSurface, find_surfaces
from tests.stable_data.supports.furniture import box, counter_with_sink, desk, lamp, moved, shelf, tray, turned


def only(mesh: Mesh) -> SupportSurface:
    (found,) = find_surfaces(mesh)
    return found


def test_a_desk_has_its_top_and_nothing_below_it() -> None:
    top = only(desk())
    assert top.name == "top"
    assert top.clearance is None
    assert top.origin == pytest.approx((0.0, 0.0, 0.75), abs=1e-6)
    assert top.size_xy == pytest.approx((1.2, 0.6), abs=1e-6)
    assert top.area == pytest.approx(0.72, abs=1e-6)
    assert top.yaw == 0.0
    assert top.holes == ()


def test_boards_of_a_shelf_count_with_the_room_above_them() -> None:
    top, *boards = find_surfaces(shelf())
    assert top.name == "top"
    assert top.area == pytest.approx(0.24, abs=1e-5)
    assert [b.name for b in boards] == ["shelf_1", "shelf_2", "shelf_3"]
    assert [b.height for b in boards] == pytest.approx([0.82, 0.52, 0.12], abs=1e-6)
    assert [b.clearance for b in boards] == pytest.approx([0.38, 0.28, 0.38], abs=1e-6)
    for board in boards:  # two millimetres from the walls
        assert board.size_xy == pytest.approx((0.756, 0.288), abs=1e-4)


def test_the_ground_of_a_tray_counts_and_its_rim_does_not() -> None:
    ground = only(tray())
    assert ground.height == pytest.approx(0.02)
    assert ground.size_xy == pytest.approx((0.576, 0.376), abs=1e-4)


def test_the_bottom_of_a_sink_counts_and_the_counter_has_a_hole() -> None:
    top, bottom = find_surfaces(counter_with_sink())
    assert (top.height, bottom.height) == pytest.approx((0.9, 0.72))
    assert top.area == pytest.approx(1.4 * 0.6 - 0.5 * 0.4, abs=1e-5)
    (hole,) = top.holes
    np.testing.assert_allclose(np.ptp(hole, axis=0), [0.5, 0.4], atol=1e-5)
    assert bottom.name == "level_1"
    assert bottom.size_xy == pytest.approx((0.496, 0.396), abs=1e-4)


def test_the_top_of_an_angle_is_one_surface() -> None:
    angle = join_meshes([box((0.0, 0.0, 0.7), (1.6, 0.6, 0.74)), box((0.0, 0.6, 0.7), (0.6, 1.4, 0.74))])
    top = only(angle)
    assert top.area == pytest.approx(1.6 * 0.6 + 0.6 * 0.8, abs=1e-5)
    assert len(top.outline) == 6


def test_a_round_top_made_of_a_fan() -> None:
    top = only(moved(trimesh.creation.cylinder(0.5, 0.03, sections=64), 0.0, 0.0, 0.7))
    assert top.area == pytest.approx(64 / 2 * 0.25 * np.sin(2 * np.pi / 64), rel=2e-3)
    assert top.height == pytest.approx(0.715)


def test_a_fixed_lamp_is_a_hole_whether_it_is_part_of_the_mesh_or_beside_it() -> None:
    own, beside = only(join_meshes([desk(), lamp()])), find_surfaces(desk(), [lamp()])[0]
    for top in (own, beside):
        (hole,) = top.holes
        assert np.ptp(hole, axis=0) == pytest.approx([0.2, 0.2], abs=0.01)  # below its shade
        assert top.area == pytest.approx(0.72 - np.pi * 0.1**2, abs=0.002)
    assert own.area == pytest.approx(beside.area, abs=1e-9)


def test_what_a_ceiling_covers_is_a_surface_of_its_own() -> None:
    board = box((0.0, 0.35, 1.1), (1.2, 0.6, 1.12))
    walls = [box((x, 0.35, 0.75), (x + 0.02, 0.6, 1.1)) for x in (0.0, 1.18)]
    found = {s.name: s for s in find_surfaces(join_meshes([desk(), board, *walls]))}
    assert set(found) == {"top", "level_1", "shelf_1"}
    assert found["level_1"].height == pytest.approx(1.12)
    assert found["top"].area == pytest.approx(1.2 * 0.35, abs=1e-3)
    assert found["shelf_1"].clearance == pytest.approx(0.35)
    assert found["shelf_1"].origin[:2] == pytest.approx((0.022, 0.35), abs=1e-3)


def test_the_inside_of_a_closed_body_is_no_surface() -> None:
    inner = box((0.02, 0.02, 0.02), (0.48, 0.48, 0.48))
    hollow = join_meshes([box((0.0, 0.0, 0.0), (0.5, 0.5, 0.5)), Mesh(inner.vertices, inner.faces[:, ::-1])])
    assert only(hollow).height == pytest.approx(0.5)


def test_a_cupboard_counts_when_its_door_is_off() -> None:
    def cupboard(*, has_door: bool) -> Mesh:
        walls = [box((0.0, 0.0, 0.0), (0.02, 0.4, 0.6)), box((0.58, 0.0, 0.0), (0.6, 0.4, 0.6)), box((0.0, 0.38, 0.0), (0.6, 0.4, 0.6)),
                 box((0.0, 0.0, 0.0), (0.6, 0.4, 0.02)), box((0.0, 0.0, 0.58), (0.6, 0.4, 0.6))]  # fmt: skip
        return join_meshes([*walls, *([box((0.0, -0.02, 0.0), (0.6, 0.0, 0.6))] if has_door else [])])

    assert [s.name for s in find_surfaces(cupboard(has_door=False))] == ["top", "shelf_1"]
    assert [s.height for s in find_surfaces(cupboard(has_door=True))] == pytest.approx([0.6])


@pytest.mark.parametrize("degrees", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("parts", [0, 4])
def test_a_sloped_top_is_refused_whatever_its_mesh(degrees: float, parts: int) -> None:
    top = trimesh.creation.box((1.0, 0.6, 0.03))
    for _ in range(parts):
        top = top.subdivide()
    assert find_surfaces(turned(moved(top, 0.0, 0.0, 0.7), degrees, (0.0, 1.0, 0.0))) == ()


def test_a_dome_a_grate_and_a_thin_rim_are_no_surfaces() -> None:
    assert find_surfaces(moved(trimesh.creation.icosphere(4, 0.4), 0.0, 0.0, 0.0)) == ()
    assert find_surfaces(join_meshes([box((0.0, y, 0.7), (1.0, y + 0.004, 0.704)) for y in np.arange(0.0, 0.5, 0.02)])) == ()
    assert find_surfaces(moved(trimesh.creation.annulus(0.3, 0.35, 0.02), 0.0, 0.0, 0.7)) == ()


def test_seams_are_closed_and_slots_are_not() -> None:
    def boards(gap: float) -> Mesh:
        return join_meshes([box((0.0, 0.0, 0.7), (1.0, 0.3, 0.73)), box((0.0, 0.3 + gap, 0.7), (1.0, 0.6 + gap, 0.73))])

    assert only(boards(0.002)).area == pytest.approx(0.602, abs=1e-4)
    assert len(find_surfaces(boards(0.02))) == 2


def test_a_bevel_is_beside_the_surface() -> None:
    low, high = (
        np.array([[0, 0], [1, 0], [1, 0.6], [0, 0.6]]),
        np.array([[0.01, 0.01], [0.99, 0.01], [0.99, 0.59], [0.01, 0.59]]),
    )
    levels = [np.column_stack([ring, np.full(4, z)]) for ring, z in ((low, 0.7), (low, 0.72), (high, 0.73))]
    hull = trimesh.convex.convex_hull(np.concatenate(levels))
    top = only(Mesh(np.asarray(hull.vertices), np.asarray(hull.faces)))
    assert top.size_xy == pytest.approx((0.98, 0.58), abs=1e-5)
    assert top.origin == pytest.approx((0.01, 0.01, 0.73), abs=1e-5)


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1))
def test_order_winding_and_double_faces_change_nothing(seed: int) -> None:
    rng, plain = np.random.default_rng(seed), shelf()
    soup = plain.triangles[rng.permutation(len(plain.faces))]
    soup = np.concatenate([soup, soup[rng.integers(0, len(soup), 20)]])
    flipped = rng.random(len(soup)) < 0.5
    soup[flipped] = soup[flipped][:, ::-1]
    same = find_surfaces(Mesh(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3)))
    for one, other in zip(find_surfaces(plain), same, strict=True):
        assert one.name == other.name
        assert one.clearance == pytest.approx(other.clearance)
        assert one.area == pytest.approx(other.area, abs=1e-6)
        assert one.origin == pytest.approx(other.origin, abs=1e-5)


@settings(max_examples=20)
@given(st.floats(-40.0, 40.0), st.floats(-3.0, 3.0), st.floats(0.3, 2.0))
def test_a_turned_and_moved_table_has_the_same_surface_in_its_own_frame(degrees: float, shift: float, width: float) -> None:
    plain = desk(width, 0.7)
    turn = turned(plain, degrees, (0.0, 0.0, 1.0))
    mesh = Mesh(np.add(turn.vertices, (shift, -shift, 0.0)), turn.faces)
    top = only(mesh)
    assert top.area == pytest.approx(width * 0.7, rel=1e-3)
    if abs(degrees) > 5.0 and abs(width - 0.7) > 0.1:
        assert np.degrees(top.yaw) == pytest.approx(degrees, abs=0.1)
        assert top.size_xy == pytest.approx((width, 0.7), abs=2e-3)
    corners = np.column_stack([top.outline, np.zeros(len(top.outline))])
    back = top.to_support(corners)
    np.testing.assert_allclose(back[:, 2], 0.75, atol=1e-9)
    assert (back[:, :2] >= mesh.vertices[:, :2].min(axis=0) - 1e-3).all()
    assert (back[:, :2] <= mesh.vertices[:, :2].max(axis=0) + 1e-3).all()


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1))
def test_rays_from_any_point_of_a_surface_meet_it_below_and_nothing_up_to_its_clearance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0.0, 0.8, (14, 3)).round(2)
    boxes = join_meshes(
        [box(tuple(a), tuple(a + b)) for a, b in zip(low, rng.uniform(0.02, 0.5, (14, 3)).round(2), strict=True)]
    )
    mesh = turned(boxes, rng.uniform(0.0, 90.0), (0.0, 0.0, 1.0))
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)

    def distances(points: FloatArray, up: float) -> FloatArray:
        along = np.tile([0.0, 0.0, up], (len(points), 1))
        face, distance, _ = tree.intersect_ray_first(mesh.vertices, mesh.faces, points, along)
        return np.where(face < 0, np.inf, distance)

    for surface in find_surfaces(mesh):
        region = shapely.Polygon(surface.outline, surface.holes)
        assert region.is_valid
        assert region.area == pytest.approx(surface.area, rel=1e-6)
        points = rng.uniform((0.0, 0.0), surface.size_xy, (400, 2))
        points = points[shapely.contains_xy(shapely.buffer(region, -0.002), points)]
        above = surface.to_support(np.column_stack([points, np.full(len(points), 0.004)]))
        assert distances(above, -1.0).max(initial=0.0) < 0.007
        assert distances(above, 1.0).min(initial=np.inf) >= (1.0 if surface.clearance is None else surface.clearance) - 0.0041


def test_the_same_mesh_gives_the_same_surfaces() -> None:
    for one, other in zip(find_surfaces(shelf()), find_surfaces(shelf()), strict=True):
        np.testing.assert_array_equal(one.outline, other.outline)


def test_bad_meshes_are_refused_and_an_empty_one_has_none() -> None:
    assert find_surfaces(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))) == ()
    broken = desk()
    broken.vertices[3, 1] = np.nan
    with pytest.raises(MeshError, match="not finite"):
        find_surfaces(broken)
    with pytest.raises(MeshError, match="60 faces, expected at most 50"):
        find_surfaces(desk(), limits=SupportLimits(max_faces=50))


@pytest.mark.parametrize(("name", "height"), [("CoffeeTable", 0.32), ("NightStand", 0.68), ("ReadingDesk", 0.74)])
def test_tables_that_others_made(name: str, height: float, shared_data: Path) -> None:
    pytest.importorskip("collada")
    (path,) = (shared_data / "import_samples" / "tables").glob(f"*{name}_01/meshes/*visual.[dD]*")
    scene = trimesh.load_scene(path).to_geometry()
    mesh = Mesh(0.01 * np.asarray(scene.vertices), np.asarray(scene.faces))  # its unit is centimetres
    top = find_surfaces(mesh)[0]
    assert top.name == "top"
    assert top.height == pytest.approx(height, abs=0.005)
    assert top.height == pytest.approx(mesh.vertices[:, 2].max(), abs=0.002)
    x, y = np.ptp(mesh.vertices[:, :2], axis=0)
    assert top.area > 0.95 * x * y
