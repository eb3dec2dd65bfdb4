"""Reads assets of USD: SimReady packages, scanned objects, files of usdz.

* **Which files are assets**: those with a default prim, or with a single root prim, that are no part of another asset of the folder.
  A layer that another one references, or takes as payload or sublayer, is its part.
* **The asset** is its default prim with all below it, at the first time of the stage; what stands beside it (lights, ground, physics
  scene) is not read.
* **Unit and axis** are those of the stage; without a stated unit it is not known, although USD calls that centimetres.
* **Seen** are visible prims of the purposes default and render, else proxy. **Colliders** are prims with a collision API; of an
  approximation that a simulator computes (convex decomposition, simplification) the mesh itself is given, if it is closed.
* **Mass, friction, joints**: :mod:`stable_data.importers.usd.physics`. **Layers**: :mod:`stable_data.importers.usd.layers`.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import PurePosixPath
from typing import Any, NoReturn

import numpy as np

from stable_data.errors import ConfigError, MeshError, Notice
from stable_data.extras import install_hint
from stable_data.geometry.mesh import joined_corners
from stable_data.geometry.primitive_shapes import sphere_triangles
from stable_data.geometry.surface import Surface
from stable_data.importers.asset_ids import AssetIds
from stable_data.importers.boundary import Boundary, renamed_notice
from stable_data.importers.formats.mesh_file import faces_allowed
from stable_data.importers.model_names import name_of_path, nameless_notice
from stable_data.importers.source import GivenLicence, ReaderOptions, SourceAsset, SourceRef
from stable_data.importers.stated_licences import LicenceFiles, licences_of_file
from stable_data.importers.usd.layers import SUFFIXES, LayerLoader, quiet_usd
from stable_data.importers.usd.materials import UsdMaterial, material_of
from stable_data.importers.usd.physics import (
    Collider,
    StageFrame,
    bodies_of,
    friction_of,
    inertial_of,
    joints_of,
    prims_of,
)
from stable_data.importers.usd.scan import LayerFacts, LayerScanner
from stable_data.importers.usd.shapes import Faces, collision_shape, face_subsets, faces_of, simple_shape
from stable_data.json_text import is_unicode, quote_value
from stable_data.limits import LIMITS
from stable_data.scene import FloatArray

_TURNS = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
_OF_A_SHAPE = len(sphere_triangles())  # triangles of a simple shape, about
_MOST_TEXT = 1000  # characters of a statement
# The key "creator" names the program that wrote the file.
_LICENCE = re.compile(r"licen[cs]e|copyright", re.IGNORECASE)
_AUTHOR = re.compile(r"^(?:author|artist)s?$", re.IGNORECASE)
_URL = re.compile(r"^(?:source_?)?ur[il]$|^source$|^homepage$", re.IGNORECASE)
_CLASSES = ("class", "category")  # taxonomies whose labels are categories
_CODE = re.compile(r"code$", re.IGNORECASE)  # taxonomies whose labels are no words
_TEXTURE_CODES = {
    "path_outside": "texture_outside",
    "file_missing": "texture_missing",
    "file_too_large": "texture_too_large",
    "model_unsupported": "texture_missing",
}


class UsdReader:
    """Reads the kind ``usd``."""

    def find(self, root: Boundary, options: ReaderOptions) -> Iterator[SourceRef | Notice]:
        """Lists the assets, by their layers. These are parsed in a process of its own, which a broken file may end."""
        if find_spec("pxr") is None:
            hint = install_hint(ModuleNotFoundError(name="pxr"))
            raise ConfigError(f"reading USD {hint}", "package_missing")
        layers: dict[str, LayerFacts] = {}
        failures: dict[str, MeshError] = {}
        with LayerScanner(root) as scan:
            for path in root.files(SUFFIXES):
                if not is_unicode(path):
                    yield nameless_notice(path)
                    continue
                try:
                    layers[path] = scan(path)
                except MeshError as error:
                    failures[path] = error
        ids, licences = AssetIds(), LicenceFiles(root)
        roots = _roots_of(layers)
        for path in sorted({*roots, *failures}):
            asset_id = ids.of_path(name_of_path(path, root.root.name), path)
            if path in failures:
                yield Notice(asset_id, "find", failures[path].code, f"asset {asset_id}: {failures[path]}")
            elif layers[path].num_roots > 1 and not layers[path].has_default:
                found = f"has {layers[path].num_roots} root prims and none is the default prim, expected one that is the asset"
                yield Notice(
                    asset_id, "find", "default_prim_missing", f"asset {asset_id}: {quote_value(path)} {found}; name it"
                )
            else:
                licence = licences.nearest(path)
                files = (*_files_of(path, layers), *([licence] if licence is not None else []))
                yield SourceRef(
                    asset_id, path, tuple(dict.fromkeys(files)), {} if licence is None else {"licence_file": licence}
                )

    def read(self, root: Boundary, ref: SourceRef, options: ReaderOptions) -> SourceAsset:
        """Reads an asset.

        Raises:
            MeshError: ``model_unreadable``, ``model_unsupported``, ``composite``, ``mesh_empty``, ``mesh_not_finite``,
                ``mesh_too_large``, ``cyclic_reference``, ``archive_bomb`` or a code of the boundary.
        """
        with quiet_usd(ref.path):
            from pxr import Usd

            loader = LayerLoader(root)
            stage = Usd.Stage.Open(loader.load(ref.path))
            return _StageReader(root, ref, options, loader, stage).asset()


def _roots_of(layers: Mapping[str, LayerFacts]) -> list[str]:
    """The layers that are assets: part of no other one. Of layers that are all part of each other one is named, which then fails."""
    parts = {part for path, facts in layers.items() for part in facts.parts if part != path}
    roots = [path for path, facts in layers.items() if path not in parts and (facts.has_default or facts.num_roots > 0)]
    reached = {file for path in [p for p in layers if p not in parts] for file in _files_of(path, layers)}
    for path in layers:
        if path not in reached:
            roots.append(path)
            reached.update(_files_of(path, layers))
    return roots


def _files_of(path: str, layers: Mapping[str, LayerFacts]) -> tuple[str, ...]:
    """A layer with all layers and files that it needs."""
    found, left = dict[str, None](), [path]
    while left:
        one = left.pop()
        if one not in found:
            found[one] = None
            if one in layers:
                left += [*layers[one].files, *layers[one].parts]
    return (path, *sorted(file for file in found if file != path))


@dataclass(slots=True)
class _StageReader:
    """Reads one composed stage."""

    root: Boundary
    ref: SourceRef
    options: ReaderOptions
    loader: LayerLoader
    stage: Any
    notices: list[Notice] = field(default_factory=list)
    images: dict[str, bytes | None] = field(default_factory=dict)
    left_out: Counter[str] = field(default_factory=Counter)

    def asset(self) -> SourceAsset:
        from pxr import Usd, UsdGeom

        self._check_composition()
        prim = self._root_prim()
        time = Usd.TimeCode.EarliestTime()
        cache = UsdGeom.XformCache(time)
        frame, says_up = self._frame()
        self._check_size(prim, time)
        surfaces, colliders = self._shapes(prim, frame, cache, time)
        bodies = bodies_of(prim)
        joints = joints_of(prim, bodies)
        if joints.num_movable == 0 and joints.num_groups > 1:
            self._fail(f"has {joints.num_groups} bodies that are not joined", "one object; export each by itself", "composite")
        around = [c for c in colliders if bodies and not any(c.prim.GetPath().HasPrefix(b.GetPath()) for b in bodies)]
        if around:
            found = f"has a rigid body and, beside it, what collides ({around[0].prim.GetPath()})"
            self._fail(found, "one object; use stable-data import scenes", "composite")
        if not surfaces:
            if joints.num_movable:
                self._fail(f"has {joints.num_movable} joints and nothing that is seen", "a rigid object", "articulated")
            others = f" (not read: {', '.join(sorted(self.left_out))})" if self.left_out else ""
            self._fail(f"has nothing that is seen{others}", "a mesh or simple shape below its default prim", "mesh_empty")
        friction, differs = friction_of(colliders)
        if differs:
            self._note("friction_averaged", "its colliders differ in friction; the mean by their surface is used")
        for kind, count in sorted(self.left_out.items()):
            self._note("prim_left_out", f"{count} prims of the type {kind} are not read")
        words = _Statements.of(self.stage, prim)
        name = words.name or name_of_path(self.ref.path, self.root.root.name)
        if (renamed := renamed_notice(self.ref.asset_id, name)) is not None:
            self.notices.append(renamed)
        licences = list(words.licences)
        licence_file = self.ref.entry.get("licence_file")
        if licence_file:
            licences += licences_of_file(self.root, licence_file)
        return SourceAsset(
            asset_id=self.ref.asset_id,
            name=name,
            surfaces=tuple(surfaces),
            unit_m=frame.unit_m,
            is_upright=says_up,
            front=None if self.options.front_direction is None else _vector(frame.turn @ self.options.front_direction),
            colliders=tuple(collider.mesh for collider in colliders if collider.mesh is not None),
            inertial=inertial_of(prim, bodies, colliders, frame, cache),
            friction=friction,
            category=words.category,
            description=words.description,
            tags=words.tags,
            author=words.author,
            url=words.url,
            licences=tuple(licences),
            num_joints=joints.num_movable,
            is_static=joints.is_static,
            notices=tuple(self.notices),
        )

    def _check_composition(self) -> None:
        """Refuses circles within a layer, which USD cuts somewhere, and notes what else it could not compose."""
        from pxr import Pcp

        errors = self.stage.GetCompositionErrors()
        if any(isinstance(error, Pcp.ErrorArcCycle) for error in errors):
            self._fail("has prims that are part of themselves", "references without circles", "cyclic_reference")
        kinds = Counter(type(error).__name__.removeprefix("Error") for error in errors)
        for kind, count in sorted(kinds.items()):
            self._note(
                "composition_incomplete", f"{count} parts of it could not be composed ({kind}); what they say is missing"
            )

    def _root_prim(self) -> Any:
        prim = self.stage.GetDefaultPrim()
        if not prim:
            roots = list(self.stage.GetPseudoRoot().GetChildren())
            if len(roots) != 1:
                self._fail("has no default prim", "one that is the asset; name it in the layer", "default_prim_missing")
            prim = roots[0]
        return prim

    def _frame(self) -> tuple[StageFrame, bool]:
        """The frame of the stage, and whether it states which way is up."""
        from pxr import UsdGeom, UsdPhysics

        says_up = bool(self.stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis))
        up = str(UsdGeom.GetStageUpAxis(self.stage)).lower() if says_up else self.options.up or "y"
        if up not in _TURNS:
            raise ConfigError(
                f"the upward axis is {up!r}, expected y or z for files of USD; correct the option", "axis_invalid"
            )
        unit: float | None = self.options.unit_m or None
        if UsdGeom.StageHasAuthoredMetersPerUnit(self.stage):
            unit = float(UsdGeom.GetStageMetersPerUnit(self.stage))
        if unit is not None and not 0 < unit < float("inf"):
            self._fail(f"states {unit} metres for each unit", "more than 0; correct metersPerUnit", "unit_implausible")
        return StageFrame(_TURNS[up], unit, float(UsdPhysics.GetStageKilogramsPerUnit(self.stage))), says_up

    def _check_size(self, root: Any, time: Any) -> None:
        """Refuses meshes with too many triangles before they are divided into triangles."""
        from pxr import UsdGeom

        num = 0
        for prim in prims_of(root):
            if prim.IsA(UsdGeom.Mesh):
                counts = np.asarray(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get(time) or (), np.int64)
                num += int(np.maximum(counts - 2, 1).sum())  # faces of fewer corners take time, too
            elif prim.IsA(UsdGeom.Gprim):
                num += _OF_A_SHAPE
            if num > self.options.max_faces:
                expected = f"{faces_allowed(self.options.max_faces)}; reduce its meshes"
                self._fail("has more triangles", expected, "mesh_too_large")

    def _shapes(self, root: Any, frame: StageFrame, cache: Any, time: Any) -> tuple[list[Surface], list[Collider]]:
        """What is seen and what collides, in the frame of the asset."""
        from pxr import UsdGeom, UsdPhysics

        surfaces: dict[str, list[Surface]] = {}
        colliders: list[Collider] = []
        for prim in prims_of(root):
            if not prim.IsA(UsdGeom.Gprim):
                if prim.IsA(UsdGeom.PointInstancer):
                    self.left_out[prim.GetTypeName()] += 1
                continue
            collides = prim.HasAPI(UsdPhysics.CollisionAPI)
            collides &= UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get() is not False
            imageable = UsdGeom.Imageable(prim)
            purpose = str(imageable.ComputePurpose())
            is_seen = imageable.ComputeVisibility(time) != UsdGeom.Tokens.invisible and purpose != UsdGeom.Tokens.guide
            if not collides and not is_seen:
                continue
            world = frame.world(prim, cache)
            if prim.IsA(UsdGeom.Mesh):
                faces = faces_of(UsdGeom.Mesh(prim), time)
                local = faces.points[faces.corners[faces.triangles]]
            else:
                shape = simple_shape(prim, time)
                if shape is None:
                    self.left_out[prim.GetTypeName()] += 1
                    continue
                faces, local = None, shape
            triangles, order = _placed(local, world)
            if not np.isfinite(triangles).all():
                self._fail(
                    f"has a transform that is not finite at {prim.GetPath()}", "numbers; export it again", "mesh_not_finite"
                )
            if collides:
                mesh = joined_corners(triangles) if faces is None else collision_shape(prim, triangles)
                colliders.append(Collider(prim, mesh))
            if is_seen and len(triangles):
                surfaces.setdefault(purpose, []).extend(self._seen(prim, faces, triangles, order, time))
        shown = [*surfaces.get("default", ()), *surfaces.get("render", ())] or surfaces.get("proxy", [])
        return shown, colliders

    def _seen(self, prim: Any, faces: Faces | None, triangles: FloatArray, order: Any, time: Any) -> Iterator[Surface]:
        """The surfaces of a prim, one for each material."""
        from pxr import UsdGeom

        if faces is None:
            yield self._surface(prim, material_of(prim), None, triangles, order, np.ones(len(triangles), bool), time)
            return
        num_polygons = int(faces.polygons.max()) + 1
        for bound, polygons in face_subsets(UsdGeom.Mesh(prim), num_polygons, time):
            chosen = polygons[faces.polygons]
            if chosen.any():
                yield self._surface(prim, material_of(bound), faces, triangles, order, chosen, time)

    def _surface(
        self,
        prim: Any,
        material: UsdMaterial | None,
        faces: Faces | None,
        triangles: FloatArray,
        order: Any,
        chosen: Any,
        time: Any,
    ) -> Surface:
        """A surface with its look."""
        look = material or UsdMaterial(corner_colours="displayColor")
        colour, opacity = look.colour, look.opacity
        colours = self._primvar(prim, look.corner_colours, faces, 3, time) if look.corner_colours else None
        if colours is not None:
            colours = np.clip(np.nan_to_num(colours), 0, 1)
            if colours.ndim == 1:
                colour, colours = _vector(colours), None
        if material is None:
            stated = self._primvar(prim, "displayOpacity", faces, 1, time)
            opacity = 1.0 if stated is None else float(np.clip(np.nan_to_num(stated.mean(), nan=1.0), 0, 1))
        image = self._image(look.texture) if look.texture else None
        uv = self._primvar(prim, look.coordinates, faces, 2, time) if image is not None else None
        if image is not None and (uv is None or uv.ndim == 1):
            self._note(
                "texture_invalid",
                f"{prim.GetPath()} has no texture coordinates {look.coordinates!r}; it keeps its colour alone",
            )
            image = uv = None
        if uv is not None:
            if look.placement is not None:
                uv = uv @ look.placement[:, :2].T + look.placement[:, 2]
            uv = np.nan_to_num(uv) * (1, -1) + (0, 1)  # USD counts from the lower left
        return Surface(
            triangles[chosen],
            colour,
            None if colours is None else colours[chosen][:, order],
            image,
            None if uv is None else uv[chosen][:, order],
            opacity,
        )

    def _primvar(self, prim: Any, name: str, faces: Faces | None, width: int, time: Any) -> FloatArray | None:
        """Values of a primvar: at the corners of the triangles, (T, 3, width), or one for all, (width,); None without usable ones."""
        from pxr import UsdGeom

        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
        values = primvar.ComputeFlattened(time) if primvar and primvar.HasValue() else None
        if values is None:
            return None
        try:
            array = np.asarray(values, np.float64).reshape(-1, width)
        except (TypeError, ValueError):
            return None
        if len(array) == 1:
            one: FloatArray = array[0]
            return one
        return faces.of_corners(array, str(primvar.GetInterpolation())) if faces is not None else None

    def _image(self, key: str) -> bytes | None:
        """The content of a texture's file; None and a notice if it cannot be read."""
        if key not in self.images:
            try:
                self.images[key] = self.loader.read_file(key, "max_bytes", LIMITS.image)
            except MeshError as error:
                self.images[key] = None
                self._note(_TEXTURE_CODES.get(error.code, "texture_invalid"), f"{error}; the surface keeps its colour alone")
        return self.images[key]

    def _note(self, code: str, message: str) -> None:
        self.notices.append(Notice(self.ref.asset_id, "read", code, f"asset {self.ref.asset_id}: {message}"))

    def _fail(self, found: str, expected: str, code: str) -> NoReturn:
        raise MeshError(f"{quote_value(self.ref.path)} {found}, expected {expected}", code)


def _placed(local: FloatArray, world: FloatArray) -> tuple[FloatArray, Any]:
    """Triangles (F, 3, 3) under a transform (4, 4), and the order of their corners: a mirrored one keeps its outside."""
    order = slice(None, None, -1) if np.linalg.det(world[:3, :3]) < 0 else slice(None)
    with np.errstate(all="ignore"):
        return (local @ world[:3, :3].T + world[:3, 3])[:, order], order


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True, slots=True)
class _Statements:
    """What the metadata of a stage say in words."""

    name: str
    category: str
    description: str
    tags: tuple[str, ...]
    author: str
    url: str
    licences: tuple[GivenLicence, ...]

    @classmethod
    def of(cls, stage: Any, prim: Any) -> "_Statements":
        layer = stage.GetRootLayer()
        info = dict(prim.GetAssetInfo())
        words = [*_words(dict(layer.customLayerData)), *_words(info), *_words(dict(prim.GetCustomData()))]
        licences = [GivenLicence(text, name) for name, text in words if _LICENCE.search(name)]
        for where, text in (("comment", layer.comment), ("documentation", layer.documentation)):
            if _LICENCE.search(text):
                licences.append(GivenLicence(text.strip()[:_MOST_TEXT], where))
        labels = _labels(prim)
        category = _category(labels)
        others = (text for kind, text in labels if text != category and not _CODE.search(kind))
        description = next((text for name, text in words if name.lower() == "description"), "")
        return cls(
            name=str(info.get("name") or "")[:_MOST_TEXT],
            category=category.replace("_", " "),
            description=description,
            tags=tuple(dict.fromkeys(others)),
            author=next((text for name, text in words if _AUTHOR.match(name)), ""),
            url=next((text for name, text in words if _URL.match(name)), ""),
            licences=tuple(licences),
        )


def _words(values: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, str]]:
    """Texts of a nested dictionary with their names."""
    for name, value in values.items():
        if isinstance(value, str) and value.strip():
            yield str(name), value.strip()[:_MOST_TEXT]
        elif isinstance(value, dict) and depth < 8:
            yield from _words(value, depth + 1)


def _labels(root: Any) -> list[tuple[str, str]]:
    """Semantic labels of an asset, those of its root first: taxonomy and label."""
    found: list[tuple[str, str]] = []
    for prim in prims_of(root):
        for attribute in prim.GetAttributes():
            name = attribute.GetName()
            if name.startswith("semantics:labels:"):
                found += [(name.removeprefix("semantics:labels:"), str(label)) for label in attribute.Get() or ()]
            elif name.startswith("semantic:") and name.endswith(":params:semanticData"):
                kind = prim.GetAttribute(name.removesuffix("Data") + "Type")
                found.append((str(kind.Get() or "") if kind else "", str(attribute.Get() or "")))
    return [(kind, label.strip()[:_MOST_TEXT]) for kind, label in found if label.strip()]


def _category(labels: list[tuple[str, str]]) -> str:
    """The label of a class. Of several the one at the end of a hierarchy such as ``container/vessel/bottle``, else the first."""
    classes = [label for kind, label in labels if kind.lower() in _CLASSES]
    ends = {PurePosixPath(label).name for _, label in labels if "/" in label}
    return next((label for label in classes if label in ends), classes[0] if classes else "")


READER = UsdReader()
