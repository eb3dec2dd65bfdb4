"""Solids as unions of convex parts: lofts, vessels, bars. The parts are also the colliders of the solid.

Frame: z up, metres. An outer circle has 48 corners and the circle of a hollow has 16, so that each part of a wall is convex.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from operator import add
from typing import Any, TypeAlias

import manifold3d
import numpy as np

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray, IntArray

NUM_AROUND = 48
"""Corners of an outer circle."""

NUM_INSIDE = 16
"""Corners of a round hollow, one per part of its wall."""

Ring: TypeAlias = FloatArray  # (M, 3), counter-clockwise seen from the direction of the loft
Profile: TypeAlias = Sequence[tuple[float, float]]  # (radius, z) from the bottom up, metres

_CONVEX = 1e-9  # largest relative difference between the hull of a convex stack and the sum of its layers


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A closed solid and the convex parts whose union it is.

    Attributes:
        body: The solid, a ``manifold3d.Manifold``.
        parts: Corners of each convex part, (P, 3) float64, metres.
        paints: Colours of painted surfaces: (manifold's number of the original, colour).
        handle: Corners of the convex parts by which a hand holds the solid; empty if it has no handle.
    """

    body: Any
    parts: tuple[FloatArray, ...]
    paints: tuple[tuple[int, str], ...] = ()
    handle: tuple[FloatArray, ...] = ()

    def __add__(self, other: "Solid") -> "Solid":
        """The union."""
        return Solid(self.body + other.body, self.parts + other.parts, self.paints + other.paints, self.handle + other.handle)

    def painted(self, color: str) -> "Solid":
        """The solid in one colour, which its surface retains in unions."""
        # The numbers of originals count up, and unions order their faces by them: the order of creation shapes the mesh.
        body = self.body.as_original()
        return replace(self, body=body, paints=((body.original_id(), color),))

    def as_handle(self) -> "Solid":
        """The solid as the part by which a hand holds what it becomes a part of."""
        return replace(self, handle=self.parts)

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """The translated solid, metres."""
        return self._mapped(self.body.translate((x, y, z)), lambda corners: corners + np.array([x, y, z]))

    def turned(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """The solid rotated about x, then y, then z, degrees."""
        rotation = _rotation(x, y, z)
        return self._mapped(self.body.transform(np.c_[rotation, np.zeros(3)]), lambda corners: corners @ rotation.T)

    def resized(self, share: float) -> "Solid":
        """The solid scaled about the origin."""
        return self._mapped(self.body.scale((share, share, share)), lambda corners: corners * share)

    def leaned(self, slope: float) -> "Solid":
        """The solid sheared backwards by ``slope`` metres per metre of height; its foot stays level."""
        shear = np.eye(3)
        shear[1, 2] = slope
        return self._mapped(self.body.transform(np.c_[shear, np.zeros(3)]), lambda corners: corners @ shear.T)

    def grounded(self) -> "Solid":
        """The solid with its lowest point at z = 0."""
        return self.moved(z=-self.body.bounding_box()[2])

    def _mapped(self, body: Any, of: Callable[[FloatArray], FloatArray]) -> "Solid":
        """The solid with another body, and its corners changed likewise."""
        return Solid(body, tuple(map(of, self.parts)), self.paints, tuple(map(of, self.handle)))


def join(solids: Iterable[Solid]) -> Solid:
    """Returns the union of solids that overlap or touch."""
    return reduce(add, solids)


def circle(radius: float, z: float, corners: int = NUM_AROUND) -> Ring:
    """Returns a regular ring around the z axis, (corners, 3), metres."""
    angle = 2 * np.pi * np.arange(corners) / corners
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(corners, z)], axis=1)


def rectangle(width: float, depth: float, z: float, bevel: float = 0.0) -> Ring:
    """Returns a ring of four corners, or of eight if ``bevel`` cuts them at 45 degrees, metres; it starts at a corner."""
    x, y, b = width / 2, depth / 2, bevel
    if not b:
        outline = [(x, -y), (x, y), (-x, y), (-x, -y)]
    else:
        outline = [(x, b - y), (x, y - b), (x - b, y), (b - x, y), (-x, y - b), (-x, b - y), (b - x, -y), (x - b, -y)]
    return np.array([(*xy, z) for xy in outline])


def loft(rings: Sequence[Ring]) -> Solid:
    """Connects rings with equal numbers of corners to a tube that is closed at both ends.

    Args:
        rings: Flat convex rings for which each four-cornered side between two rings is flat.

    Returns:
        The solid; its parts are the longest runs of layers that are convex.
    """
    return Solid(_tube(rings), tuple(_convex_runs(rings)))


def chain(rings: Sequence[Ring]) -> Solid:
    """Returns the union of the convex hulls of successive rings: a loft whose sides need not be flat."""
    parts = []
    for k in range(len(rings) - 1):
        # A tip inside the next part prevents two parts from sharing a face, where rounding would leave slivers.
        ends = rings[k + 1 : k + 3]
        tip = ends[0].mean(axis=0) * 0.9 + ends[-1].mean(axis=0) * 0.1
        parts.append(np.vstack([rings[k], rings[k + 1], tip]))
    hulls = [manifold3d.Manifold.hull_points(part) for part in parts]
    return Solid(manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add), tuple(parts))


def hull(points: FloatArray) -> Solid:
    """Returns the convex hull of points, (N, 3), metres."""
    return Solid(manifold3d.Manifold.hull_points(points), (points,))


def lathe(profile: Profile, corners: int = NUM_AROUND) -> Solid:
    """Returns a solid of revolution.

    Args:
        profile: Its outside.
        corners: Corners of its section.
    """
    return loft([circle(r, z, corners) for r, z in profile])


def vessel(outer: Sequence[Ring], inner: Sequence[Ring]) -> Solid:
    """Returns a solid with a hollow that is open at the top.

    Args:
        outer: Rings of the outside from the bottom up; each has the number of corners of ``inner`` or a multiple.
        inner: Rings of the hollow from its floor up; the last is at the height of the rim.

    Returns:
        The solid. Its parts are the floor and, for each layer of the hollow, one part of the wall per corner.
    """
    mouth = inner[-1] + (inner[-1] - inner[-2]) * 0.25  # extends above the rim, so that no two faces coincide
    body = _tube(outer) - _tube([*inner, mouth])
    # The wall needs an outer ring at the height of each ring of the hollow.
    cuts = [_cut(outer, ring[0, 2]) for ring in inner]
    parts = list(_convex_runs([*_between(outer, -np.inf, inner[0][0, 2]), cuts[0]]))
    for k in range(len(inner) - 1):
        walls = [cuts[k], *_between(outer, inner[k][0, 2], inner[k + 1][0, 2]), cuts[k + 1]]
        parts.extend(_sectors(walls, inner[k : k + 2]))
    return Solid(body, tuple(parts))


def turned_vessel(outer: Profile, inner: Profile) -> Solid:
    """Returns a vessel of revolution from the profiles of its outside and of its hollow."""
    return vessel([circle(r, z) for r, z in outer], [circle(r, z, NUM_INSIDE) for r, z in inner])


def box(width: float, depth: float, height: float, bevel: float = 0.0) -> Solid:
    """Returns a box that stands on z = 0; ``bevel`` cuts its upright edges, metres."""
    return loft([rectangle(width, depth, 0.0, bevel), rectangle(width, depth, height, bevel)])


def slab(width: float, depth: float, height: float, bevel: float) -> Solid:
    """Returns a box that stands on z = 0; ``bevel`` cuts all its edges, metres."""
    b = bevel
    rings = [rectangle(width - 2 * b, depth - 2 * b, 0, b), rectangle(width, depth, b, 2 * b)]
    return loft([*rings, rectangle(width, depth, height - b, 2 * b), rectangle(width - 2 * b, depth - 2 * b, height, b)])


def bar(path: Sequence[tuple[float, float]], width: float, thickness: float, corners: int = 12) -> Solid:
    """Returns a bent bar of elliptic section along a path in the plane y = 0, mitred at the bends.

    Args:
        path: (x, z) of its axis, metres.
        width: Width along y, metres.
        thickness: Thickness in the plane, metres.
        corners: Corners of the section.
    """
    points = np.array(path, np.float64)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1)[:, None]
    before, after = np.vstack([steps[:1], steps]), np.vstack([steps, steps[-1:]])
    mitre = before + after
    mitre /= np.linalg.norm(mitre, axis=1)[:, None]
    # A mitred section is wider than the bar, by one over the cosine of half the bend.
    stretch = 1 / (mitre * after).sum(axis=1)
    angle = 2 * np.pi * np.arange(corners) / corners
    rings = []
    for point, (along_x, along_z), scale in zip(points, mitre, stretch, strict=True):
        aside = np.array([along_z, 0.0, -along_x]) * scale * thickness / 2
        offset = np.cos(angle)[:, None] * aside + np.sin(angle)[:, None] * np.array([0.0, width / 2, 0.0])
        rings.append(np.array([point[0], 0.0, point[1]]) + offset)
    return loft(rings)


def mesh_of(solid: Solid) -> tuple[Mesh, tuple[Mesh, ...], FloatArray]:
    """Converts a solid into a triangle mesh and its convex parts, translated so that the mesh is centred on its box.

    Returns:
        The closed mesh and the hull of each part, metres, and the centre before the translation, (3,) float64.

    Raises:
        MeshError: The union failed.
    """
    if solid.body.status() != manifold3d.Error.NoError or solid.body.num_tri() == 0:
        raise MeshError(
            f"a union of {len(solid.parts)} parts has status {solid.body.status()}, expected a valid solid; check that its parts overlap",
            "union",
        )
    mesh = _mesh(solid.body)
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    parts = (_mesh(manifold3d.Manifold.hull_points(part - centre)) for part in solid.parts)
    return Mesh(mesh.vertices - centre, mesh.faces), tuple(parts), centre


def coats(solid: Solid) -> dict[str | None, IntArray]:
    """Face indices of :func:`mesh_of` by colour, None for unpainted faces."""
    raw, color_of = solid.body.to_mesh64(), dict(solid.paints)
    # A run index counts triangle corners, three per face.
    bounds = np.asarray(raw.run_index, np.int64) // 3
    found: dict[str | None, list[IntArray]] = {}
    for original, first, last in zip(raw.run_original_id, bounds[:-1], bounds[1:], strict=True):
        found.setdefault(color_of.get(int(original)), []).append(np.arange(first, last))
    return {color: np.concatenate(rows) for color, rows in found.items()}


def volume(mesh: Mesh) -> float:
    """The volume that a closed mesh encloses, cubic mesh units."""
    a, b, c = (mesh.triangles[:, n] for n in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6


def _mesh(body: Any) -> Mesh:
    raw = body.to_mesh64()
    return Mesh(np.asarray(raw.vert_properties, np.float64)[:, :3], np.asarray(raw.tri_verts).astype(np.int64))


def _tube(rings: Sequence[Ring]) -> Any:
    vertices, faces = np.concatenate(rings), _tube_faces(len(rings), len(rings[0]))
    body = manifold3d.Manifold(manifold3d.Mesh64(vertices, faces.astype(np.uint64)))
    if body.status() != manifold3d.Error.NoError:
        raise MeshError(f"a loft of {len(rings)} rings has status {body.status()}, expected a closed tube", "loft")
    # The rings may run clockwise: then the tube is inside out.
    return body if body.volume() > 0 else _tube([ring[::-1] for ring in rings])


def _tube_faces(num_rings: int, num_corners: int) -> IntArray:
    corner = np.arange(num_corners)
    following = (corner + 1) % num_corners
    faces = []
    for k in range(num_rings - 1):
        low, high = k * num_corners, (k + 1) * num_corners
        # Two triangles per side of the tube.
        faces.append(np.stack([low + corner, low + following, high + following], axis=1))
        faces.append(np.stack([low + corner, high + following, high + corner], axis=1))
    # A fan closes each end; the lower one faces down.
    fan = np.stack([np.zeros(num_corners - 2, np.int64), corner[1:-1], corner[2:]], axis=1)
    faces += [fan[:, ::-1], fan + (num_rings - 1) * num_corners]
    return np.concatenate(faces)


def _convex_runs(rings: Sequence[Ring]) -> Iterable[FloatArray]:
    """Corners of the longest convex stacks of layers, greedily from the first."""
    layers = [_hull_volume(rings[k : k + 2]) for k in range(len(rings) - 1)]
    start = 0
    while start < len(layers):
        end = start + 1
        while end < len(layers) and _hull_volume(rings[start : end + 2]) <= sum(layers[start : end + 1]) * (1 + _CONVEX):
            end += 1
        yield np.concatenate(rings[start : end + 1])
        start = end


def _hull_volume(rings: Sequence[Ring]) -> float:
    return float(manifold3d.Manifold.hull_points(np.concatenate(rings)).volume())


def _between(rings: Sequence[Ring], low: float, high: float) -> list[Ring]:
    return [ring for ring in rings if low + 1e-12 < ring[0, 2] < high - 1e-12]


def _cut(rings: Sequence[Ring], z: float) -> Ring:
    """The outside at one height: the ring there, or the interpolation of its neighbours."""
    for low, high in pairwise(rings):
        if low[0, 2] - 1e-12 <= z <= high[0, 2] + 1e-12:
            share = (z - low[0, 2]) / (high[0, 2] - low[0, 2])
            return np.asarray(low + share * (high - low))
    raise MeshError(f"the hollow reaches z = {z}, expected a height inside the vessel", "vessel")


def _sectors(walls: Sequence[Ring], hollow: Sequence[Ring]) -> Iterable[FloatArray]:
    """One convex part of the wall for each corner of the hollow's rings."""
    num_inside = len(hollow[0])
    share = len(walls[0]) // num_inside
    for k in range(num_inside):
        outside = [ring[np.arange(k * share, (k + 1) * share + 1) % len(ring)] for ring in walls]
        inside = [ring[[k, (k + 1) % num_inside]] for ring in hollow]
        yield np.concatenate([*outside, *inside])


def _rotation(x: float, y: float, z: float) -> FloatArray:
    """Rz(z) · Ry(y) · Rx(x), degrees, (3, 3)."""
    rotation = np.eye(3)
    for axis, angle in enumerate(np.radians([x, y, z])):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        rotation = turn @ rotation
    return rotation
