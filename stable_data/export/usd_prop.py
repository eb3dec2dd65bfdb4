"""SimReady packages of OpenUSD: a folder for each prop, by the rules of the profile Robotics-Prop.

A package::

    <prop>/usd/<prop>.usd                          geometry, colliders, mass, materials; the default prim is the body
    <prop>/usd/textures/<content>.png              images
    <prop>/usd/.thumbs/256x256/<prop>.usd.png      a picture, where the machine can render
"""

import hashlib
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from pxr import Gf, Kind, Sdf, Vt

from stable_data.assets.store import AssetStore
from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError
from stable_data.export.mesh_files import png_file
from stable_data.export.props import MassDistribution, Prop, prop_mass, prop_parts, prop_surfaces
from stable_data.export.usd_layer import (
    Materials,
    add_collider,
    add_prim,
    add_surface,
    label,
    new_layer,
    put,
    relate,
    write_layer,
)
from stable_data.geometry.images import texture_pixels
from stable_data.geometry.surface import Surface
from stable_data.scene import Vec3
from stable_data.simulation.render import render_surfaces
from stable_data.simulation.settling import PhysicsOptions

TEXTURE_FOLDER = "textures"
GEOMETRY = "Geometry"
"""Name of the prim below a body that has all of its shapes; its scale is the size relative to the prop."""

BODY_SCHEMAS = ("PhysicsRigidBodyAPI", "PhysicsMassAPI")
"""Schemas of a body that moves."""

QCODE = "Q223557"
"""Physical object, in the Wikidata: the narrowest class that is sure for every asset."""

_UNKNOWN = "unknown"
_THUMBNAIL = (256, 256)  # pixels


def package_path(prop: Prop) -> Path:
    """Returns the main file of a prop, relative to the folder of the packages."""
    return Path(prop.name) / "usd" / f"{prop.name}.usd"


def write_package(prop: Prop, store: AssetStore, folder: Path) -> None:
    """Writes the package of a prop, if it does not exist; its main file is written last.

    Args:
        prop: The prop.
        store: Its meshes.
        folder: The folder of the packages.

    Raises:
        MeshError: None of its convex parts is solid.
        OSError: The folder cannot be written.
    """
    path = folder / package_path(prop)
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    surfaces, parts = prop_surfaces(prop, store), prop_parts(prop, store)
    mass, friction = prop_mass(prop, store)
    layer = new_layer(prop.name, f"{prop.category}, a prop of stable-data", is_text=False)
    body = add_prim(layer, prop.name, "Xform", (*BODY_SCHEMAS, "SemanticsLabelsAPI:class", "SemanticsLabelsAPI:wikidata_qcode"))
    body.kind = Kind.Tokens.component
    label(body, "class", [prop.category])
    label(body, "wikidata_qcode", [QCODE])
    put_mass(body, mass)
    geometry = add_prim(body, GEOMETRY, "Xform")
    put(geometry, "float3", {"xformOp:scale": Gf.Vec3f(1.0)})
    put(geometry, "token[]", {"xformOpOrder": Vt.TokenArray(["xformOp:scale"])}, is_uniform=True)
    colliders = add_prim(geometry, "Colliders", "Xform", ("MaterialBindingAPI",))
    for number, part in enumerate(parts):
        add_collider(colliders, f"part_{number}", part)
    contact = add_physics_material(body, "PhysicsMaterial", friction)
    relate(colliders, "material:binding:physics", contact)
    add_surfaces(add_prim(geometry, "Visuals", "Xform"), body, surfaces, path.parent / TEXTURE_FOLDER, _UNKNOWN)
    annotation = prop.annotation
    layer.customLayerData = {
        "SimReady_Metadata": {
            "asset_name": prop.name,
            "asset_type": "prop",
            "author": _said(None if annotation is None else annotation.raw.get("author")),
            "asset_license": _said(None if annotation is None else annotation.licence),
            "category": prop.category or _UNKNOWN,
            "source_file": _said(prop.asset_id if annotation is None else annotation.raw.get("source_url") or prop.asset_id),
            "usd_date_generated": _today(),
            "qcode": QCODE,
            "rigid_body_count": 1,
            "asset_extents": Gf.Vec3f(*prop.size),
            "mass": mass.mass,
        }
    }
    thumbnail = path.parent / ".thumbs" / "256x256" / f"{path.name}.png"
    thumbnail.parent.mkdir(parents=True, exist_ok=True)
    if (picture := _picture(surfaces)) is not None:
        write_file_atomically(thumbnail, picture)
    write_layer(layer, path)


def put_mass(body: Sdf.PrimSpec, mass: MassDistribution) -> None:
    """Sets the mass of a body and how it is distributed."""
    x, y, z, w = mass.axes_quat_xyzw
    put(body, "float", {"physics:mass": mass.mass})
    put(body, "point3f", {"physics:centerOfMass": Gf.Vec3f(*mass.center_of_mass)})
    put(body, "float3", {"physics:diagonalInertia": Gf.Vec3f(*mass.moments)})
    put(body, "quatf", {"physics:principalAxes": Gf.Quatf(w, x, y, z)})


def add_physics_material(parent: Sdf.PrimSpec, name: str, friction: Vec3 | None) -> Sdf.Path:
    """Adds a material with the friction of contacts; None: that of the stability verdict."""
    material = add_prim(parent, name, "Material", ("PhysicsMaterialAPI", "SemanticsLabelsAPI:material"))
    label(material, "material", [_UNKNOWN])
    slide = (PhysicsOptions().friction if friction is None else friction)[0]
    put(material, "float", {f"physics:{kind}": slide for kind in ("staticFriction", "dynamicFriction")})
    put(material, "float", {"physics:restitution": 0.0})
    return material.path


def add_surfaces(parent: Sdf.PrimSpec, owner: Sdf.PrimSpec, surfaces: Sequence[Surface], textures: Path, made_of: str) -> None:
    """Adds what is seen, with materials below ``owner``, and writes the images.

    Raises:
        OSError: An image cannot be written.
    """
    materials = Materials(owner, TEXTURE_FOLDER)
    for number, surface in enumerate(surfaces):
        image = None if surface.image is None or surface.corner_uv is None else put_image(surface.image, textures)
        add_surface(parent, f"surface_{number}", surface, materials.of(surface, image, made_of))


def put_image(content: bytes, folder: Path) -> str:
    """Writes an image as PNG under a hash of its content, if it does not exist, and returns its name.

    MuJoCo reads no JPEG.
    """
    name = f"{hashlib.sha256(content).hexdigest()[:24]}.png"
    if not (folder / name).exists():
        folder.mkdir(parents=True, exist_ok=True)
        is_png = content.startswith(b"\x89PNG")
        write_file_atomically(folder / name, content if is_png else png_file(texture_pixels(content)))
    return name


def _picture(surfaces: Sequence[Surface]) -> bytes | None:
    try:
        picture = render_surfaces(surfaces, _THUMBNAIL)
    except ConfigError:  # this machine cannot render
        return None
    return png_file(picture)


def _said(text: object) -> str:
    return " ".join(str(text).split()) if text else _UNKNOWN


def _today() -> str:
    """The date, which the profile asks for; SOURCE_DATE_EPOCH fixes it, so that equal packages are equal bytes."""
    seconds = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.now(UTC) if seconds is None else datetime.fromtimestamp(int(seconds), UTC)
    return now.date().isoformat()
