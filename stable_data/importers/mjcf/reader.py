"""Reads objects of MuJoCo models (MJCF): scanned objects, and those of robosuite, RoboCasa and LIBERO.

What is read of a model is what MuJoCo makes of it: classes, transforms, meshes and inertias are taken from the compiled model, whose
frame is z up in metres.

* **Seen** is what does not collide (``contype`` and ``conaffinity`` are 0). Where groups tell colliders from the rest, what collides
  and is in the group of seen geoms is seen too; where everything collides, it is also what is seen. A geom that is fully transparent
  or in the groups 3 to 5, which MuJoCo hides, is not seen, unless the model has nothing else.
* **Colliders** are all geoms that collide; of a mesh MuJoCo uses the convex hull, and so does this reader.
* **Mass** is stated if the model states it of bodies, of colliding geoms or as a whole. MuJoCo gives a density to all other geoms,
  also to those that are only seen; what follows from it is no weighed mass.
* **Friction** is that of the colliders, the mean by surface if they differ; None if the model states none.
* **Texture coordinates** of a mesh are taken as they are, and ``texrepeat`` applies to those alone that MuJoCo makes where a mesh has
  none. MuJoCo 4 applies it to both; the objects of robosuite and RoboCasa were made for its earlier versions.
* A plane is the ground of a scene; a model with one is refused.
* A model without a joint is an object as well: those of robosuite get their free joint from its code. So no model is static.
"""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import Mesh, double_areas, drop_unused_vertices, joined_corners
from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.primitive_shapes import box_triangles, capsule_triangles, cylinder_triangles, sphere_triangles
from stable_data.geometry.surface import Surface
from stable_data.importers.asset_ids import AssetIds
from stable_data.importers.boundary import Boundary, renamed_notice
from stable_data.importers.formats.mesh_file import check_face_count
from stable_data.importers.mjcf.text import IsolatedModel, MjcfText
from stable_data.importers.model_names import name_of_path, nameless_notice
from stable_data.importers.source import GivenInertial, GivenLicence, ReaderOptions, SourceAsset, SourceRef
from stable_data.importers.stated_licences import LicenceFiles, licences_of_file
from stable_data.json_text import is_unicode, quote_value
from stable_data.limits import LIMITS, is_out_of_memory
from stable_data.scene import FloatArray, Vec3

if TYPE_CHECKING:
    import mujoco

_SHOWN_GROUPS = 3  # MuJoCo shows the groups 0 to 2
_STATED = 0.99  # share of the mass that must be stated
_GREY = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that has none
_REGION = "reg_"  # RoboCasa's names of regions, which are boxes of no substance
_LARGEST = 1e6  # metres: a longer shape is none of an asset, and its volume or place may not be finite
_OF_A_SHAPE = len(sphere_triangles())  # triangles of a simple shape, about


class MjcfReader:
    """Reads the kind ``mjcf``."""

    def find(self, root: Boundary, options: ReaderOptions) -> Iterator[SourceRef | Notice]:
        """Lists the models that have a shape, by their text.

        Fragments that other models include are none. A model that includes another complete model is a scene around it and is left
        out; the object is read from its own file.
        """
        found: dict[str, tuple[str, ...]] = {}
        scenes: dict[str, tuple[str, ...]] = {}
        failures: dict[str, MeshError] = {}
        for path in root.files((".xml", ".mjcf")):
            if not is_unicode(path):
                yield nameless_notice(path)
                continue
            boundary = Boundary(root.root, root.limits)
            try:
                model = MjcfText.load(boundary, path)
            except MeshError as error:
                failures[path] = error
                continue
            if model is not None and model.is_object:
                scenes[path] = model.includes
                found[path] = tuple(dict.fromkeys((path, *model.includes, *_existing(model, boundary))))
        ids, licences = AssetIds(), LicenceFiles(root)
        for path in sorted({*found, *failures}):
            if path in failures:
                asset_id = ids.of_path(name_of_path(path, root.root.name), path)
                yield Notice(asset_id, "find", failures[path].code, f"asset {asset_id}: {failures[path]}")
            elif not any(include in found for include in scenes[path]):
                licence = licences.nearest(path)
                files = found[path] if licence is None else tuple(dict.fromkeys((*found[path], licence)))
                entry = {} if licence is None else {"licence_file": licence}
                yield SourceRef(ids.of_path(name_of_path(path, root.root.name), path), path, files, entry)

    def read(self, root: Boundary, ref: SourceRef, options: ReaderOptions) -> SourceAsset:
        """Reads a model.

        Raises:
            MeshError: ``model_unreadable``, ``model_unsupported``, ``composite``, ``mesh_empty``, ``mesh_too_large``,
                ``cyclic_reference`` or a code of the boundary.
        """
        model = MjcfText.load(root, ref.path)
        if model is None:
            raise MeshError(f"{ref.path}: is no MuJoCo model, expected one", "model_unreadable")
        return _ModelReader(root, ref, options, model).asset()


def _existing(model: MjcfText, boundary: Boundary) -> Iterator[str]:
    """The files of a model's meshes and textures that can be read; what reading finds amiss with the others is said there."""
    for reference in model.references().values():
        try:
            yield boundary.resolve(reference, model.base)
        except MeshError:
            continue


@dataclass(slots=True)
class _ModelReader:
    """Reads one model."""

    root: Boundary
    ref: SourceRef
    options: ReaderOptions
    text: MjcfText
    notices: list[Notice] = field(default_factory=list)
    images: dict[str, bytes | None] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)

    def asset(self) -> SourceAsset:
        name = name_of_path(self.ref.path, self.root.root.name)
        if (renamed := renamed_notice(self.ref.asset_id, name)) is not None:
            self.notices.append(renamed)
        isolated = self.text.isolated(self.root, self.options.max_faces)
        shapes = _compile(isolated, self.ref.path)
        self._check(shapes)
        seen, collides = shapes.seen(), shapes.collides
        for geoms in (seen, np.flatnonzero(collides).tolist()):
            num_faces = sum(shapes.num_faces(geom) for geom in geoms)
            check_face_count(quote_value(self.ref.path), num_faces, self.options.max_faces)
        surfaces = tuple(self._surface(shapes, geom, isolated) for geom in seen)
        if not any(len(surface.triangles) for surface in surfaces):
            self._fail("has nothing that is seen", "a geom that is not transparent", "mesh_empty")
        colliders = [shapes.collider(int(geom)) for geom in np.flatnonzero(collides)]
        licence, licence_file = self.text.statement("license", "licence", "copyright"), self.ref.entry.get("licence_file")
        licences = [GivenLicence(licence, PurePosixPath(self.ref.path).name)] if licence else []
        if licence_file:
            licences += licences_of_file(self.root, licence_file)
        return SourceAsset(
            asset_id=self.ref.asset_id,
            name=name,
            surfaces=surfaces,
            unit_m=1.0,
            is_upright=shapes.is_upright(),
            front=self.options.front_direction,
            colliders=tuple(collider for collider in colliders if collider is not None),
            inertial=shapes.inertial(says_total=self.text.says_total_mass),
            friction=self._friction(shapes, colliders) if self.text.says_friction else None,
            category=_category(self.ref.path),
            description=self.text.statement("description"),
            author=self.text.statement("author", "creator"),
            url=self.text.statement("url", "source"),
            licences=tuple(licences),
            num_joints=shapes.num_joints,
            notices=tuple(self.notices),
        )

    def _check(self, shapes: "_Shapes") -> None:
        """Refuses what is no single object."""
        if shapes.has_plane():
            self._fail("has a plane as ground", "one object; use stable-data import scenes", "composite")
        if shapes.num_free > 1:
            self._fail(f"has {shapes.num_free} free bodies", "one object; give each a model of its own", "composite")
        if shapes.has_surroundings():
            self._fail(
                "has bodies and things around them that are fixed",
                "one object; use stable-data import scenes",
                "composite",
            )

    def _surface(self, shapes: "_Shapes", geom: int, isolated: IsolatedModel) -> Surface:
        local = shapes.mesh(geom).triangles
        name, corner_uv = shapes.texture(geom, local)
        texture = isolated.textures.get(name)
        colour, opacity = shapes.colour(geom, texture.colour if texture else (1.0, 1.0, 1.0))
        image = self._image(texture.reference) if texture and texture.reference and corner_uv is not None else None
        if image is None or texture is None or corner_uv is None:
            return Surface(shapes.in_world(geom, local), colour, opacity=opacity)
        mirrored = np.where(texture.is_mirrored, 1 - corner_uv, corner_uv)
        return Surface(shapes.in_world(geom, local), colour, None, image, mirrored, opacity)

    def _image(self, reference: str) -> bytes | None:
        """The content of a texture's file; None and a notice if it cannot be read."""
        if reference not in self.images:
            try:
                path = self.root.resolve(reference, self.text.base)
                if path not in self.contents:  # several names may mean one file
                    self.contents[path] = self.root.read_bytes(path, "max_bytes", LIMITS.image)
                self.images[reference] = self.contents[path]
            except MeshError as error:
                self.images[reference] = None
                self._note(_TEXTURE_CODES.get(error.code, "texture_invalid"), f"{error}; the surface keeps its colour alone")
        return self.images[reference]

    def _friction(self, shapes: "_Shapes", colliders: list[Mesh | None]) -> Vec3 | None:
        frictions = shapes.model.geom_friction[shapes.collides]
        if not len(frictions):
            return None
        mean = frictions[0]
        if not (frictions == mean).all():
            areas = np.array([double_areas(mesh).sum() if mesh is not None else 0.0 for mesh in colliders])
            averages = np.average(frictions, axis=0, weights=areas if areas.sum() > 0 else None)
            mean = np.where((frictions == mean).all(axis=0), mean, averages)
            self._note("friction_averaged", "its colliders differ in friction; the mean by their surface is used")
        return float(mean[0]), float(mean[1]), float(mean[2])

    def _note(self, code: str, message: str) -> None:
        self.notices.append(Notice(self.ref.asset_id, "read", code, f"asset {self.ref.asset_id}: {message}"))

    def _fail(self, found: str, expected: str, code: str) -> NoReturn:
        raise MeshError(f"{quote_value(self.ref.path)} {found}, expected {expected}", code)


_TEXTURE_CODES = {
    "path_outside": "texture_outside",
    "file_missing": "texture_missing",
    "file_too_large": "texture_too_large",
}


def _category(path: str) -> str:
    """The category of RoboCasa's folders ``apple/apple_3/model.xml``; empty for others."""
    folder = PurePosixPath(path).parent
    kind = folder.parent.name
    return kind.replace("_", " ") if kind and re.fullmatch(re.escape(kind) + r"_\d+", folder.name) else ""


def _compile(isolated: IsolatedModel, path: str) -> "_Shapes":
    """Compiles a model. Meshes that enclose no volume are taken as shells, as a second attempt."""
    from stable_data.simulation.mujoco_import import mujoco

    failure: Exception | None = None
    for is_solid in (True, False):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # attributes of older versions
                return _Shapes.of(isolated, is_solid=is_solid)
        except (ValueError, TypeError, RuntimeError, mujoco.FatalError, mujoco.UnexpectedError) as error:
            if is_out_of_memory(error):
                raise
            failure = failure or error
    found = " ".join(str(failure).split())[:300]
    message = f"{quote_value(path)}: MuJoCo does not compile it ({found}), expected a model that it compiles; correct it"
    raise MeshError(message, "model_unreadable") from failure


@dataclass(slots=True)
class _Shapes:
    """The shapes of a compiled model, at its reference pose."""

    spec: "mujoco.MjSpec"
    model: "mujoco.MjModel"
    data: "mujoco.MjData"
    is_solid: bool

    @classmethod
    def of(cls, isolated: IsolatedModel, *, is_solid: bool) -> "_Shapes":
        """Compiles a model; meshes that are not solid are taken as shells."""
        from stable_data.simulation.mujoco_import import mujoco, without_log_file

        with without_log_file():
            spec = mujoco.MjSpec.from_string(isolated.text, assets=dict(isolated.meshes))
            spec.compiler.discardvisual = False
            spec.compiler.fusestatic = False
            for mesh in spec.meshes if not is_solid else ():
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            model = spec.compile()
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
        if not (np.abs(model.geom_size) < _LARGEST).all():
            raise ValueError(f"a shape of {np.abs(model.geom_size).max():g} m, expected usual lengths")
        return cls(spec, model, data, is_solid)

    @property
    def collides(self) -> Any:
        """Whether each geom collides, (G,) bool."""
        return (self.model.geom_contype != 0) | (self.model.geom_conaffinity != 0)

    @property
    def num_free(self) -> int:
        """Number of free joints."""
        return int((self.model.jnt_type == _type("mjJNT_FREE")).sum())

    @property
    def num_joints(self) -> int:
        """Number of joints between bodies that can move."""
        return int(self.model.njnt) - self.num_free

    def has_plane(self) -> bool:
        """Whether a geom is a plane."""
        return bool((self.model.geom_type == _type("mjGEOM_PLANE")).any())

    def has_surroundings(self) -> bool:
        """Whether some geoms belong to the object and others to the world around it."""
        bodies = self.model.geom_bodyid
        around = self.model.body_weldid[bodies] == 0 if self.num_free else bodies == 0
        return bool(around.any() and not around.all())

    def seen(self) -> list[int]:
        """Geoms that are seen, by the rules of this module."""
        model, collides = self.model, self.collides
        is_region = np.array([model.geom(geom).name.startswith(_REGION) for geom in range(model.ngeom)], bool)
        opaque = (np.array([self._rgba(geom)[3] for geom in range(model.ngeom)]) > 0) & ~is_region
        visible = opaque & (model.geom_group < _SHOWN_GROUPS)
        if not visible.any():
            visible = opaque
        alone = visible & ~collides
        if alone.any():
            groups = np.unique(model.geom_group[alone])
            shares_groups = np.isin(model.geom_group[collides], groups).all()
            visible = alone | (visible & np.isin(model.geom_group, groups) & (not shares_groups))
        return [int(geom) for geom in np.flatnonzero(visible)]

    def num_faces(self, geom: int) -> int:
        """Triangles of a geom, about."""
        mesh = self.model.geom_dataid[geom]
        return int(self.model.mesh_facenum[mesh]) if mesh >= 0 else _OF_A_SHAPE

    def mesh(self, geom: int) -> Mesh:
        """The shape of a geom in its own frame."""
        model, size = self.model, self.model.geom_size[geom]
        kind = model.geom_type[geom]
        if kind in (_type("mjGEOM_MESH"), _type("mjGEOM_SDF")):
            mesh = model.geom_dataid[geom]
            first, start = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
            vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
            return Mesh(vertices, model.mesh_face[start : start + model.mesh_facenum[mesh]])
        if kind == _type("mjGEOM_BOX"):
            return joined_corners(box_triangles() * 2 * size)
        if kind == _type("mjGEOM_SPHERE"):
            return joined_corners(sphere_triangles() * size[0])
        if kind == _type("mjGEOM_ELLIPSOID"):
            return joined_corners(sphere_triangles() * size)
        if kind == _type("mjGEOM_CYLINDER"):
            return joined_corners(cylinder_triangles(size[0], 2 * size[1]))
        assert kind == _type("mjGEOM_CAPSULE"), kind  # planes and height fields were refused
        return joined_corners(capsule_triangles(size[0], 2 * size[1]))

    def in_world(self, geom: int, points: FloatArray) -> FloatArray:
        """Points (..., 3) of a geom's frame in the frame of the model."""
        placed: FloatArray = points @ self.data.geom_xmat[geom].reshape(3, 3).T + self.data.geom_xpos[geom]
        return placed

    def collider(self, geom: int) -> Mesh | None:
        """The collision shape of a geom; None for a flat mesh."""
        from stable_data.geometry.convex_decomposition import convex_hull

        mesh = self.mesh(geom)
        if self.model.geom_dataid[geom] >= 0:
            hull = convex_hull(drop_unused_vertices(mesh.vertices, mesh.faces)[0])
            if hull is None:
                return None
            mesh = hull
        return Mesh(self.in_world(geom, mesh.vertices), mesh.faces)

    def _rgba(self, geom: int) -> FloatArray:
        """Display colour and opacity: that of the material, unless the geom has one of its own."""
        material = self.model.geom_matid[geom]
        own: FloatArray = self.model.geom_rgba[geom].astype(np.float64)
        return own if material < 0 or tuple(own) != _GREY else self.model.mat_rgba[material].astype(np.float64)

    def colour(self, geom: int, factor: Vec3) -> tuple[Vec3 | None, float]:
        """Linear colour times a display colour, None for a geom without colour and material; and opacity."""
        rgba = self._rgba(geom)
        if self.model.geom_matid[geom] < 0 and tuple(rgba) == _GREY:
            return None, 1.0
        red, green, blue = to_linear(np.clip(rgba[:3] * np.array(factor), 0, 1)).tolist()
        return (red, green, blue), float(np.clip(rgba[3], 0, 1))

    def texture(self, geom: int, triangles: FloatArray) -> tuple[str, FloatArray | None]:
        """Name of the texture of a geom's material, and its coordinates at the corners of triangles (F, 3, 3) of the geom's frame.

        Coordinates that a mesh does not have are made as MuJoCo makes them: a projection along z, or a cube around the geom.

        Returns:
            The name, empty without a texture; and the coordinates, (F, 3, 2), from the upper left, None without a texture.
        """
        model = self.model
        material = model.geom_matid[geom]
        texture = int(model.mat_texid[material][_type("mjTEXROLE_RGB")]) if material >= 0 else -1
        if texture < 0:
            return "", None
        name, mesh, size = model.tex(texture).name, model.geom_dataid[geom], model.geom_size[geom].copy()
        if mesh >= 0 and model.mesh_texcoordadr[mesh] >= 0:
            first, start = model.mesh_texcoordadr[mesh], model.mesh_faceadr[mesh]
            coordinates = model.mesh_texcoord[first : first + model.mesh_texcoordnum[mesh]].astype(np.float64)
            return name, coordinates[model.mesh_facetexcoord[start : start + model.mesh_facenum[mesh]]]
        if model.geom_type[geom] in (_type("mjGEOM_SPHERE"), _type("mjGEOM_CYLINDER"), _type("mjGEOM_CAPSULE")):
            size = np.array([size[0], size[0], size[0] if size[1] == 0 else size[1]])
        size = np.maximum(size, 1e-15)
        is_uniform = bool(model.mat_texuniform[material])
        if model.tex_type[texture] == _type("mjTEXTURE_2D"):
            repeat = model.mat_texrepeat[material] * (1.0 if is_uniform else 1 / size[:2])
            return name, triangles[..., :2] * (0.5, -0.5) * repeat - 0.5
        is_mesh = mesh >= 0  # MuJoCo scales the coordinates of other shapes to a unit size, and back if they are uniform
        if is_mesh != is_uniform:
            return name, _cube_coordinates(triangles)
        return name, _cube_coordinates(triangles * (size if is_mesh else 1 / size))

    def inertial(self, *, says_total: bool) -> GivenInertial | None:
        """The mass of all bodies, if the model says something about it.

        Args:
            says_total: Whether it states the mass of all bodies together.
        """
        model, data = self.model, self.data
        masses = model.body_mass[1:]
        total = float(masses.sum())
        if total <= 0:
            return None
        is_weighed = says_total or self._stated_mass() >= _STATED * total
        if not is_weighed:
            return GivenInertial(total, is_weighed=False) if self.is_solid and self.collides.any() else None
        centre = masses @ data.xipos[1:] / total
        inertia = np.zeros((3, 3))
        for body, mass in enumerate(masses, start=1):
            axes, offset = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
            inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
            inertia += mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        x, y, z = centre.tolist()
        return GivenInertial(total, (x, y, z), inertia)

    def _stated_mass(self) -> float:
        """Mass that the model states of bodies and of geoms that collide."""
        from_geoms = self.spec.compiler.inertiafromgeom == 1
        stated, collides = 0.0, self.collides
        for body in self.spec.bodies[1:]:
            if body.explicitinertial and not from_geoms:
                stated += float(self.model.body_mass[body.id])
            else:
                stated += sum(float(geom.mass) for geom in body.geoms if np.isfinite(geom.mass) and collides[geom.id])
        return stated

    def is_upright(self) -> bool:
        """Whether the model says which way is up, as RoboCasa's region of the box does.

        The sites of bottom and top in the objects of robosuite and LIBERO say nothing: many of them were copied from other objects,
        and LIBERO's code turns half of its bottles and boxes upright.
        """
        names = [self.model.geom(k).name for k in range(self.model.ngeom)] + [
            self.model.site(k).name for k in range(self.model.nsite)
        ]
        return f"{_REGION}bbox" in names


def _type(name: str) -> int:
    """The number of one of MuJoCo's types."""
    from stable_data.simulation.mujoco_import import mujoco

    kind = {
        "mjGEOM": mujoco.mjtGeom,
        "mjJNT": mujoco.mjtJoint,
        "mjTEXTURE": mujoco.mjtTexture,
        "mjTEXROLE": mujoco.mjtTextureRole,
    }
    return int(getattr(kind[name.split("_")[0]], name))


# Of each face of a cube +x, -x, +y, -y, +z, -z: the directions in which the image goes to the right and down, as OpenGL defines them.
_CUBE = np.array(
    [
        [[0, 0, -1], [0, -1, 0]],
        [[0, 0, 1], [0, -1, 0]],
        [[1, 0, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, -1]],
        [[1, 0, 0], [0, -1, 0]],
        [[-1, 0, 0], [0, -1, 0]],
    ],
    float,
)


def _cube_coordinates(triangles: FloatArray) -> FloatArray:
    """Texture coordinates of triangles (F, 3, 3) on a cube around the origin, whose six faces show the same image, (F, 3, 2).

    Each triangle takes the face of its centroid.
    """
    middle = triangles.mean(axis=1)
    axis = np.abs(middle).argmax(axis=1)
    rows = np.arange(len(triangles))
    face = 2 * axis + (middle[rows, axis] < 0)
    depth = np.abs(triangles[rows, :, axis])
    depth = np.maximum(depth, 0.1 * np.abs(triangles).max(axis=(1, 2))[:, None] + 1e-15)
    coordinates: FloatArray = (np.einsum("fcx,fdx->fcd", triangles, _CUBE[face]) / depth[..., None] + 1) / 2
    return coordinates


READER = MjcfReader()
