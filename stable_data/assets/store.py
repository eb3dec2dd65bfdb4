"""Geometry of assets: what a scene's objects look like at their scale and tilt, computed once."""

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError, Notice
from stable_data.geometry.gltf_reader import load_colliders, load_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint, load_paint
from stable_data.geometry.mesh_repair import MeshReport, repair_mesh
from stable_data.geometry.sdf.build import build_grid
from stable_data.geometry.sdf.grid import SdfGrid
from stable_data.geometry.shape import Shape
from stable_data.position_convention import (
    PositionConvention,
    has_size,
    keeps_box,
    to_box_centre,
)
from stable_data.rotations import normalise_quat
from stable_data.scene import QuatXyzw, Scene, SceneObject, Vec3

ASPECT_STEP = math.log(1.05)
"""Aspects are snapped to powers of 1.05, so that assets scaled nearly alike share a grid."""

# The tree of a shape lives as long as it, and takes 560 bytes a triangle.
_GOES_WITH = 48
_PASSING = ("glb_unreadable", "unexpected")  # faults that may be the machine's
_STAND_IN = "a box of its size stands in, and what rests on its mesh is unknown"

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class AssetSource(Protocol):
    """Where meshes come from; a :class:`~stable_data.mesatask.MesaTaskDataset` is one."""

    def asset_path(self, asset_id: str) -> Path | None:
        """The asset's GLB file, or None where there is none."""
        ...


@runtime_checkable
class PartSource(Protocol):
    """A source that also keeps the convex parts of its assets, such as the tables of a run."""

    def parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """Convex parts, in the frame and unit of the asset's mesh; none where it has none."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class AssetMesh:
    """A mesh that was read and repaired.

    Attributes:
        mesh: Mesh units, z up, centred on its box.
        report: What it is and what repair did.
        notices: What was odd about it.
    """

    mesh: Mesh
    report: MeshReport
    notices: tuple[Notice, ...]


class _Recent(Generic[K, V]):
    """The most recently used values whose weights stay under a bound."""

    def __init__(self, max_weight: int) -> None:
        self._values: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self._weight, self._max_weight = 0, max_weight

    def get(self, key: K, make: Callable[[], V], weigh: Callable[[V], int]) -> V:
        if key in self._values:
            self._values.move_to_end(key)
            return self._values[key][0]
        value = make()
        weight = weigh(value)
        self._values[key] = (value, weight)
        self._weight += weight
        while self._weight > self._max_weight and len(self._values) > 1:
            self._weight -= self._values.popitem(last=False)[1][1]
        return value


class AssetStore:
    """Meshes, shapes and grids of assets: each computed when first asked for, kept while memory allows.

    Args:
        source: Where the meshes are.
        max_bytes: Bound on what the meshes, the shapes and the grids that are kept take, each, bytes.
    """

    def __init__(self, source: AssetSource, max_bytes: int = 256 * 2**20) -> None:
        self._source = source
        self._meshes: _Recent[str, AssetMesh | MeshError] = _Recent(max_bytes)
        self._shapes: _Recent[Hashable, Shape] = _Recent(max_bytes)
        self._grids: _Recent[Hashable, SdfGrid] = _Recent(max_bytes)
        self._paints: _Recent[str, tuple[Paint, tuple[Notice, ...]]] = _Recent(max_bytes)
        self._faults: dict[str, str | None] = {}

    def asset(self, asset_id: str) -> AssetMesh:
        """The repaired mesh of an asset.

        Raises:
            MeshError: It is missing or cannot be used; the same words each time, but what may be the machine's fault is tried
                anew each time: else what a process made would depend on what it had made before.
        """
        found = self._meshes.get(asset_id, lambda: self._load(asset_id), _mesh_bytes)
        if isinstance(found, MeshError):
            raise MeshError(str(found), found.code)
        return found

    def colliders(self, asset_id: str) -> tuple[Mesh, ...]:
        """The convex parts that came with an asset's file, in the frame of its mesh; none where it has none that can be used.

        Raises:
            MeshError: The file cannot be read for now: other parts would be made of it, and kept.
        """
        path = self._source.asset_path(asset_id)
        return () if path is None else colliders_of(path, asset_id)

    def kept_parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """The convex parts that its source keeps of an asset, see :class:`PartSource`; none where it keeps none."""
        return self._source.parts(asset_id) if isinstance(self._source, PartSource) else ()

    def shape(self, o: SceneObject) -> tuple[Shape, tuple[Notice, ...]]:
        """The geometry of an object at its scale and tilt.

        Where its scale is missing, or gives another box than ``size``, the mesh is fitted to ``size``; where the mesh itself is
        missing or broken, or nothing fits, a box of ``size`` stands in.

        Returns:
            The shape, metres, yaw frame; and what had to be done, with the object's instance as ``item_id``.
        """
        shape, _, odd = self._shape_and_scale(o)
        return shape, odd

    def _shape_and_scale(self, o: SceneObject) -> tuple[Shape, Vec3 | None, tuple[Notice, ...]]:
        """As ``shape``, with the scale that the mesh has in it; None where none fits, the object's own where there is no mesh."""
        if o.asset_id is None:
            return Shape.box(o.size), o.scale, ()  # the reader has said why
        try:
            asset = self.asset(o.asset_id)
        except MeshError as error:
            message = f"object {o.instance}: {error}; {_STAND_IN}"
            return Shape.box(o.size), o.scale, (Notice(o.instance, "mesh", error.code, message),)
        odd = tuple(Notice(o.instance, n.step, n.code, f"object {o.instance}: {n.message}") for n in asset.notices)
        if o.scale is not None:
            shape = self._scaled(o.asset_id, asset, o.scale, o.tilt_quat_xyzw)
            if has_size(shape.size, o.size):
                return shape, o.scale, odd
            message = (
                f"object {o.instance}: asset {o.asset_id} at its scale is {_in_cm(shape.size)}, expected {_in_cm(o.size)}; "
                "the mesh is scaled to the size; is it a different mesh from the annotated one?"
            )
            odd = (*odd, Notice(o.instance, "mesh", "asset_differs", message))
        scale = fitted_scale(asset.mesh, o.tilt_quat_xyzw, o.size)
        shape = self._scaled(o.asset_id, asset, scale, o.tilt_quat_xyzw)
        if has_size(shape.size, o.size):
            return shape, scale, odd
        message = (
            f"object {o.instance}: asset {o.asset_id} fitted to its size is {_in_cm(shape.size)}, expected {_in_cm(o.size)}; "
            f"{_STAND_IN}"
        )
        return Shape.box(o.size), None, (*odd, Notice(o.instance, "mesh", "asset_does_not_fit", message))

    def shapes(self, scene: Scene) -> tuple[list[Shape], tuple[Notice, ...]]:
        """The geometry of every object of a scene, in its order, and the notices with the scene as ``item_id``."""
        return self.resolved(scene)[1:]

    def resolved(
        self, scene: Scene, convention: PositionConvention = PositionConvention.BOX_CENTRE
    ) -> tuple[Scene, list[Shape], tuple[Notice, ...]]:
        """A scene as its meshes make it, so that what is kept of it is what is judged.

        Args:
            scene: As read.
            convention: Which point of a tilted object the scene's positions are.

        Returns:
            The scene with every position at the centre of its object's box in the yaw frame and every scale as the mesh has it
            (``source`` keeps the file's); the geometry of its objects, in its order; and the notices, with the scene as
            ``item_id``.
        """
        objects, shapes, notices = [], [], []
        for o in scene.objects:
            shape, scale, odd = self._shape_and_scale(o)
            if scale != o.scale:
                o = replace(o, scale=scale)
            if convention is PositionConvention.MESH_CENTRE:
                mesh = self.mesh_of(o) if shape.is_exact else None
                if mesh is not None:
                    o = to_box_centre(o, mesh.vertices)
                elif not keeps_box(o.tilt_quat_xyzw):
                    message = (
                        f"object {o.instance}: its box position needs its missing mesh; the mesh centre in the file is used"
                    )
                    odd = (*odd, Notice(o.instance, "mesh", "position_unknown", message))
            objects.append(o)
            shapes.append(shape)
            notices += [Notice(scene.scene_id, n.step, n.code, n.message) for n in odd]
        return replace(scene, objects=tuple(objects)), shapes, tuple(notices)

    def fault_of(self, asset_id: str) -> str | None:
        """Why the mesh of an asset cannot be used, one line; None where it can, or where that may be otherwise another time.

        What cannot be read for now is not passed over for another asset: else the same task gave another scene elsewhere.
        """
        if asset_id not in self._faults:
            try:
                self.asset(asset_id)
                self._faults[asset_id] = None
            except MeshError as error:
                if error.code in _PASSING:
                    return None  # asked again the next time
                self._faults[asset_id] = str(error)
        return self._faults[asset_id]

    def mesh_of(self, o: SceneObject) -> Mesh | None:
        """The repaired mesh of an object, mesh units, or None where it has none that can be used."""
        try:
            return None if o.asset_id is None else self.asset(o.asset_id).mesh
        except MeshError:
            return None

    def paint(self, asset_id: str) -> tuple[Paint, tuple[Notice, ...]]:
        """The colours of the faces of an asset's repaired mesh, and why there are none where its file's cannot be read.

        Raises:
            MeshError: The mesh is missing or cannot be used.
        """
        return self._paints.get(asset_id, lambda: self._painted(asset_id), lambda p: 256 + sum(f.nbytes for _, f in p[0]))

    def _painted(self, asset_id: str) -> tuple[Paint, tuple[Notice, ...]]:
        mesh, path = self.asset(asset_id).mesh, self._source.asset_path(asset_id)
        assert path is not None
        try:
            return load_paint(path, asset_id, mesh), ()
        except MeshError as error:
            if error.code in _PASSING:
                raise
            return (), (Notice(asset_id, "mesh", error.code, str(error)),)

    def paint_of(self, o: SceneObject) -> Paint:
        """The colours of an object, none where they are not known."""
        try:
            return () if o.asset_id is None else self.paint(o.asset_id)[0]
        except MeshError:
            return ()

    def grid(self, asset_id: str, scale: Vec3) -> SdfGrid:
        """The signed-distance grid of an asset at the aspect of a scale.

        Raises:
            MeshError: The mesh is missing or cannot be used.
        """
        steps = aspect_steps(scale)
        return self._grids.get((asset_id, steps), lambda: self._grid(asset_id, steps), lambda g: g.values.nbytes)

    def _grid(self, asset_id: str, steps: tuple[int, int, int]) -> SdfGrid:
        asset = self.asset(asset_id)
        return build_grid(asset.mesh, aspect=aspect_of(steps), is_sheet=asset.report.is_sheet)

    def _scaled(self, asset_id: str, asset: AssetMesh, scale: Vec3, tilt: QuatXyzw) -> Shape:
        key = (asset_id, scale, tilt)
        return self._shapes.get(key, lambda: Shape.from_mesh(asset.mesh, scale, tilt), lambda s: _GOES_WITH * s.vertices.nbytes)

    def _load(self, asset_id: str) -> AssetMesh | MeshError:
        """The mesh, or the error that is kept in its place; one that may pass is raised, and so not kept."""
        path = self._source.asset_path(asset_id)
        if path is None:
            return MeshError(
                f"asset {asset_id}: no GLB file in the library, expected one; add the file or preprocess without this asset",
                "glb_missing",
            )
        try:
            mesh, odd = load_glb(path, asset_id)
            mesh, report, repaired = repair_mesh(mesh, asset_id)
        except MeshError as error:
            if error.code in _PASSING:
                raise
            return MeshError(str(error), error.code)  # the error itself holds on to the file's content
        except Exception as error:  # a file that nobody foresaw is one asset lost, whoever asks for it
            found = f"{type(error).__name__}: {error}"
            raise MeshError(f"asset {asset_id}: {found}; please report this with the file", "unexpected") from error
        return AssetMesh(mesh, report, odd + repaired)


def colliders_of(path: Path, asset_id: str) -> tuple[Mesh, ...]:
    """The convex parts that a file brings with it; none where it has none that can be used, and the mesh itself is cut up instead.

    Raises:
        MeshError: The file cannot be read for now.
    """
    try:
        return load_colliders(path, asset_id)
    except MeshError as error:
        if error.code in _PASSING:
            raise
        return ()


def _in_cm(size: Iterable[float]) -> str:
    return "x".join(f"{100 * s:.1f}" for s in size) + " cm"


def _mesh_bytes(found: AssetMesh | MeshError) -> int:
    return 256 if isinstance(found, MeshError) else found.mesh.vertices.nbytes + found.mesh.faces.nbytes


def aspect_steps(scale: Vec3) -> tuple[int, int, int]:
    """Aspect of a scale, snapped to 5 %: how many steps of 1.05 each axis is below the largest one."""
    largest = max(scale)
    x, y, z = (round(math.log(largest / s) / ASPECT_STEP) for s in scale)
    return x, y, z


def aspect_of(steps: tuple[int, int, int]) -> Vec3:
    """Aspect, (3,), largest component 1, of the steps that :func:`aspect_steps` gave."""
    x, y, z = (math.exp(-ASPECT_STEP * k) for k in steps)
    return x, y, z


def canonical_quaternion(tilt_quat_xyzw: QuatXyzw) -> QuatXyzw:
    """The unit quaternion, with one of the two signs that mean the same rotation."""
    sign = 1.0 if next((q for q in reversed(tilt_quat_xyzw) if abs(q) > 0.01), 1.0) > 0 else -1.0
    x, y, z, w = (sign * q + 0.0 for q in normalise_quat(tilt_quat_xyzw))
    return x, y, z, w


def tilt_key(tilt_quat_xyzw: QuatXyzw) -> QuatXyzw:
    """A tilt with each component snapped to 0.01: those within about a degree count as one."""
    x, y, z, w = (round(q, 2) + 0.0 for q in canonical_quaternion(tilt_quat_xyzw))
    return x, y, z, w


def fitted_scale(mesh: Mesh, tilt_quat_xyzw: QuatXyzw, size: Vec3) -> Vec3:
    """Scale along the mesh's axes that makes the tilted mesh as large as a box, or nearly so.

    Exact for tilts by right angles, where each axis of the box belongs to one of the mesh. Elsewhere the better of a
    least-squares fit and one uniform factor, which is also what a fit that would flatten the mesh gives way to.

    Args:
        mesh: Mesh units.
        tilt_quat_xyzw: Rotation before yaw.
        size: Box in the yaw frame, metres.

    Returns:
        Metres per mesh unit, (3,).
    """
    extents, wanted = mesh.extents, np.asarray(size, np.float64)
    turned = np.abs(Rotation.from_quat(tilt_quat_xyzw).as_matrix()) * extents
    turned[turned < 1e-9 * extents.max()] = 0.0
    fitted, _ = nnls(turned, wanted)
    is_flat = extents < 1e-9 * extents.max()  # such an axis has no scale of its own
    fitted[is_flat] = np.median(fitted[~is_flat])
    uniform = np.full(3, wanted.max() / Shape.from_mesh(mesh, (1.0, 1.0, 1.0), tilt_quat_xyzw).size.max())
    scales: list[Vec3] = [tuple(s.tolist()) for s in (fitted, uniform) if s.min() >= 0.05 * s.max() > 0]
    return min(scales, key=lambda s: np.abs(Shape.from_mesh(mesh, s, tilt_quat_xyzw).size - wanted).max())
