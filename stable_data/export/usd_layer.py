"""Writing layers of OpenUSD: prims, attributes and materials, without composing a stage, which would take longer."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Vt

from stable_data.atomic_files import temporary_path
from stable_data.geometry.mesh import Mesh, unit_normals
from stable_data.geometry.shading import corner_normals
from stable_data.geometry.surface import Surface, index_surface
from stable_data.scene import FloatArray, QuatXyzw, Vec3

_ROUGHNESS = 0.6
_FLAT = 1e-12  # a face with a smaller area, share of the squared extent, is not written


def new_layer(default_prim: str, about: str, *, is_text: bool) -> Sdf.Layer:
    """Returns an empty layer: metres, kilograms, z up."""
    layer = Sdf.Layer.CreateAnonymous(".usda" if is_text else ".usdc")
    layer.defaultPrim, layer.documentation = default_prim, about
    for key, value in (("metersPerUnit", 1.0), ("kilogramsPerUnit", 1.0), ("upAxis", "Z")):
        layer.pseudoRoot.SetInfo(key, value)
    return layer


def write_layer(layer: Sdf.Layer, path: Path) -> None:
    """Writes a layer atomically; its folder must exist.

    Raises:
        OSError: The file cannot be written.
    """
    # The suffix of a file decides its format, so that the name stays the last part.
    temporary = temporary_path(path).with_suffix(".usda" if layer.GetFileFormat().formatId == "usda" else ".usdc")
    try:
        if not layer.Export(str(temporary)):
            raise OSError(f"{path}: the layer cannot be written")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def add_prim(
    parent: Sdf.PrimSpec | Sdf.Layer, name: str, type_name: str = "", schemas: Sequence[str] = (), *, is_over: bool = False
) -> Sdf.PrimSpec:
    """Adds a prim with applied schemas."""
    specifier = Sdf.SpecifierOver if is_over else Sdf.SpecifierDef
    prim = Sdf.PrimSpec(parent, name, specifier, type_name)
    if schemas:
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=list(schemas)))
    return prim


def put(prim: Sdf.PrimSpec, type_name: str, values: Mapping[str, Any], *, is_uniform: bool = False) -> None:
    """Sets attributes of one type, given as in a text file, such as ``float`` or ``token[]``."""
    kind = Sdf.ValueTypeNames.Find(type_name)
    variability = Sdf.VariabilityUniform if is_uniform else Sdf.VariabilityVarying
    for name, value in values.items():
        Sdf.AttributeSpec(prim, name, kind, variability).default = value


def place(prim: Sdf.PrimSpec, position: Vec3, quat_xyzw: QuatXyzw) -> None:
    """Gives a prim a pose, metres."""
    x, y, z, w = quat_xyzw
    put(prim, "double3", {"xformOp:translate": Gf.Vec3d(*position)})
    put(prim, "quatd", {"xformOp:orient": Gf.Quatd(w, x, y, z)})
    put(prim, "token[]", {"xformOpOrder": Vt.TokenArray(["xformOp:translate", "xformOp:orient"])}, is_uniform=True)


def relate(prim: Sdf.PrimSpec, name: str, target: Sdf.Path) -> None:
    """Sets a relationship to one prim."""
    Sdf.RelationshipSpec(prim, name, custom=False).targetPathList.explicitItems = [target]


def label(prim: Sdf.PrimSpec, taxonomy: str, words: Sequence[str]) -> None:
    """Sets the semantic labels of a taxonomy; the schema must be applied."""
    put(prim, "token[]", {f"semantics:labels:{taxonomy}": Vt.TokenArray(list(words))})


def add_collider(parent: Sdf.PrimSpec, name: str, part: Mesh) -> Sdf.PrimSpec:
    """Adds a convex part, metres, that collides and is not drawn."""
    prim = add_prim(parent, name, "Mesh", ("PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"))
    put(prim, "token", {"physics:approximation": "convexHull", "purpose": "guide"}, is_uniform=True)
    normals = np.repeat(unit_normals(part.triangles)[0], 3, axis=0)
    _put_mesh(prim, part.vertices, part.faces, normals, is_smooth=False)
    return prim


def add_box_collider(parent: Sdf.PrimSpec, name: str, low: FloatArray, high: FloatArray) -> Sdf.PrimSpec:
    """Adds a box between two corners, (3,) each, metres, that collides and is not drawn."""
    prim = add_prim(parent, name, "Cube", ("PhysicsCollisionAPI",))
    put(prim, "token", {"purpose": "guide"}, is_uniform=True)
    put(prim, "double", {"size": 1.0})
    put(prim, "float3[]", {"extent": Vt.Vec3fArray([Gf.Vec3f(-0.5), Gf.Vec3f(0.5)])})
    put(prim, "double3", {"xformOp:translate": Gf.Vec3d(*((low + high) / 2).tolist())})
    put(prim, "float3", {"xformOp:scale": Gf.Vec3f(*(high - low).tolist())})
    put(prim, "token[]", {"xformOpOrder": Vt.TokenArray(["xformOp:translate", "xformOp:scale"])}, is_uniform=True)
    return prim


class Materials:
    """The materials below one prim, each once.

    Args:
        owner: The prim below which they are.
        textures: Where images lie: their folder, relative to the layer.
    """

    def __init__(self, owner: Sdf.PrimSpec, textures: str) -> None:
        self._scope = add_prim(owner, "Looks", "Scope")
        self._textures = textures
        self._known: dict[tuple[Any, ...], Sdf.Path] = {}

    def of(self, surface: Surface, image: str | None, made_of: str) -> Sdf.Path:
        """Returns the material of a surface.

        Args:
            surface: The surface.
            image: Name of the file of its image; None without one.
            made_of: Name of what it is made of, as a semantic label.
        """
        colour = np.array(surface.colour or (1.0, 1.0, 1.0))
        has_corners = surface.corner_colours is not None
        if has_corners and image is not None:
            assert surface.corner_colours is not None
            colour, has_corners = colour * surface.corner_colours.mean(axis=(0, 1)), False
        # Corners carry their whole colour, see add_surface: a material has no product of two colours.
        shade = None if has_corners else tuple(np.round(colour, 6).tolist())
        key = (image, shade, round(surface.opacity, 6), surface.has_alpha and image is not None, made_of)
        if key not in self._known:
            self._known[key] = self._add(f"material_{len(self._known)}", *key)
        return self._known[key]

    def _add(
        self, name: str, image: str | None, shade: tuple[float, ...] | None, opacity: float, has_alpha: bool, made_of: str
    ) -> Sdf.Path:
        material = add_prim(self._scope, name, "Material", ("SemanticsLabelsAPI:material",))
        label(material, "material", [made_of])
        surface = add_prim(material, "Surface", "Shader")
        put(surface, "token", {"info:id": "UsdPreviewSurface"}, is_uniform=True)
        put(surface, "float", {"inputs:roughness": _ROUGHNESS, "inputs:metallic": 0.0})
        put(surface, "token", {"outputs:surface": None})
        _connect(material, "token", "outputs:surface", surface.path.AppendProperty("outputs:surface"))
        if image is not None:
            texture = self._add_texture(material, image, shade or (1.0, 1.0, 1.0), opacity)
            _connect(surface, "color3f", "inputs:diffuseColor", texture.path.AppendProperty("outputs:rgb"))
            if has_alpha:
                _connect(surface, "float", "inputs:opacity", texture.path.AppendProperty("outputs:a"))
        elif shade is None:
            reader = _add_reader(material, "Colours", "UsdPrimvarReader_float3", "displayColor", "float3")
            _connect(surface, "color3f", "inputs:diffuseColor", reader.path.AppendProperty("outputs:result"))
        else:
            put(surface, "color3f", {"inputs:diffuseColor": Gf.Vec3f(*shade)})
        if opacity < 1 and not has_alpha:
            put(surface, "float", {"inputs:opacity": opacity})
        return material.path

    def _add_texture(self, material: Sdf.PrimSpec, image: str, shade: tuple[float, ...], opacity: float) -> Sdf.PrimSpec:
        reader = _add_reader(material, "Coordinates", "UsdPrimvarReader_float2", "st", "float2")
        texture = add_prim(material, "Texture", "Shader")
        put(texture, "token", {"info:id": "UsdUVTexture"}, is_uniform=True)
        put(texture, "asset", {"inputs:file": Sdf.AssetPath(f"./{self._textures}/{image}")})
        put(texture, "token", {"inputs:sourceColorSpace": "sRGB", "inputs:wrapS": "repeat", "inputs:wrapT": "repeat"})
        put(texture, "float4", {"inputs:scale": Gf.Vec4f(*shade, opacity)})
        _connect(texture, "float2", "inputs:st", reader.path.AppendProperty("outputs:result"))
        put(texture, "float3", {"outputs:rgb": None})
        put(texture, "float", {"outputs:a": None})
        return texture


def _add_reader(material: Sdf.PrimSpec, name: str, kind: str, primvar: str, type_name: str) -> Sdf.PrimSpec:
    reader = add_prim(material, name, "Shader")
    put(reader, "token", {"info:id": kind}, is_uniform=True)
    put(reader, "string", {"inputs:varname": primvar})
    put(reader, type_name, {"outputs:result": None})
    return reader


def _connect(prim: Sdf.PrimSpec, type_name: str, name: str, source: Sdf.Path) -> None:
    attribute = Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Find(type_name))
    attribute.connectionPathList.explicitItems = [source]


def add_surface(parent: Sdf.PrimSpec, name: str, surface: Surface, material: Sdf.Path) -> Sdf.PrimSpec | None:
    """Adds what is seen, metres, with its material; returns None if no triangle has an area."""
    triangles = surface.triangles
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    is_seen = areas > _FLAT * extent**2
    if not is_seen.any():
        return None
    shown = Surface(
        triangles[is_seen],
        surface.colour,
        None if surface.corner_colours is None else surface.corner_colours[is_seen],
        surface.image,
        None if surface.corner_uv is None else surface.corner_uv[is_seen],
    )
    indexed = index_surface(shown, normals=corner_normals(shown.triangles))
    # In single precision two corners of a narrow face can be one.
    a, b, c = indexed.faces.T
    faces = indexed.faces[(a != b) & (b != c) & (c != a)]
    if not len(faces):
        return None
    # MuJoCo asks for the volume of every mesh, also of one that is only seen, unless it is a shell.
    prim = add_prim(parent, name, "Mesh", ("MaterialBindingAPI", "NewtonMassAPI"))
    put(prim, "token", {"newton:massModel": "shell"}, is_uniform=True)
    assert indexed.normals is not None
    _put_mesh(prim, indexed.points, faces, indexed.normals, is_smooth=True)
    put(prim, "bool", {"doubleSided": True}, is_uniform=True)
    if indexed.uv is not None:
        uv = np.stack([indexed.uv[:, 0], 1 - indexed.uv[:, 1]], axis=1)  # the format counts from below
        put(prim, "texCoord2f[]", {"primvars:st": Vt.Vec2fArray.FromNumpy(uv.astype(np.float32))})
        prim.attributes["primvars:st"].SetInfo("interpolation", "vertex")
    base = np.array(surface.colour or (1.0, 1.0, 1.0), np.float32)
    colours = base[None] if indexed.colours is None else indexed.colours * base
    put(prim, "color3f[]", {"primvars:displayColor": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colours, np.float32))})
    if indexed.colours is not None:
        prim.attributes["primvars:displayColor"].SetInfo("interpolation", "vertex")
    relate(prim, "material:binding", material)
    return prim


def _put_mesh(prim: Sdf.PrimSpec, vertices: Any, faces: Any, normals: Any, *, is_smooth: bool) -> None:
    points = np.ascontiguousarray(vertices, np.float32)
    corners = np.ascontiguousarray(faces, np.int32)
    put(prim, "token", {"subdivisionScheme": "none"}, is_uniform=True)
    put(prim, "int[]", {"faceVertexCounts": Vt.IntArray.FromNumpy(np.full(len(corners), 3, np.int32))})
    put(prim, "int[]", {"faceVertexIndices": Vt.IntArray.FromNumpy(corners.ravel())})
    put(prim, "point3f[]", {"points": Vt.Vec3fArray.FromNumpy(points)})
    put(prim, "normal3f[]", {"normals": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32))})
    prim.attributes["normals"].SetInfo("interpolation", "vertex" if is_smooth else "faceVarying")
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    put(prim, "float3[]", {"extent": Vt.Vec3fArray.FromNumpy(extent)})
