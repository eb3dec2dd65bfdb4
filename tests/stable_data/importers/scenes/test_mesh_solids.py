"""Convex parts of meshes that are seen: what things stand on is where it is seen, and hollows stay open."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError
from stable_data.geometry.convex_decomposition import inside_convex
from stable_data.geometry.mesh import Mesh, is_closed, join_meshes, signed_volumes
from stable_data.importers.scenes.mesh_solids import fixed_parts, solid_parts
from stable_data.scene import FloatArray
from tests.scene_files import basin, cuboid, sheet

DOWN = np.array([0.0, 0.0, -1.0])
L_SHAPE = ((0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0))


def moved(mesh: Mesh, *shift: float) -> Mesh:
    return Mesh(mesh.vertices + shift, mesh.faces)


def corners(mesh: Mesh) -> Mesh:
    """The mesh with corners of its own for each face, as exporters write sharp edges."""
    return Mesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def holds(parts: list[Mesh], *points: tuple[float, float, float]) -> list[bool]:
    place = np.array(points)
    return [bool(np.any([inside_convex(part, point[None]) for part in parts])) for point in place]


@given(st.tuples(*[st.floats(0.2, 3.0)] * 2), st.floats(-180, 180), st.booleans(), st.booleans(), st.floats(-2.5, 2.5))
def test_a_level_sheet_keeps_its_height_and_its_outline(
    size: tuple[float, float], yaw: float, is_turned: bool, is_double: bool, tilt: float
) -> None:
    x, y = size
    flat = sheet((0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0))
    faces = flat.faces[:, ::-1] if is_turned else flat.faces
    if is_double:
        faces = np.concatenate([faces, faces[:, ::-1]])
    turn = Rotation.from_euler("zx", [yaw, tilt], degrees=True)
    placed = Mesh(turn.apply(flat.vertices), faces)
    (part,) = fixed_parts(corners(placed), "floor", DOWN)
    assert is_closed(part)
    assert signed_volumes(part.triangles).sum() > 0
    own = turn.inv().apply(part.vertices)
    np.testing.assert_allclose(own.max(axis=0), (x, y, 0), atol=1e-4)
    np.testing.assert_allclose(own.min(axis=0)[:2], (0, 0), atol=1e-4)
    assert -0.06 < own.min() < -0.003


def test_an_angled_floor_is_not_filled_up() -> None:
    parts = fixed_parts(sheet(*L_SHAPE), "floor", DOWN)
    assert max(part.vertices[:, 2].max() for part in parts) == pytest.approx(0, abs=1e-6)
    assert holds(parts, (0.5, 1.9, -0.01), (1.9, 0.5, -0.01), (0.5, 0.5, -0.01), (1.3, 1.3, -0.01)) == [True, True, True, False]


def test_a_table_is_its_boards_and_legs() -> None:
    legs = [moved(cuboid(0.05, 0.05, 0.7), x, y, -0.37) for x in (-0.4, 0.4) for y in (-0.2, 0.2)]
    table = join_meshes([moved(cuboid(1, 0.6, 0.04), 0, 0, -0.02), *legs])
    parts = fixed_parts(corners(table), "table", DOWN)
    assert len(parts) == 5
    assert holds(parts, (0, 0, -0.01), (0.4, 0.2, -0.5), (0, 0, -0.5)) == [True, True, False]


def test_a_box_without_a_bottom_or_a_lid_is_hollow() -> None:
    whole = cuboid(1, 1, 1)
    for side in (1.0, -1.0):
        left = (np.abs(whole.triangles[:, :, 2] - side / 2) > 1e-9).any(axis=1)
        parts = fixed_parts(Mesh(whole.vertices, whole.faces[left]), "box", DOWN)
        assert len(parts) == 5
        level = 0.499 if side < 0 else -0.501  # the upper side of the level sheet stays where it is
        assert holds(parts, (0, 0, 0), (0, 0, level), (0.499, 0, 0), (0, 0, side * 0.49)) == [False, True, True, False]


def test_a_room_is_its_walls_if_something_is_in_it() -> None:
    room = cuboid(4, 3, 2.5)
    inwards = Mesh(room.vertices, room.faces[:, ::-1])
    thing = np.array([[1.0, 1.0, -1.0]])
    around = join_meshes([cuboid(4.4, 3.4, 2.9), inwards])
    for mesh in (inwards, around):
        parts = fixed_parts(corners(mesh), "room", DOWN, thing)
        assert len(parts) == 6
        assert holds(parts, (0, 0, 0), (1, 1, -1.249), (1, 1, -1.26), (0, 0, 1.26), (2.01, 0, 0), (1.99, 0, 0)) == [
            *(False, False, True, True, True, False)
        ]
    assert len(fixed_parts(inwards, "crate inside out", DOWN, thing + 5)) == 1
    assert len(fixed_parts(room, "crate", DOWN, thing)) == 1


@pytest.mark.parametrize("cut", [lambda m: solid_parts(m, "bin"), lambda m: fixed_parts(m, "bin", DOWN)])
def test_a_bin_is_hollow(cut: object) -> None:
    assert callable(cut)
    upright = Mesh(basin(0.3, 0.02).vertices[:, [0, 2, 1]] * (1, -1, 1), basin(0.3, 0.02).faces)
    assert is_closed(upright)
    assert signed_volumes(upright.triangles).sum() > 0
    parts = cut(corners(upright))
    assert holds(parts, (0, 0, 0), (0.1, 0.1, 0.1), (0, 0, -0.14), (0.14, 0, 0)) == [False, False, True, True]


def test_curved_and_broken_surfaces_have_parts() -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(0, np.pi, 40)
    arc = np.column_stack([np.cos(angles), np.zeros(40), np.sin(angles)])
    rows: FloatArray = np.concatenate([arc, arc + np.array([0, 1, 0])])
    faces = np.array([f for k in range(39) for f in ((k, k + 1, k + 40), (k + 1, k + 41, k + 40))])
    tunnel = fixed_parts(Mesh(rows, faces), "tunnel", DOWN)
    assert holds(tunnel, (0, 0.5, 0.997), (0, 0.5, 0.3)) == [True, False]
    loose = Mesh(rng.normal(size=(90, 3)), np.arange(90).reshape(-1, 3))
    assert len(fixed_parts(loose, "leaves", DOWN)) == 30
    many = join_meshes([moved(cuboid(0.1, 0.1, 0.1), 0.2 * k, 0, 0) for k in range(300)])
    assert len(fixed_parts(many, "beads", DOWN)) <= 32
    with pytest.raises(MeshError):
        fixed_parts(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])), "point", DOWN)
