"""Poses in which an imported asset rests on a table, the likeliest first.

Physics alone would lay a bottle down: it stands in 4 % of all falls. So the upward axis of the source and the usual height of the
category are asked first.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError
from stable_data.geometry.convex_decomposition import hull_of_mesh
from stable_data.geometry.hollow import Hollow, upward_hollow
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh
from stable_data.rotations import heading, normalise_quat, quat_of, rotation_matrix, tilt_of
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Tabletop

_MOST_POSES = 8
_LEAST_PROBABILITY = 0.005  # a bottle stands in few falls
_SAME = math.radians(5.0)  # poses whose upward directions differ by less are one
_EXACT = math.radians(2.0)  # a pose this near to a face of the hull lies on that face
_SAME_HEIGHT = 0.05  # relative
_REVERSE = -0.9  # cosine of the upward directions of a pose and its reverse, at most
_LOW = 0.4995  # height of a low centre of mass, share of the height
_DROP = 2e-3  # metres
_SECONDS = 1.0
_COARSE = 192  # steps of the hull's largest extent: a coarser hull has few faces and the same poses
_GAP = 2.0  # distance of bodies that fall at the same time, in largest extents
_FITS = (0.15, 0.4)  # log of the height, against that of the usual pose, up to which a pose is usual, or nearly
_UNIT_MASS = 0.2  # kilograms; a fall does not depend on it
_HOLDS = (0.01, 0.2, 0.2, 0.1)  # least depth (m); shares of height, footprint and box of depth, mouth and volume


@dataclass(frozen=True, slots=True)
class StablePose:
    """A pose at rest.

    Attributes:
        quat_xyzw: Rotation of the mesh, unit, without a yaw.
        count: Its weight, at least 1; the first of several has the largest.
    """

    quat_xyzw: QuatXyzw
    count: int


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A pose that may be at rest: its rotation (3, 3), its share of random falls, and whether it is the source's own."""

    matrix: FloatArray
    probability: float
    is_source: bool = False


def is_container(mesh: Mesh, quat_xyzw: QuatXyzw = UPRIGHT) -> bool:
    """Whether an object in a pose has a hollow that opens upward and is large enough to hold other objects.

    Args:
        mesh: Metres.
        quat_xyzw: Its pose.
    """
    posed = Mesh(mesh.vertices @ rotation_matrix(quat_xyzw).T, mesh.faces)
    return _holds(upward_hollow(posed), posed)


def _holds(hollow: Hollow, posed: Mesh) -> bool:
    least, height, footprint, box = _HOLDS
    return (
        hollow.depth >= max(least, height * float(posed.extents[2]))
        and hollow.mouth >= footprint * hollow.footprint
        and hollow.volume >= box * float(np.prod(posed.extents))
    )


def resting_poses(
    mesh: Mesh,
    *,
    given: Sequence[QuatXyzw] = (),
    is_upright: bool = False,
    vertical: Collection[int] = (),
    center_of_mass: FloatArray | None = None,
    searches: bool = True,
) -> tuple[tuple[StablePose, ...], str]:
    """Finds the poses in which an object rests.

    Args:
        mesh: Repaired, metres.
        given: Poses that the source states; they are kept.
        is_upright: Whether the source says that z is up.
        vertical: Which sides of its category are upright in the usual pose: 0 the longest, 1 the middle, 2 the shortest; none if that
            is not known.
        center_of_mass: In the frame of the mesh, (3,); None: the centre of its box. Of a pose and its reverse, the one with the lower
            centre of mass is likelier: things stand on their broad ends.
        searches: Whether poses are sought by physics; else z is up.

    Returns:
        At least one pose, the likeliest first, and what they rest on: ``given``, ``up_axis`` or ``physics``.
    """
    if given:
        weights = range(len(given), 0, -1)
        return tuple(
            StablePose(_canonical(rotation_matrix(normalise_quat(q))), n) for q, n in zip(given, weights, strict=True)
        ), "given"
    own = _Candidate(np.eye(3), 0.0, is_source=True)
    if not searches:
        return (StablePose(UPRIGHT, 1),), "up_axis"
    hull = hull_of_mesh(mesh)
    candidates = [own, *_quasi_static(hull, center_of_mass)]
    rested = _dropped(candidates, hull, center_of_mass)
    if not rested:  # a needle or a ball that rolls: the source's axis is all that is known
        return (StablePose(UPRIGHT, 1),), "up_axis"
    center = np.zeros(3) if center_of_mass is None else center_of_mass
    ranked = _ranked(_merged(rested), mesh, center, is_upright=is_upright, vertical=vertical)
    first = ranked[0]
    total = sum(c.probability for c in ranked) or 1.0
    counts = [100, *(min(99, max(1, round(100 * c.probability / total))) for c in ranked[1:])]
    rests_on = "up_axis" if first.is_source and is_upright else "physics"
    # Counts never rise, so that whoever sorts by them keeps the order.
    falling = np.minimum.accumulate(counts).tolist()
    return tuple(StablePose(_canonical(c.matrix), n) for c, n in zip(ranked, falling, strict=True)), rests_on


def _canonical(matrix: FloatArray) -> QuatXyzw:
    """The quaternion of a rotation, without its yaw."""
    quat = quat_of(Rotation.from_matrix(matrix))
    return tilt_of(quat, heading(quat)[0])


def _quasi_static(hull: Mesh, center_of_mass: FloatArray | None) -> list[_Candidate]:
    """Poses on the faces of a hull, with the shares of random falls that end there."""
    import trimesh

    step = float(hull.extents.max()) / _COARSE
    coarse = hull_of_mesh(Mesh(np.round(hull.vertices / step) * step, hull.faces))
    solid = trimesh.Trimesh(coarse.vertices, coarse.faces, process=False)
    center = solid.center_mass if center_of_mass is None else center_of_mass
    heights = np.einsum("ij,ij->i", center - solid.triangles_center, solid.face_normals)
    if not (np.isfinite(heights).all() and (heights < 0).all()):
        return []  # the search for poses would not end
    turns, shares = trimesh.poses.compute_stable_poses(solid, center, threshold=_LEAST_PROBABILITY, seed=0)
    found = [_Candidate(np.array(turn[:3, :3]), float(share)) for turn, share in zip(turns, shares, strict=True)]
    return _different_first(_merged(found), hull)[:_MOST_POSES]


def _different_first(candidates: Sequence[_Candidate], hull: Mesh) -> list[_Candidate]:
    """Puts one pose of each height, and its reverse, before further ones of the same height: a round bottle lies in many ways."""
    first: list[_Candidate] = []
    others: list[_Candidate] = []
    heights: list[float] = []
    for candidate in candidates:
        height = float(np.ptp(hull.vertices @ candidate.matrix[2]))
        same = [k for k, other in enumerate(heights) if abs(height - other) <= _SAME_HEIGHT * other]
        if all(float(first[k].matrix[2] @ candidate.matrix[2]) < _REVERSE for k in same):
            first.append(candidate)
            heights.append(height)
        else:
            others.append(candidate)
    return first + others


def _merged(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Joins poses whose upward directions are nearly equal, the most probable first; the source's own pose stays as it is."""
    order = sorted(range(len(candidates)), key=lambda k: (not candidates[k].is_source, -candidates[k].probability, k))
    kept: list[_Candidate] = []
    for k in order:
        new = candidates[k]
        for n, old in enumerate(kept):
            if float(old.matrix[2] @ new.matrix[2]) > math.cos(_SAME):
                kept[n] = _Candidate(old.matrix, old.probability + new.probability, old.is_source)
                break
        else:
            kept.append(new)
    return sorted(kept, key=lambda c: (-c.probability, not c.is_source))


def _dropped(candidates: Sequence[_Candidate], hull: Mesh, center_of_mass: FloatArray | None) -> list[_Candidate]:
    """Lets an object fall by 2 mm in each pose, and returns the poses in which it comes to rest; on a table its hull touches."""
    from stable_data.simulation.settling import Inertial, PhysicsOptions, RigidBody, settle

    try:
        even = None if center_of_mass is None else mass_properties(hull, mass=_UNIT_MASS)
    except MeshError:  # a hull without a volume
        even = None
    reach = _GAP * float(np.linalg.norm(hull.extents))
    bodies = []
    for k, candidate in enumerate(candidates):
        corners = hull.vertices @ candidate.matrix.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        turned = Mesh(corners - (low + high) / 2, hull.faces)
        place = ((k + 0.5) * reach, reach / 2, float(high[2] - low[2]) / 2 + _DROP)
        inertial = None
        if center_of_mass is not None and even is not None:
            matrix = candidate.matrix
            inertial = Inertial(matrix @ center_of_mass - (low + high) / 2, matrix @ even.inertia @ matrix.T)
        bodies.append(RigidBody(f"pose {k}", (turned,), _UNIT_MASS, place, inertial=inertial))
    options = PhysicsOptions(settle_seconds=_SECONDS, watch_seconds=0.1, rest_speed=5e-3)
    try:
        result = settle(bodies, Tabletop("table", (len(bodies) * reach, reach)), options)
    except MeshError:
        return []
    rested = []
    for k, candidate in enumerate(candidates):
        position, quat = result.pose(k)
        if not (np.isfinite(position).all() and np.isfinite(quat).all() and position[2] > 0):
            continue
        turn = rotation_matrix(quat) @ candidate.matrix
        stays = float(turn[2] @ candidate.matrix[2]) > math.cos(_SAME)
        if stays:
            rested.append(
                _Candidate(
                    candidate.matrix if candidate.is_source else _on_face(candidate.matrix, hull),
                    candidate.probability,
                    candidate.is_source,
                )
            )
        elif abs(position[2]) < reach:
            rested.append(_Candidate(_on_face(turn, hull), candidate.probability))
    return rested


def _on_face(matrix: FloatArray, hull: Mesh) -> FloatArray:
    """A pose turned by up to two degrees, so that the largest face of the hull that is nearly level below is level."""
    corners = hull.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ matrix.T
    area = np.linalg.norm(normals, axis=1)
    down = -normals[:, 2] / np.maximum(area, 1e-300)
    area = np.where(down > math.cos(_EXACT), area, 0.0)
    if not area.any():
        return matrix
    normal = normals[int(np.argmax(area))]
    level, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [normal / np.linalg.norm(normal)])
    turned: FloatArray = level.as_matrix() @ matrix
    return turned


def _ranked(
    candidates: Sequence[_Candidate], mesh: Mesh, center: FloatArray, *, is_upright: bool, vertical: Collection[int]
) -> list[_Candidate]:
    """Poses, the likeliest first.

    What counts, in this order: the true up axis of the source, the usual height, the guess of the source, a hollow that opens upward,
    a low centre of mass, the share of random falls.
    """

    def key(candidate: _Candidate) -> tuple[bool, int, bool, bool, bool, float]:
        posed = Mesh(mesh.vertices @ candidate.matrix.T, mesh.faces)
        sides, height = _sides(posed)
        misfit = min((abs(math.log(height / sides[k])) for k in vertical), default=0.0)
        low, high = posed.vertices[:, 2].min(), posed.vertices[:, 2].max()
        level = float((candidate.matrix @ center)[2] - low) / max(float(high - low), 1e-9)
        return (
            not (candidate.is_source and is_upright),
            int(np.searchsorted(_FITS, misfit)),
            not candidate.is_source,
            not (vertical and misfit < _FITS[-1] and _holds(upward_hollow(posed), posed)),
            level > _LOW,
            -candidate.probability,
        )

    return [candidate for _, candidate in sorted(((key(c), c) for c in candidates), key=lambda pair: pair[0])]


def _sides(posed: Mesh) -> tuple[FloatArray, float]:
    """Sides of the smallest upright box around a posed mesh, the longest first, (3,); and its height."""
    around = shapely.minimum_rotated_rectangle(shapely.linestrings(posed.vertices[:, :2]))  # a line is made faster than points
    corners = shapely.get_coordinates(around)[:3]
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    height = float(posed.extents[2])
    sides = np.zeros(3)
    sides[: 1 + len(lengths)] = height, *lengths
    least = 1e-4 * max(float(sides.max()), 1e-9)
    return np.maximum(np.sort(sides)[::-1], least), max(height, least)
