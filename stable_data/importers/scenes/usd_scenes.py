"""Reads USD scenes with physics, and writes new poses of their rigid bodies as a layer over the untouched original.

Rigid bodies that no joint holds are objects; all other colliders are the surroundings. Poses are those at the default time. The
layers of a scene are listed before USD composes them, and only these are there when it does.
"""

import hashlib
import math
import posixpath
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError, Notice, SceneError, StableDataError
from stable_data.geometry.convex_decomposition import collider_parts
from stable_data.geometry.mass_properties import usable_inertia
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes import convex_solids
from stable_data.importers.scenes.formats import repaired_name
from stable_data.importers.scenes.scene_file import BodyPose, Ground, SceneBody, SceneFile, check_shapes
from stable_data.importers.usd.layers import check_prims, quiet_usd, reason_of
from stable_data.importers.usd.physics import Collider, StageFrame, inertial_of
from stable_data.importers.usd.text_layers import check_brackets
from stable_data.limits import LIMITS, at_most
from stable_data.rotations import quat_of
from stable_data.scene import FloatArray, Vec3

if TYPE_CHECKING:  # MuJoCo takes long to import
    from stable_data.importers.scenes.file_physics import BodyMotion

_EXACT = 1e-6  # metres, and parts of a unit quaternion: largest difference of a written pose
_SINGLE = ("convexHull", "boundingCube", "boundingSphere")  # approximations of a collider by one convex shape


@dataclass(frozen=True, slots=True, eq=False)
class UsdScene:
    """A USD scene that was read.

    Attributes:
        file: What it holds; metres, z up. Bodies are named by the paths of their prims.
        paths: All its layers, relative to the source folder.
        contents: Path -> content.
        unit: Metres for a unit of the stage.
        is_y_up: Whether y points up in the stage.
    """

    file: SceneFile
    paths: tuple[str, ...]
    contents: Mapping[str, bytes]
    unit: float
    is_y_up: bool

    def watch(self) -> Mapping[str, "BodyMotion"]:
        """How its free bodies move in MuJoCo, with its own shapes and masses."""
        return self._watched({})

    def moved(self, poses: Mapping[str, BodyPose]) -> tuple[Mapping[str, bytes], Mapping[str, "BodyMotion"]]:
        """Writes new poses as a layer over the scene, and watches them; see :func:`write_overrides`."""
        return write_overrides(self, poses), self._watched(poses)

    def _watched(self, poses: Mapping[str, BodyPose]) -> Mapping[str, "BodyMotion"]:
        from stable_data.importers.scenes.file_physics import watch_shapes

        return watch_shapes(self.file, poses)


def read_usd_scene(boundary: Boundary, path: str) -> UsdScene:
    """Reads a USD scene.

    Args:
        boundary: The source folder.
        path: The file, relative to it.

    Raises:
        MeshError: A layer cannot be read (``model_unreadable``), is missing (``file_missing``), lies outside of the folder
            (``path_outside``) or is too large (``file_too_large``).
        SceneError: No rigid body is free (``no_free_body``), or gravity does not point down (``gravity_odd``).
    """
    with quiet_usd(path):
        contents = _collect_layers(boundary, path)
        with TemporaryDirectory(prefix="stable-data-stage-") as folder:
            stage = _placed_stage(Path(folder), contents, path)
            notices: list[Notice] = []
            try:
                unit, is_y_up = float(UsdGeom.GetStageMetersPerUnit(stage)), UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
                if not (math.isfinite(unit) and 0 < unit <= 1000):
                    raise SceneError(
                        f"{path}: metersPerUnit is {unit}, expected a positive number; correct it", "unit_implausible"
                    )
                _check_gravity(stage, path, is_y_up)
                bodies, grounds = _StageReader(stage, path, unit, is_y_up, notices).read()
            except (StableDataError, MemoryError):
                raise
            except Exception as error:
                found = " ".join(str(error).split())[:300]
                raise MeshError(f"{path}: has values that USD cannot use ({found}); repair it", "model_unreadable") from error
    if not any(body.is_free for body in bodies):
        found = "has no free rigid body with a shape, expected prims with UsdPhysics.RigidBodyAPI"
        raise SceneError(f"{path}: {found}; is it part of another scene?", "no_free_body")
    digest = hashlib.sha256()
    for name in sorted(contents):
        digest.update(name.encode() + b"\0" + hashlib.sha256(contents[name]).digest())
    file = SceneFile(path, digest.hexdigest(), "initial", tuple(bodies), tuple(grounds), tuple(notices))
    return UsdScene(file, tuple(sorted(contents)), contents, unit, is_y_up)


def _collect_layers(boundary: Boundary, path: str) -> dict[str, bytes]:
    """Reads a layer and all that it composes, before USD does."""
    contents: dict[str, bytes] = {}
    layers: dict[str, Sdf.Layer] = {}
    waiting = [path]
    with TemporaryDirectory(prefix="stable-data-layers-") as folder:
        while waiting:
            name = waiting.pop()
            if name in contents:
                continue
            if len(contents) >= LIMITS.model.max_layers:
                most = at_most(LIMITS.model, "max_layers")
                raise MeshError(f"{path}: has more layers, expected {most}; flatten it", "file_too_large")
            contents[name] = content = boundary.read_bytes(name)
            check_brackets(content, name)
            alone = Path(folder, f"{len(contents)}{posixpath.splitext(name)[1]}")  # no other layer is beside it
            alone.write_bytes(content)
            layers[name] = layer = _opened(alone, name)
            places: dict[str, str] = {}
            # An empty name is a reference within the layer.
            for reference in sorted(filter(None, layer.GetCompositionAssetDependencies())):
                try:
                    found = boundary.resolve(reference, posixpath.dirname(name))
                except MeshError as error:
                    raise MeshError(f"{name}: {error}", error.code) from error
                if posixpath.normpath(posixpath.join(posixpath.dirname(name), reference.replace("\\", "/"))) != found:
                    raise MeshError(
                        f"{name}: {reference!r} is {found} by another spelling or a link, expected its own path",
                        "file_missing",
                    )
                places[reference] = found
                waiting.append(found)
            UsdUtils.ModifyAssetPaths(
                layer, lambda reference, places=places: places.get(reference, "")
            )  # of the copy in memory
    check_prims(layers[path], path, layers)
    return contents


def _opened(place: Path, name: str) -> Sdf.Layer:
    """A layer alone, without those that it composes."""
    try:
        layer = Sdf.Layer.OpenAsAnonymous(str(place))
    except MemoryError:
        raise
    except Exception as error:
        raise MeshError(
            f"{name}: USD cannot read it ({reason_of(error)}), expected a USD layer; repair it", "model_unreadable"
        ) from error
    if layer is None:
        raise MeshError(f"{name}: USD cannot read it, expected a USD layer; repair it", "model_unreadable")
    return layer


def _placed_stage(folder: Path, contents: Mapping[str, bytes], path: str) -> Usd.Stage:
    for name, content in contents.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
    try:
        stage = Usd.Stage.Open(str(folder / path))
    except MemoryError:
        raise
    except Exception as error:
        raise MeshError(
            f"{path}: USD cannot open it ({reason_of(error)}), expected a stage; repair it", "model_unreadable"
        ) from error
    if stage is None:
        raise MeshError(f"{path}: USD cannot open it, expected a stage; repair it", "model_unreadable")
    return stage


def _check_gravity(stage: Usd.Stage, path: str, is_y_up: bool) -> None:
    up = np.array([0.0, 1.0, 0.0] if is_y_up else [0.0, 0.0, 1.0])
    for prim in stage.Traverse():
        if prim.IsA(UsdPhysics.Scene):
            direction = np.array(UsdPhysics.Scene(prim).GetGravityDirectionAttr().Get() or (0, 0, 0), np.float64)
            length = float(np.linalg.norm(direction))
            if length and direction @ up / length > -0.99:
                raise SceneError(f"{path}: gravity is {direction.tolist()}, expected downwards; turn the scene", "gravity_odd")


@dataclass(slots=True, eq=False)
class _StageReader:
    """Reads the bodies of a stage."""

    stage: Usd.Stage
    path: str
    unit: float
    is_y_up: bool
    notices: list[Notice]
    num_faces: int = 0
    num_corners: int = 0
    cut: dict[bytes, tuple[Mesh, ...] | MeshError] = field(default_factory=dict)

    def read(self) -> tuple[list[SceneBody], list[Ground]]:
        cache = UsdGeom.XformCache()
        rigid = self._rigid_prims()
        if len(rigid) > LIMITS.scene_file.max_free_bodies:
            most = at_most(LIMITS.scene_file, "max_free_bodies")
            raise SceneError(f"{self.path}: has {len(rigid)} rigid bodies, expected {most}; divide it", "file_too_large")
        held = self._held(rigid)
        colliders: dict[str, list[Usd.Prim]] = {}
        shapes: dict[str, list[Usd.Prim]] = {}
        for prim in Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()):
            if prim.IsA(UsdGeom.Gprim):
                owner = _owner(prim, rigid)
                name = owner if owner is not None else str(prim.GetPath())
                if prim.HasAPI(UsdPhysics.CollisionAPI):
                    if UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get() is not False:
                        colliders.setdefault(name, []).append(prim)
                elif owner is not None and UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible:
                    shapes.setdefault(name, []).append(prim)
        for name in sorted(rigid):
            if name not in colliders and name in shapes:
                message = f"{self.path}: {name} has no collider; its visible shape counts"
                self.notices.append(Notice(self.path, "read", "no_collider", message))
                colliders[name] = shapes[name]
        bodies, grounds = [], list[Ground]()
        for name in sorted(colliders):
            planes = [prim for prim in colliders[name] if prim.IsA(UsdGeom.Plane)]
            grounds += [g for prim in planes if (g := self._ground(prim, cache)) is not None]
            is_free = name in rigid and name not in held
            body = self._body(name, [p for p in colliders[name] if p not in planes], cache, is_free=is_free)
            if body is not None:
                bodies.append(body)
        return bodies, grounds

    def _rigid_prims(self) -> set[str]:
        found = set()
        for prim in Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()):
            if prim.HasAPI(UsdPhysics.RigidBodyAPI):
                api = UsdPhysics.RigidBodyAPI(prim)
                if api.GetRigidBodyEnabledAttr().Get() is not False and not api.GetKinematicEnabledAttr().Get():
                    found.add(str(prim.GetPath()))
        return found

    def _held(self, rigid: set[str]) -> set[str]:
        """Rigid bodies that joints connect: robots and articulated things."""
        held: set[str] = set()
        for prim in self.stage.Traverse():
            if prim.IsA(UsdPhysics.Joint):
                joint = UsdPhysics.Joint(prim)
                for target in (*joint.GetBody0Rel().GetTargets(), *joint.GetBody1Rel().GetTargets()):
                    held |= {str(place) for place in target.GetPrefixes() if str(place) in rigid}
        for name in sorted(held):
            self.notices.append(
                Notice(self.path, "find", "body_held", f"{self.path}: {name} is held by a joint; it counts as fixed")
            )
        return held

    def _body(self, name: str, prims: Sequence[Usd.Prim], cache: UsdGeom.XformCache, *, is_free: bool) -> SceneBody | None:
        root = self.stage.GetPrimAtPath(name)
        position, rotation = self._rigid_pose(cache.GetLocalToWorldTransform(root))
        parts: list[Mesh] = []
        colliders: list[Collider] = []
        for prim in prims:
            own = list(self._parts(prim, cache, position, rotation, is_free=is_free))
            parts += own
            if own:
                solid = join_meshes(own)
                colliders.append(Collider(prim, Mesh((rotation.apply(solid.vertices) + position) / self.unit, solid.faces)))
        if not parts:
            return None
        if not is_free:
            return SceneBody(name, _vec3(position), quat_of(rotation), tuple(parts), is_free)
        frame = StageFrame(_axes(self.is_y_up), self.unit, float(UsdPhysics.GetStageKilogramsPerUnit(self.stage)))
        given = inertial_of(root, [], colliders, frame, cache)
        mass, com, inertia = None, None, None
        if given is not None:
            mass = given.mass
            turn = rotation.as_matrix()
            com = None if given.center_of_mass is None else _vec3((np.array(given.center_of_mass) - position) @ turn)
            inertia = None if given.inertia is None else usable_inertia(turn.T @ given.inertia @ turn)
            if inertia is None and given.inertia is not None:
                message = f"{self.path}: {name} states an inertia that no body can have; that of its shape is used; correct it"
                self.notices.append(Notice(self.path, "read", "inertia_replaced", message))
        return SceneBody(name, _vec3(position), quat_of(rotation), tuple(parts), is_free, mass, com, inertia)

    def _rigid_pose(self, matrix: Gf.Matrix4d) -> tuple[FloatArray, Rotation]:
        """The pose of a matrix without its scale, metres, z up."""
        turned = Gf.Matrix4d(matrix)
        turned.Orthonormalize(False)
        axes = np.array(turned.ExtractRotationMatrix(), np.float64).T
        if np.linalg.det(axes) < 0:  # a mirrored prim: its frame is the mirrored one's
            axes[:, 2] *= -1
        position = self._to_metres(np.array(matrix.ExtractTranslation(), np.float64)[None])[0]
        turn = _axes(self.is_y_up)  # the axes of the body are turned too, so that its z axis is what points up in the stage
        return position, Rotation.from_matrix(turn @ axes @ turn.T)

    def _to_metres(self, points: FloatArray) -> FloatArray:
        placed: FloatArray = self.unit * points @ _axes(self.is_y_up).T
        return placed

    def _points(self, matrix: Gf.Matrix4d, points: FloatArray) -> FloatArray:
        rows = np.array(matrix, np.float64)
        return self._to_metres(points @ rows[:3, :3] + rows[3, :3])

    def _parts(
        self, prim: Usd.Prim, cache: UsdGeom.XformCache, position: FloatArray, rotation: Rotation, *, is_free: bool
    ) -> Iterator[Mesh]:
        """The convex parts of a collider, in the frame of its body."""
        matrix = cache.GetLocalToWorldTransform(prim)
        solid = _primitive(prim)
        triangles = _triangles(prim, self.path, self._count) if solid is None else None
        if solid is None and triangles is None:
            message = f"{self.path}: {prim.GetPath()} is a {prim.GetTypeName()}, which is not read; it is no obstacle"
            self.notices.append(Notice(self.path, "read", "shape_unknown", message))
            return
        local = solid if solid is not None else triangles
        assert local is not None
        if solid is not None:
            self._count(len(solid.faces), len(solid.vertices))
        points = rotation.inv().apply(self._points(matrix, local.vertices) - position)
        approximation = (
            UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() if triangles is not None else "convexHull"
        )
        if solid is None and approximation not in _SINGLE and not (is_free and approximation in (None, "none")):
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            try:
                parts = self._cut(Mesh(points - middle, local.faces), str(prim.GetPath()))
                # The repair moves the box to the origin; its centre is that of the points it keeps.
                yield from (Mesh(part.vertices + middle, part.faces) for part in parts)
                return
            except MeshError as error:
                message = f"{self.path}: {prim.GetPath()}: {error}; its convex hull counts"
                self.notices.append(Notice(self.path, "read", error.code, message))
        hull = convex_solids.hull_of(points)
        if hull is not None:
            yield hull

    def _cut(self, mesh: Mesh, name: str) -> tuple[Mesh, ...]:
        """The convex parts of a mesh, found once for all prims that show it in the same way."""
        key = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).digest()
        if key not in self.cut:
            try:
                repaired, _, _ = repair_mesh(mesh, name)
                self.cut[key] = collider_parts(repaired)
            except MeshError as error:
                self.cut[key] = error.with_traceback(None)  # which would keep the mesh in memory
        if isinstance(found := self.cut[key], MeshError):
            raise found
        return found

    def _count(self, num_faces: int, num_corners: int) -> None:
        """Counts a shape as often as prims refer to it.

        Raises:
            MeshError: All shapes together are too large (``mesh_too_large``).
        """
        self.num_faces += num_faces
        self.num_corners += num_corners
        check_shapes(self.path, faces=self.num_faces, corners=self.num_corners)

    def _ground(self, prim: Usd.Prim, cache: UsdGeom.XformCache) -> Ground | None:
        matrix = cache.GetLocalToWorldTransform(prim)
        axis = "XYZ".index(str(UsdGeom.Plane(prim).GetAxisAttr().Get() or "Z"))
        origin, tip = self._points(matrix, np.array([[0.0, 0.0, 0.0], np.eye(3)[axis]]))
        normal = (tip - origin) / np.linalg.norm(tip - origin)
        return Ground(str(prim.GetPath()), float(origin[2])) if normal[2] > math.cos(math.radians(0.1)) else None


def _owner(prim: Usd.Prim, rigid: set[str]) -> str | None:
    """The rigid body that a prim belongs to."""
    while prim and not prim.IsPseudoRoot():
        if str(prim.GetPath()) in rigid:
            return str(prim.GetPath())
        prim = prim.GetParent()
    return None


def _axes(is_y_up: bool) -> FloatArray:
    """The rotation from the axes of the stage to z up, (3, 3)."""
    return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) if is_y_up else np.eye(3)


def _primitive(prim: Usd.Prim) -> Mesh | None:
    """A primitive as a mesh, in its own frame and unit; None if the prim is none."""
    if prim.IsA(UsdGeom.Cube):
        return convex_solids.box(np.full(3, _number(UsdGeom.Cube(prim).GetSizeAttr(), 2.0) / 2))
    if prim.IsA(UsdGeom.Sphere):
        return _round_solid(_ball, _number(UsdGeom.Sphere(prim).GetRadiusAttr(), 1.0))
    kinds = ((UsdGeom.Cylinder, convex_solids.cylinder), (UsdGeom.Capsule, convex_solids.capsule))
    for kind, make in kinds:
        if prim.IsA(kind):
            shape = kind(prim)
            radius, height = _number(shape.GetRadiusAttr(), 1.0), _number(shape.GetHeightAttr(), 2.0)
            return _along(_round_solid(make, radius, height / 2), str(shape.GetAxisAttr().Get() or "Z"))
    return None


@lru_cache(maxsize=64)
def _round_solid(make: Callable[..., Mesh], *lengths: float) -> Mesh:
    """A solid with thousands of triangles, made once for all prims that refer to it."""
    return make(*lengths)


def _ball(radius: float) -> Mesh:
    return convex_solids.ellipsoid(np.full(3, radius))


def _number(attribute: Usd.Attribute, default: float) -> float:
    value = attribute.Get()
    found = default if value is None else float(value)
    if not (math.isfinite(found) and found > 0):
        raise SceneError(f"{attribute.GetPath()}: is {found}, expected a positive length; correct it", "size_invalid")
    return found


def _along(mesh: Mesh, axis: str) -> Mesh:
    """Turns a solid of revolution from z to another axis."""
    roll = {"X": 1, "Y": 2, "Z": 0}[axis]
    return Mesh(np.roll(mesh.vertices, roll, axis=1), mesh.faces)


def _triangles(prim: Usd.Prim, path: str, count: Callable[[int, int], None]) -> Mesh | None:
    """The triangles of a mesh prim, in its own frame and unit; None if it is none or is empty. Its size is counted before they are made."""
    if not prim.IsA(UsdGeom.Mesh):
        return None
    mesh = UsdGeom.Mesh(prim)
    points = np.array(mesh.GetPointsAttr().Get() or [], np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], np.int64)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], np.int64)
    if not len(points) or not len(corners) or not len(counts):
        return None
    if counts.min() < 0 or counts.sum() != len(corners) or corners.min() < 0 or corners.max() >= len(points):
        raise MeshError(
            f"{path}: {prim.GetPath()} has faces of points that it lacks, expected indices of its points", "model_unreadable"
        )
    if not np.isfinite(points).all():
        raise MeshError(f"{path}: {prim.GetPath()} has points that are not finite, expected numbers", "mesh_not_finite")
    num_faces = int(np.maximum(counts - 2, 1).sum())  # polygons of less than three corners take time, too
    if num_faces > LIMITS.model.max_collider_faces:
        most = at_most(LIMITS.model, "max_collider_faces")
        raise MeshError(
            f"{path}: {prim.GetPath()} has more triangles, expected {most}; simplify the collider", "mesh_too_large"
        )
    count(num_faces, len(points))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    faces = [
        (corners[s], corners[s + k], corners[s + k + 1]) for s, n in zip(starts, counts, strict=True) for k in range(1, n - 1)
    ]
    if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
        faces = [(a, c, b) for a, b, c in faces]
    return Mesh(points, np.array(faces, np.int64).reshape(-1, 3)) if faces else None


def write_overrides(scene: UsdScene, poses: Mapping[str, BodyPose]) -> dict[str, bytes]:
    """Writes a layer over a scene that puts bodies at new poses; the original stays as it is.

    Args:
        scene: The scene.
        poses: Path of a rigid body's prim -> its new pose, in metres, z up.

    Returns:
        Path of the new file ``NAME_repaired.usda``, beside the original -> its content.

    Raises:
        SceneError: A body is part of an instance (``not_patchable``), or the written scene differs in more than the poses
            (``patch_differs``).
    """
    path = scene.file.path
    target = repaired_name(path)
    if target in scene.contents:
        raise SceneError(f"{path}: composes {target} itself, expected a free name; rename it", "not_patchable")
    with TemporaryDirectory(prefix="stable-data-stage-") as folder:
        stage = _placed_stage(Path(folder), scene.contents, path)
        layer = Sdf.Layer.CreateNew(str(Path(folder, target)))
        original = stage.GetRootLayer()
        for key in original.pseudoRoot.ListInfoKeys():
            if key not in ("subLayers", "subLayerOffsets"):
                layer.pseudoRoot.SetInfo(key, original.pseudoRoot.GetInfo(key))
        layer.subLayerPaths.append(f"./{posixpath.basename(path)}")
        for name in sorted(poses):
            _override(stage, layer, scene, name, poses[name])
        layer.Save()
        content = Path(folder, target).read_bytes()
        _compare(stage, Usd.Stage.Open(layer), scene, poses)
    return {target: content}


def _override(stage: Usd.Stage, layer: Sdf.Layer, scene: UsdScene, name: str, pose: BodyPose) -> None:
    """Writes the transform of a prim into a layer."""
    prim = stage.GetPrimAtPath(name)
    if prim.IsInstanceProxy() or prim.IsInPrototype():
        found = f"{name} is part of an instance, which cannot be moved by itself"
        raise SceneError(f"{scene.file.path}: {found}; make the instance unique", "not_patchable")
    cache = UsdGeom.XformCache()
    world = np.array(cache.GetLocalToWorldTransform(prim), np.float64)
    is_alone = UsdGeom.Xformable(prim).GetResetXformStack()
    parent = Gf.Matrix4d(1.0) if is_alone else cache.GetParentToWorldTransform(prim)
    before = next(body for body in scene.file.bodies if body.name == name)
    turn = Rotation.from_quat(pose[1]) * Rotation.from_quat(before.quat_xyzw).inv()
    axes = _axes(scene.is_y_up)
    rotated = axes.T @ turn.as_matrix() @ axes  # the turn in the axes of the stage
    here, there = (np.array(p) @ axes / scene.unit for p in (before.position, pose[0]))
    moved = world.copy()
    moved[:3, :3] = world[:3, :3] @ rotated.T
    moved[3, :3] = (world[3, :3] - here) @ rotated.T + there
    local = Gf.Matrix4d(*moved.ravel().tolist()) * parent.GetInverse()
    spec = Sdf.CreatePrimInLayer(layer, name)
    operation = Sdf.AttributeSpec(spec, "xformOp:transform", Sdf.ValueTypeNames.Matrix4d)
    operation.default = local
    order = Sdf.AttributeSpec(spec, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    order.default = [*(["!resetXformStack!"] * is_alone), "xformOp:transform"]


def _compare(before: Usd.Stage, after: Usd.Stage, scene: UsdScene, poses: Mapping[str, BodyPose]) -> None:
    """Refuses a written scene that differs in more than the poses.

    Raises:
        SceneError: See above (``patch_differs``).
    """
    path = scene.file.path
    for one, other in ((before, after), (after, before)):
        for prim in Usd.PrimRange.Stage(one, Usd.TraverseInstanceProxies()):
            twin = other.GetPrimAtPath(prim.GetPath())
            if not twin or twin.GetTypeName() != prim.GetTypeName() or twin.GetAppliedSchemas() != prim.GetAppliedSchemas():
                raise SceneError(f"{path}: {prim.GetPath()} of the written scene differs from the original", "patch_differs")
            for attribute in prim.GetAttributes():
                is_pose = str(prim.GetPath()) in poses and attribute.GetName().startswith("xformOp")
                if not is_pose and not _same(attribute.Get(), twin.GetAttribute(attribute.GetName()).Get()):
                    raise SceneError(
                        f"{path}: {attribute.GetPath()} of the written scene differs from the original", "patch_differs"
                    )
    reader = _StageReader(after, path, scene.unit, scene.is_y_up, [])
    cache = UsdGeom.XformCache()
    for name, (position, quat) in poses.items():
        found, rotation = reader._rigid_pose(cache.GetLocalToWorldTransform(after.GetPrimAtPath(name)))
        off = max(float(np.abs(found - position).max()), (rotation * Rotation.from_quat(quat).inv()).magnitude())
        if off > _EXACT:
            raise SceneError(
                f"{path}: the written pose of {name} differs by {off:.1e}, expected at most {_EXACT:g}", "patch_differs"
            )


def _same(one: Any, other: Any) -> bool:
    return bool(one == other) or (one is None and other is None) or str(one) == str(other)


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = (float(v) for v in values)
    return x, y, z
