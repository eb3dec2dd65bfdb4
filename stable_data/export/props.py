"""Objects as props: rigid bodies in a frame of their own, for formats that keep a file for each asset.

The frame of a prop stands on its base: the origin is the centre of the base of its box in its usual resting tilt, z is up, the axes
are those of its yaw frame. A prop has its usual size; an object of a scene is a prop, a factor and a pose. Metres, kilograms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import MeshError
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface import Surface
from stable_data.rotations import quat_of, yaw_frame_box
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from stable_data.simulation.collision_bodies import asset_parts
from stable_data.simulation.mujoco_model import body_name
from stable_data.simulation.render import object_colour, rgba
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import RigidBody, hull_volume

_USUAL_SIDE = 0.1  # longest side of a prop whose usual size is not known, metres
_DIGITS = 9  # significant digits of a scale that two objects of one prop share
_STAND = Tabletop("stand", (1.0, 1.0))


@dataclass(frozen=True, slots=True)
class MassDistribution:
    """The mass of a body and how it is distributed.

    Attributes:
        mass: Kilograms.
        center_of_mass: Metres, frame of the prop.
        moments: Principal moments of inertia about the centre of mass, kg m².
        axes_quat_xyzw: Rotation of the principal axes in the frame of the prop.
    """

    mass: float
    center_of_mass: Vec3
    moments: Vec3
    axes_quat_xyzw: QuatXyzw

    @property
    def inertia(self) -> FloatArray:
        """The inertia tensor about the centre of mass, (3, 3) float64, kg m², axes of the prop."""
        turn = Rotation.from_quat(self.axes_quat_xyzw).as_matrix()
        return np.asarray((turn * self.moments) @ turn.T)

    def scaled(self, factor: float) -> "MassDistribution":
        """The distribution in the same body of another size and the same density."""
        x, y, z = (factor * c for c in self.center_of_mass)
        a, b, c = (factor**5 * m for m in self.moments)
        return MassDistribution(factor**3 * self.mass, (x, y, z), (a, b, c), self.axes_quat_xyzw)


@dataclass(frozen=True, slots=True)
class Prop:
    """An asset at its usual size, or a box that replaces a missing mesh.

    Attributes:
        name: Lower-case letters, digits and ``_``; props of different geometry have different names.
        category: Its category.
        annotation: What is known of its asset; None for a box.
        scale: Metres per mesh unit; for a box its size.
        tilt_quat_xyzw: Rotation of the mesh in the frame of the prop.
        base: Centre of the mesh's own box in the frame of the prop, metres.
        size: Its box, metres.
        colour: Its colour where the asset has none, ``#rrggbb``.
    """

    name: str
    category: str
    annotation: AssetAnnotation | None
    scale: Vec3
    tilt_quat_xyzw: QuatXyzw
    base: Vec3
    size: Vec3
    colour: str

    @property
    def asset_id(self) -> str | None:
        """The asset; None for a box."""
        return None if self.annotation is None else self.annotation.asset_id


_PROPS: WeakKeyDictionary[AssetStore, dict[tuple[str, Vec3], Prop]] = WeakKeyDictionary()
"""The props of the assets of a store, which end with it."""


@dataclass(frozen=True, slots=True)
class PlacedProp:
    """An object of a scene.

    Attributes:
        name: Name of its body, see :func:`~stable_data.simulation.mujoco_model.body_name`; unique in the scene.
        object: The object.
        prop: The prop.
        factor: Size relative to the prop.
        mass: Its mass, in the frame of the prop.
        friction: Sliding, torsional (metres) and rolling (metres) coefficients; None: those of the scene.
        position: The origin of the prop, metres, world frame.
        quat_xyzw: Rotation of the prop in the world.
        is_fixed: Whether it does not move.
        is_seen: Whether it is drawn: a fixed object may be seen as a part of the support.
    """

    name: str
    object: SceneObject
    prop: Prop
    factor: float
    mass: MassDistribution
    friction: Vec3 | None
    position: Vec3
    quat_xyzw: QuatXyzw
    is_fixed: bool
    is_seen: bool


def placed_props(geometry: SceneGeometry) -> list[PlacedProp]:
    """Returns the objects of a scene as props, in its order.

    Raises:
        MeshError: A mesh has no part with a volume (``no_collider``).
    """
    taken = {body_name(o.instance).lower() for o in geometry.scene.objects}
    used, found = set[str](), []
    for k, (o, body) in enumerate(zip(geometry.scene.objects, geometry.bodies, strict=True)):
        name = body_name(o.instance)
        if name.lower() in used:  # some formats and file systems do not tell upper from lower case
            while (name := f"{name}-{k}").lower() in taken:
                pass
        used.add(name.lower())
        taken.add(name.lower())
        found.append(_placed(geometry, k, body, name))
    return found


def _placed(geometry: SceneGeometry, k: int, body: RigidBody, name: str) -> PlacedProp:
    o, mesh = geometry.scene.objects[k], geometry.meshes[k]
    turn, offset = Rotation.from_quat(UPRIGHT), np.zeros(3)
    if mesh is None or o.scale is None or o.asset_id is None:
        prop, factor = _box(o), 1.0
    else:
        annotation = geometry.annotations.get(o.asset_id) or AssetAnnotation(o.asset_id, o.category)
        prop, factor = _prop(o, mesh, annotation, geometry.store)
        turn = Rotation.from_quat(o.tilt_quat_xyzw) * Rotation.from_quat(prop.tilt_quat_xyzw).inv()
        offset = geometry.offset(k)
    # A point b of the prop is turn · (b − base) + offset in the yaw frame of the object.
    base = factor * np.array(prop.base)
    world = Rotation.from_euler("z", o.yaw)
    x, y, z = (o.position + world.apply(offset - turn.apply(base))).tolist()
    return PlacedProp(
        name=name,
        object=o,
        prop=prop,
        factor=factor,
        mass=_mass_in_prop(body, turn, offset, base),
        friction=body.friction,
        position=(x, y, z),
        quat_xyzw=quat_of(world * turn),
        is_fixed=not body.movable,
        is_seen=geometry.is_seen(k),
    )


def _box(o: SceneObject) -> Prop:
    x, y, z = (max(side, 2e-4) for side in o.size)
    name = f"{_word(o.category)}_{content_id(['box', o.category, o.size])[:12]}"
    return Prop(name, o.category, None, (x, y, z), UPRIGHT, (0.0, 0.0, z / 2), (x, y, z), object_colour(o))


def _prop(o: SceneObject, mesh: Mesh, annotation: AssetAnnotation, store: AssetStore) -> tuple[Prop, float]:
    """The prop of an object with a mesh, and the size of the object relative to it."""
    assert o.scale is not None
    own = np.array(o.scale)
    if annotation.typical_scale is None:
        factor = float((mesh.extents * own).max()) / _USUAL_SIDE
    else:
        factor = float(np.linalg.norm(own) / np.linalg.norm(annotation.typical_scale))
    # Objects of one prop differ by rounding errors in their proportions.
    a, b, c = (float(f"{side:.{_DIGITS}g}") for side in (own / factor).tolist())
    if annotation.typical_scale is not None and np.allclose((a, b, c), annotation.typical_scale, rtol=1e-8, atol=0):
        a, b, c = annotation.typical_scale
    known = _PROPS.setdefault(store, {})
    key = (annotation.asset_id, (a, b, c))
    if key not in known:
        category = annotation.category or o.category  # not that of the object that comes first
        known[key] = _asset_prop((a, b, c), mesh, annotation, category, object_colour(replace(o, category=category)))
    return known[key], factor


def _asset_prop(scale: Vec3, mesh: Mesh, annotation: AssetAnnotation, category: str, colour: str) -> Prop:
    tilt = annotation.resting_tilt or UPRIGHT
    low, high = yaw_frame_box(mesh.vertices, scale, tilt)
    x, y, z = (high - low).tolist()
    a, b, c = ((low + high) / -2).tolist()
    name = f"{_word(category)}_{content_id([annotation.asset_id, scale, tilt])[:12]}"
    return Prop(name, category, annotation, scale, tilt, (a, b, c + z / 2), (x, y, z), colour)


def sized_prop(prop: Prop, factor: float) -> Prop:
    """Returns a prop at another size, with a name of its own."""
    if factor == 1.0:
        return prop
    x, y, z = (factor * side for side in prop.scale)
    a, b, c = (factor * offset for offset in prop.base)
    i, j, k = (factor * side for side in prop.size)
    name = f"{_word(prop.category)}_{content_id([prop.name, (x, y, z)])[:12]}"
    return replace(prop, name=name, scale=(x, y, z), base=(a, b, c), size=(i, j, k))


def _word(category: str) -> str:
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in category.lower())[:40].strip("_")
    return plain if plain and not plain[0].isdigit() else f"object_{plain}".rstrip("_")


def _mass_in_prop(body: RigidBody, turn: Rotation, offset: FloatArray, base: FloatArray) -> MassDistribution:
    """The mass of a body, whose inertial is in the yaw frame of its object, in the frame of its prop."""
    if body.inertial is None:
        centre, per_mass = _distribution(body.parts)
        inertia = body.mass * per_mass
    else:
        centre, inertia = body.inertial.center_of_mass, body.inertial.inertia
    matrix = turn.as_matrix()
    x, y, z = (matrix.T @ (centre - offset) + base).tolist()
    moments, axes = np.linalg.eigh(matrix.T @ inertia @ matrix)
    if np.linalg.det(axes) < 0:
        axes = axes * (1.0, 1.0, -1.0)
    a, b, c = moments.tolist()
    return MassDistribution(body.mass, (x, y, z), (a, b, c), quat_of(Rotation.from_matrix(axes)))


@lru_cache(maxsize=1024)
def _distribution(parts: tuple[Mesh, ...]) -> tuple[FloatArray, FloatArray]:
    """Centre of mass and inertia tensor per kilogram of homogeneous parts.

    Raises:
        MeshError: None of them is solid (``no_collider``).
    """
    solid = solid_parts(parts)
    if not solid:
        raise MeshError(f"none of {len(parts)} convex parts is solid; decompose the mesh again", "no_collider")
    whole = mass_properties(join_meshes(solid), mass=1.0)
    return whole.center_of_mass, whole.inertia


def solid_parts(parts: Sequence[Mesh]) -> list[Mesh]:
    """Returns the parts that collide: those with a volume."""
    return [part for part in parts if hull_volume(part) > 0]


def _distinct(parts: Sequence[Mesh]) -> list[Mesh]:
    """The parts without those that are there twice, which collide no more than one."""
    return list({part.vertices.tobytes(): part for part in reversed(parts)}.values())[::-1]


def prop_parts(prop: Prop, store: AssetStore) -> list[Mesh]:
    """Returns the convex colliders of a prop, metres, in its frame; the faces point outward.

    Raises:
        MeshError: None of them is solid (``no_collider``).
    """
    if prop.asset_id is None:
        box = Shape.box(prop.size)
        return [Mesh(box.vertices + prop.base, box.faces)]
    mesh = store.asset(prop.asset_id).mesh
    turn = _turn(prop)
    placed = [Mesh(part.vertices @ turn + prop.base, part.faces) for part in asset_parts(prop.asset_id, mesh, store)]
    if not (solid := solid_parts(placed)):
        raise MeshError(f"asset {prop.asset_id}: none of {len(placed)} convex parts is solid", "no_collider")
    return _distinct(solid)


def prop_surfaces(prop: Prop, store: AssetStore) -> list[Surface]:
    """Returns what is seen of a prop, metres, in its frame."""
    if prop.asset_id is None:
        box = Shape.box(prop.size)
        red, green, blue = _linear(prop.colour)
        return [Surface((box.vertices + prop.base)[box.faces], (red, green, blue), opacity=0.45)]
    turn = _turn(prop)
    surfaces = store.look(prop.asset_id)[0]
    if surfaces is None:
        mesh = store.asset(prop.asset_id).mesh
        paint = store.paint(prop.asset_id)[0] or ((prop.colour, np.arange(len(mesh.faces))),)
        surfaces = tuple(Surface(mesh.triangles[rows], _linear(colour)) for colour, rows in paint)
    return [replace(s, triangles=s.triangles @ turn + prop.base) for s in surfaces if len(s.triangles)]


def prop_mass(prop: Prop, store: AssetStore) -> tuple[MassDistribution, Vec3 | None]:
    """Returns the mass of a prop at its usual size, and its friction; None: that of the scene.

    Raises:
        MeshError: None of its parts is solid (``no_collider``).
    """
    o = SceneObject(
        prop.name, prop.category, (0.0, 0.0, prop.size[2] / 2), 0.0, prop.size, prop.asset_id, prop.scale, prop.tilt_quat_xyzw
    )
    geometry = SceneGeometry.of(Scene(prop.name, _STAND, (o,)), store)
    [body], base = geometry.bodies, np.array(prop.base)
    offset = np.zeros(3) if geometry.meshes[0] is None else geometry.offset(0)
    return _mass_in_prop(body, Rotation.identity(), offset, base), body.friction


def _turn(prop: Prop) -> FloatArray:
    """Turns row vectors of the mesh, mesh units, into those of the prop."""
    return np.asarray((Rotation.from_quat(prop.tilt_quat_xyzw).as_matrix() * prop.scale).T)


def _linear(colour: str) -> tuple[float, float, float]:
    red, green, blue = to_linear(np.array(rgba(colour)[:3])).tolist()
    return red, green, blue
