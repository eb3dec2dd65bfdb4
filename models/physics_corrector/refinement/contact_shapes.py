"""The shapes of objects as the refinement reads them: signed distances, samples, and outlines seen from above."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation
from torch import Tensor

from models.physics_corrector.certify.static_stability import centre_of_mass
from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from models.physics_corrector.geometry.shape_tensors import ShapeTensors, grid_map, shell_reach, source_of
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.aspects import aspect_steps
from stable_data.geometry.sdf.grid import SdfGrid
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import surface_points
from stable_data.scene import FloatArray, QuatXyzw, Scene, Vec3

_NUM_SAMPLES = 1024  # samples of a shape
_NUM_CORNERS = 160  # of these at most so many are corners of its convex hull, which touch first
_NUM_SIDES = 32  # corners of an outline
_MOST_UNITS = 5_000  # shapes of scale 1 in memory, 13 kB each
_DIGITS = 6  # decimals by which two relative scales are equal


@dataclass(frozen=True, slots=True, eq=False)
class ContactShapes:
    """K shapes.

    Attributes:
        tensors: Their signed distances.
        samples: Points of their surfaces, (K, 1024, 3) float32, metres, yaw frame.
        outline: Corners of their outlines seen from above, (K, 32, 2) float32, metres, yaw frame.
        middle: Their centres of mass, (K, 3) float32, metres, yaw frame.
    """

    tensors: ShapeTensors
    samples: Tensor
    outline: Tensor
    middle: Tensor

    def to(self, device: torch.device | str) -> "ContactShapes":
        """Copies the tensors to a device."""
        return ContactShapes(*(getattr(self, name).to(device) for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class _UnitShape:
    """A shape whose largest factor of scale is 1; all lengths grow with that factor, and the offset of the map does not."""

    linear: FloatArray
    offset: FloatArray
    samples: npt.NDArray[np.float32]
    outline: npt.NDArray[np.float32]
    middle: npt.NDArray[np.float32]


class ContactShapeCache:
    """Makes the contact shapes of batches of scenes; what does not depend on the size of an asset is made once.

    It is made from the asset alone, never from the object that needed it first: two corners of an outline may be equally far out, and at
    another size rounding chooses the other one, which moves objects by centimetres.

    Args:
        store: Meshes of the assets.
        grids: Their signed-distance grids.
    """

    def __init__(self, store: AssetStore, grids: ContactGrids) -> None:
        self._store, self._grids = store, grids
        self._points: OrderedDict[str, FloatArray] = OrderedDict()
        self._units: OrderedDict[tuple[str, Vec3, QuatXyzw], _UnitShape] = OrderedDict()

    def shapes_of(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]]) -> tuple[ContactShapes, list[list[int]]]:
        """Returns the shapes of scenes, and the index of each object's shape.

        Args:
            scenes: The scenes, resolved (``AssetStore.resolved``).
            shapes: The geometry of the objects of each scene, in order.

        Raises:
            MeshError: A mesh gives no grid or samples.
        """
        order: dict[tuple[str, Vec3, QuatXyzw], int] = {}
        grids: dict[tuple[str, tuple[int, int, int]], int] = {}
        found: list[SdfGrid] = []
        rows: list[tuple[_UnitShape, float, int, SdfGrid]] = []
        indices: list[list[int]] = []
        for scene, own in zip(scenes, shapes, strict=True):
            indices.append([])
            for o, shape in zip(scene.objects, own, strict=True):
                asset_id, mesh, scale, tilt = source_of(o, shape, self._store)
                if (key := (asset_id, scale, tilt)) not in order:
                    unit, grid = self._made(asset_id, mesh, scale, tilt)
                    number = grids.setdefault((asset_id, aspect_steps(_relative(scale))), len(found))
                    if number == len(found):
                        found.append(grid)
                    order[key] = len(rows)
                    rows.append((unit, max(scale), number, grid))
                indices[-1].append(order[key])
        return _stacked(rows, found), indices

    def make(self, scene: Scene, shapes: Sequence[Shape]) -> None:
        """Makes what a scene needs, and keeps it.

        Raises:
            MeshError: As for :meth:`shapes_of`.
        """
        for o, shape in zip(scene.objects, shapes, strict=True):
            self._made(*source_of(o, shape, self._store))

    def _made(self, asset_id: str, mesh: Mesh, scale: Vec3, tilt: QuatXyzw) -> tuple[_UnitShape, SdfGrid]:
        scale = _relative(scale)
        is_sheet = bool(asset_id) and self._store.asset(asset_id).report.is_sheet
        grid = self._grids.grid(mesh, aspect_steps(scale), is_sheet=is_sheet)
        return self._unit(asset_id, mesh, scale, tilt, grid), grid

    def _unit(self, asset_id: str, mesh: Mesh, scale: Vec3, tilt: QuatXyzw, grid: SdfGrid) -> _UnitShape:
        key = (asset_id, scale, tilt)
        if key not in self._units:
            while len(self._units) >= _MOST_UNITS:
                self._units.popitem(last=False)
            self._units[key] = self._unit_shape(asset_id, mesh, scale, tilt, grid)
        self._units.move_to_end(key)
        return self._units[key]

    def _unit_shape(self, asset_id: str, mesh: Mesh, scale: Vec3, tilt: QuatXyzw, grid: SdfGrid) -> _UnitShape:
        shape = self._store.shape_at(asset_id, scale, tilt) if asset_id else Shape.from_mesh(mesh, scale, tilt)
        rotation = Rotation.from_quat(tilt).as_matrix()
        linear, centre = grid_map(mesh, scale, rotation, shape.vertices[0], grid)
        if asset_id not in self._points:
            while len(self._points) >= _MOST_UNITS:
                self._points.popitem(last=False)
            self._points[asset_id] = surface_points(mesh, _NUM_SAMPLES)[0].astype(np.float64)
        samples = (self._points[asset_id] * scale) @ rotation.T - centre
        corners = _hull_corners(shape)
        samples[_NUM_SAMPLES - len(corners) :] = corners  # the first ones, farthest-point ordered, cover the surface evenly
        return _UnitShape(
            linear,
            linear @ centre,
            samples.astype(np.float32),
            _outline(shape).astype(np.float32),
            centre_of_mass(shape).astype(np.float32),
        )


def _relative(scale: Vec3) -> Vec3:
    """Returns a scale over its largest factor, rounded, so that an asset has one at all sizes."""
    x, y, z = (round(s / max(scale), _DIGITS) for s in scale)
    return x, y, z


def _stacked(rows: Sequence[tuple[_UnitShape, float, int, SdfGrid]], grids: Sequence[SdfGrid]) -> ContactShapes:
    """Scales unit shapes and joins them; each row is a unit shape, its factor, and the index of its grid and the grid."""

    def joined(parts: list[npt.NDArray[np.float32]], shape: tuple[int, ...]) -> Tensor:
        return torch.from_numpy(np.array(parts, np.float32).reshape(-1, *shape))

    affine = [np.concatenate([unit.linear / f, unit.offset[:, None]], axis=1) for unit, f, _, _ in rows]
    metres = torch.tensor([grid.extent * f for _, f, _, grid in rows], dtype=torch.float32)
    samples = joined([f * unit.samples for unit, f, _, _ in rows], (_NUM_SAMPLES, 3))
    tensors = ShapeTensors(
        atlas=SdfAtlas.from_grids(grids),
        grid_index=torch.tensor([number for _, _, number, _ in rows], dtype=torch.int64),
        unit_from_yaw=joined([a.astype(np.float32) for a in affine], (3, 4)),
        metres_per_unit=metres,
        reach=torch.tensor([shell_reach(grid, f) for _, f, _, grid in rows], dtype=torch.float32),
        surface=samples,
        bottom=samples[:, :0],
    )
    outline = joined([f * unit.outline for unit, f, _, _ in rows], (_NUM_SIDES, 2))
    return ContactShapes(tensors, samples, outline, joined([f * unit.middle for unit, f, _, _ in rows], (3,)))


def _hull_corners(shape: Shape) -> FloatArray:
    """Returns corners of the convex hull, at most ``_NUM_CORNERS``, the extreme ones of directions all around if it has more."""
    try:
        corners = shape.vertices[ConvexHull(shape.vertices).vertices]
    except QhullError:  # a flat shape
        corners = np.unique(shape.vertices, axis=0)
    if len(corners) > _NUM_CORNERS:
        k = np.arange(_NUM_CORNERS) + 0.5
        polar, around = np.arccos(1 - 2 * k / _NUM_CORNERS), np.pi * (1 + 5**0.5) * k  # a Fibonacci sphere
        ways = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])
        corners = corners[np.unique((corners @ ways).argmax(axis=0))]
    return np.asarray(corners)


def _outline(shape: Shape) -> FloatArray:
    """Returns the corners of the footprint that are extreme in evenly spaced directions, (32, 2)."""
    angles = 2 * np.pi * np.arange(_NUM_SIDES) / _NUM_SIDES
    return np.asarray(shape.footprint[(shape.footprint @ np.stack([np.cos(angles), np.sin(angles)])).argmax(axis=0)])
