"""The shapes of scenes for the losses: samples in the yaw frame, and the map from the yaw frame to the signed-distance grid.

A *shape* is an asset at a scale and tilt, or the box that replaces a missing mesh. Scenes refer to shapes by index, so that
each shape is in memory once.

A grid belongs to the mesh at its aspect, rounded to steps of 5 %. The map from the yaw frame to the grid compensates the
rounding, at most 2.5 % per axis; the distance does not. The zero level is therefore exactly at the mesh, so contacts are
preserved, and a distance has a relative error of at most 2.5 %. Without the compensation a plate's rim would be off by
millimetres.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from stable_data.assets.store import AssetStore
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.geometry.sdf.build import build_grid
from stable_data.geometry.sdf.grid import SdfGrid
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import bottom_points, surface_points
from stable_data.scene import FloatArray, QuatXyzw, SceneObject, Vec3

GridKey: TypeAlias = tuple[str, tuple[int, int, int]]
"""Asset and its aspect in steps of 5 % (``stable_data.geometry.sdf.aspects.aspect_steps``)."""

STRETCH = 1.03
"""Bound of the factor between a length in a grid's frame and the true length: half a step of the aspect, and a margin."""

_BOX_ASSET = ""  # asset id of boxes that replace missing meshes
_MIN_THICKNESS = 1e-3  # least extent of such a box, as a share of its largest: a flat box has no inside


@dataclass(frozen=True, slots=True, eq=False)
class ShapeTensors:
    """The shapes of a set of scenes, K of them.

    Attributes:
        atlas: Signed-distance grids, G of them.
        grid_index: Grid of each shape, (K,) int64.
        unit_from_yaw: Linear part and offset of the map from yaw frame to grid frame, which undoes tilt, scale and centre,
            (K, 3, 4) float32.
        metres_per_unit: Factor from a grid's distance to metres, (K,) float32.
        reach: A shape's grid is not negative farther than this outside the shape's box, (K,) float32, metres.
        surface: Q_i, samples of the surface, farthest-point ordered, (K, P, 3) float32, metres, yaw frame.
        bottom: B_i, samples of the bottom region, the lowest first, (K, Q, 3) float32, metres, yaw frame.
    """

    atlas: SdfAtlas
    grid_index: Tensor
    unit_from_yaw: Tensor
    metres_per_unit: Tensor
    reach: Tensor
    surface: Tensor
    bottom: Tensor

    def to(self, device: torch.device | str) -> "ShapeTensors":
        """Copies the tensors to a device."""
        return ShapeTensors(*(getattr(self, name).to(device) for name in self.__slots__))

    def __len__(self) -> int:
        """Number of shapes."""
        return len(self.grid_index)

    def signed_distance(self, shape_index: Tensor, points: Tensor) -> Tensor:
        """Computes D_s of each point and its shape; differentiable once with respect to the points.

        Args:
            shape_index: Shape of each point, (M,) int64.
            points: (M, 3) float32 or float64, metres, yaw frame of the shape.

        Returns:
            Distances, (M,), dtype of the points, negative inside, metres.
        """
        units = self._in_units(shape_index, points)[0]
        return self.metres_per_unit[shape_index] * self.atlas.sample(self.grid_index[shape_index], units)

    def signed_distance_with_normal(self, shape_index: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Computes D_s and the direction in which it grows; arguments as for :meth:`signed_distance`.

        Returns:
            Distances, (M,), metres, and unit vectors, (M, 3), yaw frame; the zero vector where D_s has no slope.
        """
        units, linear = self._in_units(shape_index, points)
        value, slope = self.atlas.sample_with_gradient(self.grid_index[shape_index], units)
        normal = torch.nn.functional.normalize((linear * slope[:, :, None]).sum(dim=1), dim=1)
        return self.metres_per_unit[shape_index] * value, normal

    def _in_units(self, shape_index: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns points in the frames of the grids, (M, 3), and the linear parts of the maps, (M, 3, 3)."""
        affine = self.unit_from_yaw[shape_index].to(points.dtype)
        linear = affine[:, :, :3]
        return (linear * points[:, None]).sum(dim=2) + affine[:, :, 3], linear


class ShapeCollector:
    """Collects the shapes of scenes, each once, in a :class:`ShapeTensors`.

    Args:
        store: Meshes of the assets.
        num_surface: P, the number of surface samples.
        num_bottom: Q, the number of samples of the bottom region.
        grids: Existing grids, such as those of :func:`grids_from_rows`; other grids are built on first use, in about a second
            each.
        points: Existing surface samples by asset, farthest-point ordered, (P, 3), mesh units, such as those of the table
            ``assets``; if they are fewer than ``num_surface``, new ones are drawn.
    """

    def __init__(
        self,
        store: AssetStore,
        *,
        num_surface: int = 256,
        num_bottom: int = 64,
        grids: Mapping[GridKey, SdfGrid] | None = None,
        points: Mapping[str, FloatArray] | None = None,
    ) -> None:
        self.store = store
        self._num_surface, self._num_bottom = num_surface, num_bottom
        self._grids = dict(grids or {})
        self._points = {asset_id: found for asset_id, found in (points or {}).items() if len(found) >= num_surface}
        self._grid_order: dict[GridKey, int] = {}
        self._shape_order: dict[tuple[Any, ...], int] = {}
        self._shapes: list[_Shape] = []

    def __len__(self) -> int:
        """Number of collected shapes."""
        return len(self._shapes)

    def index(self, o: SceneObject, shape: Shape) -> int:
        """Returns the index of an object's shape; a new shape is appended.

        Args:
            o: The object with the scale of its mesh, from ``AssetStore.resolved``.
            shape: Its geometry, from the same call.
        """
        key = (o.asset_id, o.scale, o.tilt_quat_xyzw) if shape.is_exact else (_BOX_ASSET, tuple(shape.size.tolist()))
        if key not in self._shape_order:
            self._shapes.append(self._prepare(o, shape))
            self._shape_order[key] = len(self._shapes) - 1
        return self._shape_order[key]

    def geometry(self) -> ShapeTensors:
        """Returns all collected shapes; indices remain valid when more are collected."""
        grids = [self._grids[key] for key in self._grid_order]
        shapes = self._shapes
        return ShapeTensors(
            atlas=SdfAtlas.from_grids(grids),
            grid_index=torch.tensor([s.grid_index for s in shapes], dtype=torch.int64),
            unit_from_yaw=_stacked([s.unit_from_yaw for s in shapes], (3, 4)),
            metres_per_unit=torch.tensor([s.metres_per_unit for s in shapes], dtype=torch.float32),
            reach=torch.tensor([s.reach for s in shapes], dtype=torch.float32),
            surface=_stacked([s.surface for s in shapes], (self._num_surface, 3)),
            bottom=_stacked([s.bottom for s in shapes], (self._num_bottom, 3)),
        )

    def _prepare(self, o: SceneObject, shape: Shape) -> "_Shape":
        asset_id, mesh, scale, tilt = source_of(o, shape, self.store)
        steps = aspect_steps(scale)
        grid = self._grid(asset_id, mesh, scale, steps)
        rotation = Rotation.from_quat(tilt).as_matrix()
        linear, centre = grid_map(mesh, scale, rotation, shape.vertices[0], grid)
        if asset_id not in self._points:
            self._points[asset_id] = surface_points(mesh, max(1024, self._num_surface))[0].astype(np.float64)
        surface = (self._points[asset_id][: self._num_surface] * scale) @ rotation.T - centre
        metres_per_unit = grid.extent * max(scale)
        return _Shape(
            grid_index=self._grid_order.setdefault((asset_id, steps), len(self._grid_order)),
            unit_from_yaw=np.concatenate([linear, (linear @ centre)[:, None]], axis=1),
            metres_per_unit=metres_per_unit,
            reach=shell_reach(grid, max(scale)),
            surface=surface.astype(np.float32),
            bottom=bottom_points(shape.vertices, shape.faces, self._num_bottom),
        )

    def _grid(self, asset_id: str, mesh: Mesh, scale: Vec3, steps: tuple[int, int, int]) -> SdfGrid:
        if (asset_id, steps) not in self._grids:
            is_box = asset_id == _BOX_ASSET
            grid = build_grid(mesh, aspect=aspect_of(steps)) if is_box else self.store.grid(asset_id, scale)
            self._grids[asset_id, steps] = grid
        return self._grids[asset_id, steps]


def source_of(o: SceneObject, shape: Shape, store: AssetStore) -> tuple[str, Mesh, Vec3, QuatXyzw]:
    """Returns asset, mesh, scale and tilt of a shape; the asset ``""`` and a unit cube, scaled, if the object has no mesh."""
    mesh = store.mesh_of(o) if shape.is_exact else None
    if mesh is not None and o.asset_id is not None and o.scale is not None:
        return o.asset_id, mesh, o.scale, o.tilt_quat_xyzw
    cube = Shape.box((1.0, 1.0, 1.0))
    x, y, z = np.maximum(shape.size, _MIN_THICKNESS * shape.size.max()).tolist()
    return _BOX_ASSET, Mesh(cube.vertices, cube.faces), (x, y, z), (0.0, 0.0, 0.0, 1.0)


def grid_map(
    mesh: Mesh, scale: Vec3, rotation: FloatArray, first_vertex: FloatArray, grid: SdfGrid
) -> tuple[FloatArray, FloatArray]:
    """Computes the map from the yaw frame to the frame of a grid: ``linear @ (point + centre)``.

    It undoes tilt, scale and centre. A grid belongs to the rounded aspect, and the map makes up for the rounding.

    Args:
        mesh: The mesh.
        scale: Its scale.
        rotation: Its tilt, (3, 3).
        first_vertex: Its first vertex in the yaw frame, (3,), in the lengths of ``scale``.
        grid: The grid of the mesh at the aspect of the scale.

    Returns:
        The linear part (3, 3), and the centre of the tilted box (3,), in the lengths of ``scale``.
    """
    unit_per_mesh = np.array(aspect_of(aspect_steps(scale))) / grid.extent
    linear = (unit_per_mesh / np.array(scale))[:, None] * rotation.T
    # The yaw frame's origin is the centre of the tilted box; one vertex in both frames gives the offset.
    return linear, rotation @ (mesh.vertices[0] * scale) - first_vertex


def shell_reach(grid: SdfGrid, factor: float) -> float:
    """Computes how far outside a shape's box its grid may be negative, metres.

    Args:
        grid: Its grid.
        factor: The largest component of its scale.
    """
    # The shell of an open mesh, and the diagonal of a cell, one corner of which may be negative.
    return STRETCH * grid.extent * factor * (grid.shell_thickness / 2 + math.sqrt(3) * grid.spacing)


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    """The entries of one shape in :class:`ShapeTensors`."""

    grid_index: int
    unit_from_yaw: FloatArray
    metres_per_unit: float
    reach: float
    surface: npt.NDArray[np.float32]
    bottom: npt.NDArray[np.float32]


def grids_from_rows(rows: Iterable[Mapping[str, Any]]) -> dict[GridKey, SdfGrid]:
    """Converts rows of the table ``sdf`` to grids by asset and aspect."""
    return {
        (row["asset_id"], aspect_steps(tuple(row["aspect"]))): SdfGrid(
            values=np.asarray(row["values"], np.float16).reshape(tuple(row["shape"])),
            origin=np.asarray(row["origin"], np.float64),
            spacing=row["spacing"],
            extent=row["extent"],
            shell_thickness=row["shell_thickness"],
            wall_thickness=row["wall_thickness"],
            mean_error=row["mean_error"],
            max_error=row["max_error"],
            far_error=row["far_error"],
            sign_error=row["sign_error"],
        )
        for row in rows
    }


def _stacked(arrays: Sequence[npt.NDArray[np.floating]], shape: tuple[int, ...]) -> Tensor:
    """Stacks K arrays of one shape, also none, as a float32 tensor, (K, *shape)."""
    return torch.from_numpy(np.array(arrays, np.float32).reshape(-1, *shape))
