"""The geometry of assets and of objects at their scale and tilt, computed once and cached."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from stable_data.assets.physics import AssetPhysics
from stable_data.errors import MeshError, Notice, SceneError
from stable_data.geometry.gltf_reader import load_colliders, load_glb, load_stored_mesh, load_surfaces
from stable_data.geometry.images import texture_pixels
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint, load_paint
from stable_data.geometry.mesh_repair import MeshReport, mesh_report, repair_mesh
from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.geometry.sdf.build import build_grid
from stable_data.geometry.sdf.grid import SdfGrid
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface import Surface
from stable_data.limits import LIMITS, at_most
from stable_data.position_convention import (
    PositionConvention,
    has_size,
    keeps_box,
    to_box_centre,
)
from stable_data.scene import QuatXyzw, Scene, SceneObject, Vec3

# A shape also owns its search tree of 560 bytes per triangle, so the cache weighs it as a multiple of its vertices.
_SHAPE_WEIGHT = 48
_TRANSIENT = ("glb_unreadable", "unexpected")  # codes of errors that the machine may cause, and that may not recur
_STAND_IN = "a box of its size replaces it, so contacts with its mesh are unknown"

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class AssetSource(Protocol):
    """A source of meshes, such as a :class:`~stable_data.mesatask.MesaTaskDataset`."""

    def asset_path(self, asset_id: str) -> Path | None:
        """Returns the GLB file of an asset, or None if there is none."""
        ...


@runtime_checkable
class PartSource(Protocol):
    """A source that also stores the convex parts of its assets, such as the tables of a run."""

    def parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """Returns the convex parts in the frame and unit of the asset's mesh; empty if there are none."""
        ...


@runtime_checkable
class PhysicsSource(Protocol):
    """A source that also knows what its assets weigh, such as the tables of a run."""

    def physics(self, asset_id: str) -> AssetPhysics | None:
        """Returns mass and friction of an asset; None if they are not known."""
        ...


@runtime_checkable
class LookSource(Protocol):
    """A source that also stores the looks of its assets, such as the tables of a run."""

    def look(self, asset_id: str) -> Sequence[Surface]:
        """Returns the surfaces that are seen of an asset, in the frame and unit of its mesh; empty if it has no look.

        Raises:
            MeshError: The look or one of its textures cannot be used.
        """
        ...


@runtime_checkable
class FingerprintSource(Protocol):
    """A source that knows the content of its assets without reading their geometry, such as the tables of a run."""

    def fingerprint(self, asset_id: str) -> str:
        """Returns a hash of all that the source has of an asset; equal content gives an equal hash."""
        ...


@runtime_checkable
class StoredSource(Protocol):
    """A source whose meshes may be those of a run: they were judged as they are, and are not repaired again."""

    def is_stored(self, asset_id: str) -> bool:
        """Returns whether the mesh of an asset is stored in a run."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class AssetMesh:
    """A mesh that was read, and repaired if it comes from no run.

    Attributes:
        mesh: The mesh, in mesh units, z up, centred on its box.
        report: Properties of the mesh, and the repairs.
        notices: Problems of the file.
        is_in_order: Whether its faces have the order with which it was judged before it was stored; some older runs lost it.
    """

    mesh: Mesh
    report: MeshReport
    notices: tuple[Notice, ...]
    is_in_order: bool = True


class _Cache(Generic[K, V]):
    """A cache of the most recently used values, with a bound on the sum of their weights."""

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
    """Meshes, shapes, colours, looks and grids of assets: computed on the first request and cached.

    Args:
        source: The source of the meshes.
        max_bytes: Maximum size of each of the caches, bytes.
    """

    def __init__(self, source: AssetSource, max_bytes: int = 256 * 2**20) -> None:
        self._source = source
        self._meshes: _Cache[str, AssetMesh | MeshError] = _Cache(max_bytes)
        self._shapes: _Cache[Hashable, Shape] = _Cache(max_bytes)
        self._grids: _Cache[Hashable, SdfGrid] = _Cache(max_bytes)
        self._paints: _Cache[str, tuple[Paint, tuple[Notice, ...]]] = _Cache(max_bytes)
        self._looks: _Cache[str, tuple[tuple[Surface, ...] | None, tuple[Notice, ...]]] = _Cache(max_bytes)
        self._faults: dict[str, str | None] = {}
        self._physics: dict[str, AssetPhysics | None] = {}
        self._fingerprints: dict[str, str | None] = {}

    def asset(self, asset_id: str) -> AssetMesh:
        """Returns the repaired mesh of an asset; that of a run as it is stored there.

        Raises:
            MeshError: The mesh is missing or cannot be used. The error is cached, except for errors that the machine may cause:
                these are tried again each time, so that results do not depend on what the process did before.
        """
        found = self._meshes.get(asset_id, lambda: self._load(asset_id), _mesh_bytes)
        if isinstance(found, MeshError):
            raise MeshError(str(found), found.code)
        return found

    def colliders(self, asset_id: str) -> tuple[Mesh, ...]:
        """Returns the convex parts in an asset's file, in the frame of its mesh; empty if there are no usable ones.

        Raises:
            MeshError: The file cannot be read at the moment. An empty result would make the caller compute and store other parts.
        """
        path = self._source.asset_path(asset_id)
        return () if path is None else colliders_of(path, asset_id)

    def surfaces(self, asset_id: str) -> list[Surface]:
        """Returns the surfaces in an asset's file, in the frame of the file; none if it cannot be read.

        Raises:
            MeshError: The file cannot be read at the moment.
        """
        path = self._source.asset_path(asset_id)
        try:
            return [] if path is None else load_surfaces(path, asset_id)
        except MeshError as error:
            if error.code in _TRANSIENT:
                raise
            return []

    def stored_parts(self, asset_id: str) -> tuple[Mesh, ...]:
        """Returns the convex parts of an asset from a :class:`PartSource`; empty if the source has none."""
        return self._source.parts(asset_id) if isinstance(self._source, PartSource) else ()

    def physics(self, asset_id: str) -> AssetPhysics | None:
        """Returns mass and friction of an asset from a :class:`PhysicsSource`; None if they are not known."""
        if asset_id not in self._physics:
            self._physics[asset_id] = self._source.physics(asset_id) if isinstance(self._source, PhysicsSource) else None
        return self._physics[asset_id]

    def fingerprint(self, asset_id: str) -> str | None:
        """Returns a hash of all that is known of an asset from a :class:`FingerprintSource`; None if it is not known."""
        if asset_id not in self._fingerprints:
            source = self._source
            self._fingerprints[asset_id] = source.fingerprint(asset_id) if isinstance(source, FingerprintSource) else None
        return self._fingerprints[asset_id]

    def shape(self, o: SceneObject) -> tuple[Shape, tuple[Notice, ...]]:
        """Returns the geometry of an object at its scale and tilt.

        If the scale is missing, or gives another box than ``size``, the mesh is fitted to ``size``. If the mesh is missing or
        broken, or cannot be fitted, the geometry is a box of ``size``.

        Returns:
            The shape, metres, yaw frame; and notices of replacements, with the object's instance as ``item_id``.
        """
        shape, _, notices = self._shape_and_scale(o)
        return shape, notices

    def _shape_and_scale(self, o: SceneObject) -> tuple[Shape, Vec3 | None, tuple[Notice, ...]]:
        """As ``shape``, with the scale of the mesh: None if no scale fits, that of the object if there is no mesh."""
        if o.asset_id is None:
            return Shape.box(o.size), o.scale, ()  # the reader of the scene has given a notice
        try:
            asset = self.asset(o.asset_id)
        except MeshError as error:
            message = f"object {o.instance}: {error}; {_STAND_IN}"
            return Shape.box(o.size), o.scale, (Notice(o.instance, "mesh", error.code, message),)
        notices = tuple(Notice(o.instance, n.step, n.code, f"object {o.instance}: {n.message}") for n in asset.notices)
        if o.scale is not None:
            shape = self.shape_at(o.asset_id, o.scale, o.tilt_quat_xyzw)
            if has_size(shape.size, o.size):
                return shape, o.scale, notices
            message = (
                f"object {o.instance}: asset {o.asset_id} at its scale is {_in_cm(shape.size)}, expected {_in_cm(o.size)}; "
                "the mesh is scaled to the size; is it a different mesh from the annotated one?"
            )
            notices = (*notices, Notice(o.instance, "mesh", "asset_differs", message))
        scale = fitted_scale(asset.mesh, o.tilt_quat_xyzw, o.size)
        shape = self.shape_at(o.asset_id, scale, o.tilt_quat_xyzw)
        if has_size(shape.size, o.size):
            return shape, scale, notices
        message = (
            f"object {o.instance}: asset {o.asset_id} fitted to its size is {_in_cm(shape.size)}, expected {_in_cm(o.size)}; "
            f"{_STAND_IN}"
        )
        return Shape.box(o.size), None, (*notices, Notice(o.instance, "mesh", "asset_does_not_fit", message))

    def shape_at(self, asset_id: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> Shape:
        """Returns the geometry of an asset at a scale and tilt, metres, yaw frame, with its centre of mass if that is known.

        Raises:
            MeshError: The mesh is missing or cannot be used.
        """
        mesh = self.asset(asset_id).mesh

        def make() -> Shape:
            physics = self.physics(asset_id)
            centre = None if physics is None else physics.at(scale).center_of_mass
            return Shape.from_mesh(mesh, scale, tilt_quat_xyzw, centre)

        return self._shapes.get((asset_id, scale, tilt_quat_xyzw), make, lambda s: _SHAPE_WEIGHT * s.vertices.nbytes)

    def shapes(self, scene: Scene) -> tuple[list[Shape], tuple[Notice, ...]]:
        """Returns the geometry of every object of a scene, in order, and notices with the scene as ``item_id``."""
        return self.resolved(scene)[1:]

    def resolved(
        self, scene: Scene, convention: PositionConvention = PositionConvention.BOX_CENTRE
    ) -> tuple[Scene, list[Shape], tuple[Notice, ...]]:
        """Returns a scene whose positions and scales agree with its meshes, so that the stored scene is the audited one.

        Args:
            scene: The scene from a file.
            convention: The point of a tilted object that the positions of the file refer to.

        Returns:
            The scene with every position at the centre of the object's box in the yaw frame, and with the scales of the shapes
            (``source`` still has those of the file); the geometry of its objects, in order; and notices with the scene as
            ``item_id``.

        Raises:
            SceneError: ``scene_too_big``: its meshes have too many vertices together.
        """
        objects, shapes, notices = [], [], []
        num_corners = 0
        for o in scene.objects:
            shape, scale, found = self._shape_and_scale(o)
            num_corners += len(shape.vertices)
            if num_corners > LIMITS.work.max_scene_corners:  # each object has a copy at its pose
                most = at_most(LIMITS.work, "max_scene_corners")
                raise SceneError(f"{scene.scene_id}: its meshes have more vertices, expected {most}", "scene_too_big")
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
                    found = (*found, Notice(o.instance, "mesh", "position_unknown", message))
            objects.append(o)
            shapes.append(shape)
            notices += [Notice(scene.scene_id, n.step, n.code, n.message) for n in found]
        return replace(scene, objects=tuple(objects)), shapes, tuple(notices)

    def fault_of(self, asset_id: str) -> str | None:
        """Returns in one line why the mesh of an asset cannot be used; None if it can, or if the error may not recur.

        An asset with a transient error must not be replaced by another one: the same task would give another scene elsewhere.
        """
        if asset_id not in self._faults:
            try:
                self.asset(asset_id)
                self._faults[asset_id] = None
            except MeshError as error:
                if error.code in _TRANSIENT:
                    return None  # not cached
                self._faults[asset_id] = str(error)
        return self._faults[asset_id]

    def mesh_of(self, o: SceneObject) -> Mesh | None:
        """Returns the repaired mesh of an object, mesh units, or None if it has no usable mesh."""
        try:
            return None if o.asset_id is None else self.asset(o.asset_id).mesh
        except MeshError:
            return None

    def paint(self, asset_id: str) -> tuple[Paint, tuple[Notice, ...]]:
        """Returns the face colours of an asset's repaired mesh, and a notice if the colours of the file cannot be read.

        Raises:
            MeshError: The mesh is missing or cannot be used.
        """
        return self._paints.get(asset_id, lambda: self._load_paint(asset_id), lambda p: 256 + sum(f.nbytes for _, f in p[0]))

    def _load_paint(self, asset_id: str) -> tuple[Paint, tuple[Notice, ...]]:
        mesh, path = self.asset(asset_id).mesh, self._source.asset_path(asset_id)
        assert path is not None
        try:
            return load_paint(path, asset_id, mesh), ()
        except MeshError as error:
            if error.code in _TRANSIENT:
                raise
            return (), (Notice(asset_id, "mesh", error.code, str(error)),)

    def paint_of(self, o: SceneObject) -> Paint:
        """Returns the colours of an object; empty if they are unknown."""
        try:
            return () if o.asset_id is None else self.paint(o.asset_id)[0]
        except MeshError:
            return ()

    def look(self, asset_id: str) -> tuple[tuple[Surface, ...] | None, tuple[Notice, ...]]:
        """Returns the surfaces that are seen of an asset, with their textures, from a :class:`LookSource`.

        Returns:
            The surfaces, in the frame and unit of the asset's mesh, or None if the source has no usable ones: then its face
            colours (:meth:`paint`) are its look. All images can be decoded. And a notice if a stored look cannot be used.
        """
        return self._looks.get(asset_id, lambda: self._load_look(asset_id), lambda look: _look_bytes(look[0]))

    def _load_look(self, asset_id: str) -> tuple[tuple[Surface, ...] | None, tuple[Notice, ...]]:
        if not isinstance(self._source, LookSource):
            return None, ()
        try:
            found = tuple(self._source.look(asset_id))
            for surface in found:
                _check_surface(surface, asset_id)
        except MeshError as error:
            if error.code in _TRANSIENT:
                raise
            message = f"{error}; its face colours are shown"
            return None, (Notice(asset_id, "look", error.code, message),)
        return found or None, ()

    def look_of(self, o: SceneObject) -> tuple[Surface, ...] | None:
        """Returns the surfaces that are seen of an object, mesh units; None if its face colours are its look."""
        return None if o.asset_id is None else self.look(o.asset_id)[0]

    def grid(self, asset_id: str, scale: Vec3) -> SdfGrid:
        """Returns the signed-distance grid of an asset at the aspect of a scale.

        Raises:
            MeshError: The mesh is missing or cannot be used.
        """
        steps = aspect_steps(scale)
        return self._grids.get((asset_id, steps), lambda: self._grid(asset_id, steps), lambda g: g.values.nbytes)

    def _grid(self, asset_id: str, steps: tuple[int, int, int]) -> SdfGrid:
        asset = self.asset(asset_id)
        return build_grid(asset.mesh, aspect=aspect_of(steps), is_sheet=asset.report.is_sheet)

    def _load(self, asset_id: str) -> AssetMesh | MeshError:
        """Reads a mesh, and repairs it if no run stores it. A lasting error is returned, to be cached; a transient one is raised."""
        path = self._source.asset_path(asset_id)
        if path is None:
            return MeshError(
                f"asset {asset_id}: no GLB file in the library, expected one; add the file or preprocess without this asset",
                "glb_missing",
            )
        try:
            if isinstance(self._source, StoredSource) and self._source.is_stored(asset_id):
                mesh, is_in_order = load_stored_mesh(path, asset_id)
                return AssetMesh(mesh, mesh_report(mesh), (), is_in_order)
            mesh, notices = load_glb(path, asset_id)
            mesh, report, repaired = repair_mesh(mesh, asset_id)
        except MeshError as error:
            if error.code in _TRANSIENT:
                raise
            return MeshError(str(error), error.code)  # a new error: the traceback of the old one references the file's content
        except MemoryError:
            raise
        except Exception as error:  # a bug with an unusual file must cost one asset, not the job
            found = f"{type(error).__name__}: {error}"
            raise MeshError(f"asset {asset_id}: {found}; please report this with the file", "unexpected") from error
        return AssetMesh(mesh, report, notices + repaired)


def colliders_of(path: Path, asset_id: str) -> tuple[Mesh, ...]:
    """Returns the convex parts in a file; empty if there are no usable ones, and the caller then decomposes the mesh.

    Raises:
        MeshError: The file cannot be read at the moment.
    """
    try:
        return load_colliders(path, asset_id)
    except MeshError as error:
        if error.code in _TRANSIENT:
            raise
        return ()


def _in_cm(size: Iterable[float]) -> str:
    return "x".join(f"{100 * s:.1f}" for s in size) + " cm"


def _mesh_bytes(found: AssetMesh | MeshError) -> int:
    return 256 if isinstance(found, MeshError) else found.mesh.vertices.nbytes + found.mesh.faces.nbytes


def _check_surface(surface: Surface, asset_id: str) -> None:
    """Refuses a surface of a look that cannot be shown.

    Raises:
        MeshError: A corner is not finite, or the image cannot be decoded.
    """
    arrays = (surface.triangles, surface.corner_uv, surface.corner_colours)
    if not all(np.isfinite(array).all() for array in arrays if array is not None):
        message = f"asset {asset_id}: its look has a corner that is not finite, expected finite numbers; import the asset again"
        raise MeshError(message, "look_invalid")
    if surface.image is not None:
        texture_pixels(surface.image, has_alpha=surface.has_alpha)


def _look_bytes(look: tuple[Surface, ...] | None) -> int:
    """The size of a look; an image that several surfaces share counts once."""
    images = {id(s.image): len(s.image) for s in look or () if s.image is not None}
    arrays = (a for s in look or () for a in (s.triangles, s.corner_colours, s.corner_uv) if a is not None)
    return 256 + sum(images.values()) + sum(a.nbytes for a in arrays)


def fitted_scale(mesh: Mesh, tilt_quat_xyzw: QuatXyzw, size: Vec3) -> Vec3:
    """Computes the scale along the mesh axes that fits the tilted mesh to a box.

    The fit is exact for right-angled tilts, which map each axis of the mesh to one of the box. Otherwise it is the better one of
    a least-squares fit and a uniform factor; the uniform factor also replaces a fit that would flatten the mesh.

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
    is_flat = extents < 1e-9 * extents.max()  # the data do not determine the scale of such an axis
    fitted[is_flat] = np.median(fitted[~is_flat])
    uniform = np.full(3, wanted.max() / Shape.from_mesh(mesh, (1.0, 1.0, 1.0), tilt_quat_xyzw).size.max())
    scales: list[Vec3] = [tuple(s.tolist()) for s in (fitted, uniform) if s.min() >= 0.05 * s.max() > 0]
    return min(scales, key=lambda s: np.abs(Shape.from_mesh(mesh, s, tilt_quat_xyzw).size - wanted).max())
