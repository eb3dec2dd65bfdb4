"""Poses at rest."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.geometry.mesh import Mesh, center_vertices
from stable_data.importers.conversion.resting import is_container, resting_poses
from stable_data.importers.conversion.sizes import read_sizes
from stable_data.rotations import rotation_matrix
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw
from tests.stable_data.importers.conversion.sources import BOTTLE, CUP, PLATE, box, revolved

VERTICAL = {name: size.vertical for name, size in read_sizes().items()}
TURN = Rotation.from_euler("xyz", (1.0, 0.4, 0.3)).as_matrix()


def centred(mesh: Mesh, turn: FloatArray | None = None) -> Mesh:
    return center_vertices(mesh.vertices if turn is None else mesh.vertices @ turn.T, mesh.faces)


def height(mesh: Mesh, quat: QuatXyzw) -> float:
    return float(np.ptp(mesh.vertices @ rotation_matrix(quat).T, axis=0)[2])


def upward(quat: QuatXyzw, turn: FloatArray) -> float:
    """Cosine between up and the own axis of a mesh that was turned."""
    return float((rotation_matrix(quat) @ turn)[2, 2])


def test_a_bottle_whose_source_says_up_stands() -> None:
    poses, rests_on = resting_poses(centred(revolved(BOTTLE)), is_upright=True)
    assert (poses[0].quat_xyzw, rests_on) == (UPRIGHT, "up_axis")
    assert len(poses) > 1


def test_a_turned_bottle_stands_because_bottles_do_though_it_would_fall_on_its_side() -> None:
    bottle = centred(revolved(BOTTLE), TURN)
    poses, rests_on = resting_poses(bottle, vertical=VERTICAL["bottle"])
    assert rests_on == "physics"
    assert upward(poses[0].quat_xyzw, TURN) == pytest.approx(1, abs=1e-3)
    assert height(bottle, poses[0].quat_xyzw) == pytest.approx(0.25, rel=0.01)
    likeliest = resting_poses(bottle)[0][0]
    assert height(bottle, likeliest.quat_xyzw) < 0.1


def test_a_turned_plate_lies_with_its_hollow_up() -> None:
    plate = centred(revolved(PLATE), TURN)
    poses, _ = resting_poses(plate, vertical=VERTICAL["plate"])
    assert upward(poses[0].quat_xyzw, TURN) == pytest.approx(1, abs=1e-3)
    assert is_container(plate, poses[0].quat_xyzw)


def test_tables_know_which_side_is_upright() -> None:
    assert [sorted(VERTICAL[name]) for name in ("bottle", "plate", "banana", "apple")] == [[0], [2], [2], [0, 1, 2]]


def test_a_pose_of_the_source_that_is_not_at_rest_is_left_out() -> None:
    leaning = centred(box(0.04, 0.05, 0.2), Rotation.from_euler("x", 40, degrees=True).as_matrix())
    poses, rests_on = resting_poses(leaning, is_upright=True)
    assert rests_on == "physics"
    assert all(abs(p.quat_xyzw[3]) < math.cos(math.radians(2)) for p in poses)
    flat = {round(height(leaning, p.quat_xyzw), 3) for p in poses}
    assert flat <= {0.04, 0.05, 0.2}
    assert 0.04 in flat


def test_a_leaning_body_that_is_heavy_below_stands() -> None:
    upright = box(0.05, 0.05, 0.1)
    leaning = centred(Mesh(upright.vertices + upright.vertices[:, 2:] * (0.8, 0, 0), upright.faces))
    low = np.array([-0.03, 0.0, -0.04])
    assert resting_poses(leaning, is_upright=True)[0][0].quat_xyzw != UPRIGHT
    assert resting_poses(leaning, is_upright=True, center_of_mass=np.zeros(3))[0][0].quat_xyzw != UPRIGHT
    poses, rests_on = resting_poses(leaning, is_upright=True, center_of_mass=low)
    assert (poses[0].quat_xyzw, rests_on) == (UPRIGHT, "up_axis")


def test_a_box_has_six_poses_and_counts_that_never_rise() -> None:
    poses, _ = resting_poses(box(0.1, 0.11, 0.12), is_upright=True)
    counts = [pose.count for pose in poses]
    assert len(poses) == 6
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] >= 1


def test_given_poses_are_kept_without_their_yaw() -> None:
    lying = tuple(Rotation.from_euler("xz", (90, 30), degrees=True).as_quat().tolist())
    poses, rests_on = resting_poses(box(0.1, 0.1, 0.2), given=(lying, UPRIGHT))
    assert (rests_on, [p.count for p in poses]) == ("given", [2, 1])
    assert height(box(0.1, 0.1, 0.2), poses[0].quat_xyzw) == pytest.approx(0.1)


def test_a_ball_and_a_sheet_have_a_pose() -> None:
    angle = np.linspace(0, np.pi, 24)
    ball = centred(revolved(list(zip(0.04 * np.sin(angle), -0.04 * np.cos(angle), strict=True))))
    assert resting_poses(ball)[0]
    sheet = Mesh(np.array([[0.0, 0, 0], [0.2, 0, 0], [0.2, 0.3, 0], [0, 0.3, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    poses, _ = resting_poses(centred(sheet))
    assert height(centred(sheet), poses[0].quat_xyzw) == pytest.approx(0, abs=1e-3)


def test_without_a_search_the_source_is_trusted() -> None:
    assert resting_poses(box(0.1, 0.1, 0.2), searches=False)[0][0].quat_xyzw == UPRIGHT


def test_the_same_mesh_has_the_same_poses() -> None:
    mesh = centred(revolved(CUP), TURN)
    assert resting_poses(mesh) == resting_poses(mesh)


@pytest.mark.parametrize(("profile", "holds"), [(CUP, True), (PLATE, True), (BOTTLE, False)])
def test_containers_open_upward(profile: list[tuple[float, float]], holds: bool) -> None:
    mesh = centred(revolved(profile))
    assert is_container(mesh) is holds
    assert not is_container(mesh, (1.0, 0.0, 0.0, 0.0))
