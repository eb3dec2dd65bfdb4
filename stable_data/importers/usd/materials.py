"""Materials of a composed USD stage: UsdPreviewSurface, and what Omniverse's and MaterialX's surfaces have in common with it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stable_data.scene import FloatArray, Vec3

_CONTEXTS = ("", "mdl", "mtlx")  # of renderers whose surfaces are looked at
_COLOURS = ("diffuseColor", "diffuse_color_constant", "base_color", "baseColor", "base_color_factor")
_TEXTURES = ("diffuse_texture", "base_color_texture", "baseColor_texture", "albedo_texture", "BaseColor_Texture")
_FILES = ("file", "texture", "filename")
_OPACITIES = ("opacity", "opacity_constant")
_MOST_SHADERS = 16  # in a row


@dataclass(frozen=True, slots=True, eq=False)
class UsdMaterial:
    """The look of a surface.

    Attributes:
        colour: Linear base colour; multiplies the texture. None if the material states none.
        opacity: From 0 to 1.
        texture: Key of an image (:meth:`stable_data.importers.usd.layers.LayerLoader.read_file`); empty for none.
        coordinates: Name of the primvar with its coordinates.
        placement: Matrix (2, 3) that is applied to them, from the lower left.
        corner_colours: Name of the primvar whose colours are the base colour; empty for none.
    """

    colour: Vec3 | None = None
    opacity: float = 1.0
    texture: str = ""
    coordinates: str = "st"
    placement: FloatArray | None = None
    corner_colours: str = ""


def material_of(prim: Any) -> UsdMaterial | None:
    """The material that is bound to a prim or subset; None if there is none that has a surface."""
    from pxr import UsdShade

    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    if not material:
        return None
    for context in _CONTEXTS:
        shader, _, _ = material.ComputeSurfaceSource(context)
        if shader:
            return _surface(shader)
    return None


def _surface(shader: Any) -> UsdMaterial:
    found = UsdMaterial()
    for name in _COLOURS:
        value, source = _input(shader, name)
        if source is not None:
            found = _textured(found, source)
        elif (colour := _colour(value)) is not None:
            found = replace(found, colour=colour)
        if value is not None or source is not None:
            break
    for name in _TEXTURES:
        value, source = _input(shader, name)
        if source is not None:
            found = _textured(found, source)
        elif (path := _file(value)) and not found.texture:
            # Omniverse's surfaces: the texture replaces the constant colour, and the tint multiplies it.
            found = replace(found, texture=path, colour=_colour(_input(shader, "diffuse_tint")[0]))
    is_opaque = _input(shader, "enable_opacity")[0] is False
    for name in () if is_opaque else _OPACITIES:
        value, _ = _input(shader, name)
        if isinstance(value, (int, float)):
            found = replace(found, opacity=float(np.clip(value, 0, 1)))
    return found


def _textured(material: UsdMaterial, shader: Any) -> UsdMaterial:
    """A material whose colour comes from another shader: an image, or colours of corners."""
    for _ in range(_MOST_SHADERS):
        kind = str(shader.GetIdAttr().Get() or "")
        if kind.startswith("UsdPrimvarReader"):
            return replace(material, corner_colours=_word(_input(shader, "varname")[0]))
        for name in _FILES:
            if path := _file(_input(shader, name)[0]):
                coordinates, placement = _coordinates(shader)
                scale = _input(shader, "scale")[0]
                return replace(
                    material,
                    texture=path,
                    colour=material.colour if scale is None else _colour(scale),
                    coordinates=coordinates or material.coordinates,
                    placement=placement,
                )
        sources = [source for port in shader.GetInputs() if (source := _input(shader, port.GetBaseName())[1]) is not None]
        if not sources:
            break
        shader = sources[0]
    return material


def _coordinates(shader: Any) -> tuple[str, FloatArray | None]:
    """The primvar that a texture takes its coordinates from, and the matrix (2, 3) on the way."""
    placement: FloatArray | None = None
    _, source = _input(shader, "st")
    for _ in range(_MOST_SHADERS):
        if source is None:
            return "", placement
        kind = str(source.GetIdAttr().Get() or "")
        if kind.startswith("UsdPrimvarReader"):
            return _word(_input(source, "varname")[0]), placement
        if kind != "UsdTransform2d":
            return "", placement
        own = _placement(source)
        placement = own if placement is None else np.column_stack([placement[:, :2] @ own[:, :2], placement @ [*own[:, 2], 1]])
        _, source = _input(source, "in")
    return "", placement


def _placement(shader: Any) -> FloatArray:
    """The matrix (2, 3) of a ``UsdTransform2d``: scale, then rotation, then translation."""
    scale, turn, shift = (_input(shader, name)[0] for name in ("scale", "rotation", "translation"))
    angle = np.radians(float(turn or 0.0))
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    factors = np.array([1.0, 1.0] if scale is None else [float(scale[0]), float(scale[1])])
    moved = np.array([0.0, 0.0] if shift is None else [float(shift[0]), float(shift[1])])
    return np.column_stack([rotation * factors, moved])


def _input(shader: Any, name: str) -> tuple[Any, Any]:
    """What feeds an input of a shader: a value, or another shader; both None without either."""
    from pxr import UsdShade

    port = shader.GetInput(name)
    if not port:
        return None, None
    for attribute in UsdShade.Utils.GetValueProducingAttributes(port):
        if UsdShade.Output.IsOutput(attribute):
            return None, UsdShade.Shader(attribute.GetPrim())
        return attribute.Get(), None
    return None, None


def _colour(value: Any) -> Vec3 | None:
    """A colour of three or four finite numbers, kept from 0 to 1; None for other values."""
    try:
        red, green, blue = (float(np.clip(part, 0, 1)) for part in list(value)[:3])
    except (TypeError, ValueError):
        return None
    return (red, green, blue) if np.isfinite([red, green, blue]).all() else None


def _file(value: Any) -> str:
    return str(value.path) if hasattr(value, "path") else ""


def _word(value: Any) -> str:
    return value if isinstance(value, str) else ""
