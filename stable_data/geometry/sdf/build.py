"""Builds signed-distance grids: exact near the surface, propagated from there, and signed by regions.

Nodes farther than half a spacing from the surface form connected regions that no surface crosses, so one winding query gives the
sign of a whole region. docs/signed_distance.md compares this with an evaluation of every node.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, unit_normals
from stable_data.geometry.sdf.exact import BoolArray, SignedDistance
from stable_data.geometry.sdf.grid import USUAL_LIMITS, GridLimits, SdfGrid, sample_grid
from stable_data.geometry.sdf.narrow_band import GridNodes, NarrowBand, unsigned_distances
from stable_data.scene import FloatArray, IntArray, Vec3

_NUM_PROBES = 512
_THIN_SHARE = 20  # percentile of the inward rays that is the wall thickness: thinner places are edges and tips
_WINDING_TOLERANCE = 0.2  # a winding number this far from a whole number means a hole nearby, through which a region may leak
_VOTE_STRIDE = 8
_WALK_DISTANCES = (1.0, 1.7)  # spacings from the surface at which a node with a known sign is looked for
_NUM_NEAR, _NUM_FAR = 512, 256
_GOLDEN = 0.6180339887498949


def unit_mesh(mesh: Mesh, aspect: Vec3 = (1.0, 1.0, 1.0)) -> tuple[Mesh, float]:
    """Applies an aspect, the scale divided by its largest component, to a mesh, and divides it by the largest extent of its box.

    Returns:
        The unit mesh, and the length of its unit in the lengths of the mesh at its aspect.

    Raises:
        MeshError: ``mesh_empty``: the mesh has no extent.
    """
    vertices = mesh.vertices * np.asarray(aspect)
    extent = float(np.ptp(vertices[mesh.faces], axis=(0, 1)).max()) if len(mesh.faces) else 0.0
    if not (np.isfinite(extent) and extent > 0):
        raise MeshError(f"mesh has extent {extent} in {len(mesh.faces)} faces, expected a positive one", "mesh_empty")
    return Mesh(vertices / extent, mesh.faces), extent


def probe_points(mesh: Mesh, num_points: int) -> tuple[FloatArray, FloatArray]:
    """Points spread evenly over the surface, always the same ones, and the unit normals of their faces, (P, 3) each."""
    triangles = mesh.triangles
    normals, double_area = unit_normals(triangles)
    area = np.cumsum(double_area)
    k = np.arange(num_points)
    face = np.minimum(np.searchsorted(area, (k + 0.5) / num_points * area[-1]), len(area) - 1)
    # The R2 sequence (the golden ratio's analogue in the plane), folded into the triangle.
    u, v = (0.5 + 0.7548776662466927 * k) % 1, (0.5 + 0.5698402909980532 * k) % 1
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = triangles[face, 0], triangles[face, 1], triangles[face, 2]
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), normals[face]


def build_grid(
    mesh: Mesh,
    *,
    aspect: Vec3 = (1.0, 1.0, 1.0),
    is_sheet: bool = False,
    shell_thickness: float = 0.0,
    limits: GridLimits = USUAL_LIMITS,
) -> SdfGrid:
    """Builds the grid of a mesh at an aspect.

    The spacing follows the wall thickness of the mesh, between ``limits.min_nodes`` and ``limits.max_nodes``. A sheet gets a shell of
    at least one spacing, so that its surface is inside everywhere; the grid states the thickness used.

    Args:
        mesh: Repaired, mesh frame.
        aspect: Scale along the mesh's axes divided by its largest component.
        is_sheet: The mesh is open and represents a thin shell.
        shell_thickness: Thickness of that shell, in lengths of the mesh at its aspect.
        limits: Limits on the resolution.

    Returns:
        The grid, with its measured errors.

    Raises:
        MeshError: The mesh has no extent, or the thickness of a sheet is negative or not finite.
    """
    unit, extent = unit_mesh(mesh, aspect)
    exact = SignedDistance(unit, is_sheet=is_sheet, shell_thickness=shell_thickness / extent)
    wall = 0.0 if is_sheet else wall_thickness(exact)
    lattice = _lattice(unit, wall, limits)
    if is_sheet:
        # A thinner shell could lie between the nodes.
        exact = SignedDistance(unit, is_sheet=True, shell_thickness=max(shell_thickness / extent, lattice.spacing))
    band = NarrowBand.around(exact, lattice)
    distance = unsigned_distances(exact, lattice, band)
    inside = np.zeros(lattice.shape, np.bool_) if is_sheet else _inside(exact, lattice, band, distance)
    values = exact.signed(distance, inside).astype(np.float16)
    grid = SdfGrid(values, lattice.origin, lattice.spacing, extent, 2 * exact.half_thickness, wall)
    return measure_grid_errors(grid, exact)


def measure_grid_errors(grid: SdfGrid, exact: SignedDistance, *, num_near: int = _NUM_NEAR, num_far: int = _NUM_FAR) -> SdfGrid:
    """Measures the errors of a grid at points that are not nodes.

    Args:
        grid: The grid.
        exact: The exact distance that the grid approximates, unit frame.
        num_near: Points within a spacing of the surface.
        num_far: Points all over the box.

    Returns:
        The grid with ``mean_error``, ``max_error``, ``far_error`` and ``sign_error``.
    """
    points = _held_out(grid, exact.mesh, num_near, num_far)
    truth = exact(points)
    read = sample_grid(grid, points)[0]
    error, depth = np.abs(read - truth), np.abs(truth)
    is_near, is_clear = depth <= grid.spacing, depth >= grid.spacing / 2
    wrong = (read < 0) != (truth < 0)
    return replace(
        grid,
        mean_error=float(error[is_near].mean()) if is_near.any() else 0.0,
        max_error=float(error[is_near].max(initial=0)),
        far_error=float(error[~is_near].max(initial=0)),
        sign_error=float(wrong[is_clear].mean()) if is_clear.any() else 0.0,
    )


def _held_out(grid: SdfGrid, mesh: Mesh, num_near: int, num_far: int) -> FloatArray:
    """Points between the nodes: on both sides of the surface within a spacing, and all over the box."""
    surface, normals = probe_points(mesh, num_near)
    k = np.arange(num_near)
    offset = grid.spacing * (2 * ((0.5 + _GOLDEN * k) % 1) - 1)
    # The R3 sequence, the golden ratio's analogue in space.
    spread = (0.5 + np.outer(np.arange(num_far), [0.8191725133961645, 0.6710436067037893, 0.5497004779019703])) % 1
    box = grid.spacing * (np.array(grid.values.shape) - 1)
    return np.concatenate([surface + offset[:, None] * normals, grid.origin + spread * box])


def wall_thickness(exact: SignedDistance) -> float:
    """Thickness of the thin part of the wall, from rays shot inwards: their lower quintile, mesh units; 0 if none hits."""
    points, normals = probe_points(exact.mesh, _NUM_PROBES)
    # Rays start just below the surface, so that they do not hit their own face.
    travelled = exact.first_hit(points - 1e-6 * exact.mesh.extents.max() * normals, -normals)
    travelled = travelled[np.isfinite(travelled)]
    return float(np.percentile(travelled, _THIN_SHARE)) if len(travelled) else 0.0


def _lattice(unit: Mesh, wall: float, limits: GridLimits) -> GridNodes:
    """Chooses the nodes: as fine as the wall requires, within the limits, centred on the mesh's box."""
    low, high = unit.triangles.min(axis=(0, 1)), unit.triangles.max(axis=(0, 1))
    finest, coarsest = (_spacing(high - low, n, limits.padding) for n in (limits.max_nodes, limits.min_nodes))
    wanted = wall / limits.nodes_per_wall if wall > 0 else finest
    spacing = float(np.clip(wanted, finest, coarsest))
    shape = _shape(high - low, spacing, limits.padding)
    return GridNodes((low + high) / 2 - spacing * (np.array(shape) - 1) / 2, spacing, shape)


def _shape(size: FloatArray, spacing: float, padding: int) -> tuple[int, int, int]:
    """Numbers of nodes along each axis that cover a box of that size and the padding."""
    x, y, z = (int(n) + 1 + 2 * padding for n in np.ceil(size / spacing - 1e-9))  # rounding must not add a node
    return x, y, z


def _spacing(size: FloatArray, num_nodes: int, padding: int) -> float:
    """The smallest spacing, to a thousandth, whose lattice has at most that many nodes."""
    low, high = 1e-4, 1.0
    while high / low > 1.001:
        middle = float(np.sqrt(low * high))  # bisection on a logarithmic scale
        low, high = (low, middle) if np.prod(_shape(size, middle, padding)) <= num_nodes else (middle, high)
    return high


def _inside(exact: SignedDistance, lattice: GridNodes, band: NarrowBand, distance: FloatArray) -> BoolArray:
    """Whether every node is inside.

    If the distances of two neighbours add up to more than the distance between them, no surface is between them. So the nodes farther
    than half a spacing from the surface form regions with one sign each. A nearer node gets the sign of a node that is met when
    walking away from its nearest surface point. A remaining node straight behind a face is inside, if the surface is closed and
    oriented outwards and no sample of these nodes contradicts this. All other nodes get their own winding number.
    """
    regions, num_regions = ndimage.label(distance > lattice.spacing / 2)
    region = regions.ravel().astype(np.int64)
    is_inside, is_doubtful, is_closed = _sides(exact, lattice, region, num_regions, distance.ravel())
    inside = is_inside[region]
    is_close = region[band.nodes] == 0
    close = band.nodes[is_close]
    far = _far_neighbours(lattice, close, band.away[is_close], distance.ravel(), region)
    inside[close] = inside[far]
    is_left = (far < 0) | is_doubtful[region[far]]
    left = close[is_left]
    if is_closed and _behind_is_inside(exact, lattice, band, left):
        is_asked = ~band.is_behind[is_close][is_left]
        inside[left] = True
        left = left[is_asked]
    unknown = np.concatenate([left, np.flatnonzero(is_doubtful[region])])
    inside[unknown] = exact.is_inside(lattice.places(unknown))
    return inside.reshape(lattice.shape)


def _behind_is_inside(exact: SignedDistance, lattice: GridNodes, band: NarrowBand, left: IntArray) -> bool:
    """Whether a sample of the nodes straight behind a face is inside; this is false where two faces coincide."""
    slot = np.searchsorted(band.nodes, left)
    slot = slot[band.is_behind[slot]]
    one_a_face = slot[np.unique(band.face[slot], return_index=True)[1]]
    sample = one_a_face[:: 1 + len(one_a_face) // _NUM_PROBES]
    return bool(exact.is_inside(lattice.places(band.nodes[sample])).all())


def _sides(
    exact: SignedDistance, lattice: GridNodes, region: IntArray, num_regions: int, distance: FloatArray
) -> tuple[BoolArray, BoolArray, bool]:
    """Whether each region is inside, (R + 1,); whether it leaks, so that its nodes need own queries; and whether none leaks."""
    voter = np.zeros(num_regions + 1, np.int64)
    for depth in (0.0, 1.0, 2.0):  # the last write wins: a node deep in the region, if there is one, represents it
        nodes = np.flatnonzero(distance > depth * lattice.spacing)
        voter[region[nodes]] = nodes
    # Nodes of a coarse grid vote too: votes that differ within a region show that it leaks.
    grid = np.arange(lattice.size).reshape(lattice.shape)[(slice(_VOTE_STRIDE // 2, None, _VOTE_STRIDE),) * 3].ravel()
    nodes = np.concatenate([voter[1:], grid[region[grid] > 0]])
    winding = exact.winding_number(lattice.places(nodes))
    is_inside, is_outside, is_doubtful = np.zeros((3, num_regions + 1), np.bool_)
    is_inside[region[nodes[winding > 0.5]]] = True
    is_outside[region[nodes[winding <= 0.5]]] = True
    is_whole = np.abs(winding - np.round(winding)) <= _WINDING_TOLERANCE
    is_doubtful[region[nodes[~is_whole]]] = True
    is_doubtful |= is_inside & is_outside
    return is_inside, is_doubtful, bool(is_whole.all() and (winding > -_WINDING_TOLERANCE).all())


def _far_neighbours(lattice: GridNodes, close: IntArray, away: FloatArray, distance: FloatArray, region: IntArray) -> IntArray:
    """For each node near the surface a node that is certainly on the same side and in a region, flat index, or −1."""
    start = lattice.places(close)
    far = np.full(len(close), -1, np.int64)
    top = np.array(lattice.shape) - 1
    for step in _WALK_DISTANCES:
        node = np.clip(np.rint((start - lattice.origin) / lattice.spacing + step * away), 0, top).astype(np.int64)
        flat = np.ravel_multi_index(tuple(node.T), lattice.shape)
        apart = np.linalg.norm(lattice.origin + lattice.spacing * node - start, axis=1)
        is_safe = (distance[close] + distance[flat] > apart) & (region[flat] > 0)
        far = np.where((far < 0) & is_safe, flat, far)
    return far
