"""Pictures of scenes, rendered off screen, and contact sheets.

The camera follows the rule of the format: it looks at the centre of objects and table through a 50 mm lens on a 36 mm sensor,
at 1.5 times the largest dimension. It is farther away if near corners would be cut off. For pictures that are wider than high
it is nearer, by the ratio of width to height.
"""

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal, TypeAlias

import fast_simplification
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFilter, ImageFont
from scipy.spatial.transform import Rotation

from stable_data.errors import ConfigError
from stable_data.geometry.images import decode_png
from stable_data.geometry.mesh import Mesh, area_vectors
from stable_data.geometry.mesh_colors import Paint
from stable_data.geometry.shading import CREASE
from stable_data.geometry.surface import Surface
from stable_data.rotations import wxyz, yaw_quat
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from stable_data.simulation.look_meshes import ObjectLook, add_look_material, look_meshes
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.offscreen import Picture, draw_model
from stable_data.simulation.room import TABLE_THICKNESS, RoomPart, Surroundings, furnish

FRONT_SIZE = (512, 512)
"""Width and height of ``front.png`` in the MesaTask-10K format, pixels."""

View: TypeAlias = Literal["front", "perspective", "top", "left"]

_DIRECTIONS: Mapping[str, Vec3] = {
    "front": (0.0, -1.0, 0.6),
    "perspective": (-0.7, -0.7, 0.7),
    "top": (0.0, 0.0, 1.0),
    "left": (-1.0, 0.0, 0.3),
}
_HALF_VIEW = 18 / 50  # tangent of half the field of view: 36 mm sensor, 50 mm lens
FIELD_OF_VIEW = float(np.degrees(2 * np.arctan(_HALF_VIEW)))
"""Vertical field of view of the cameras, degrees."""
_DISTANCE, _MARGIN = 1.5, 1.02
_UNDER = 0.5  # rise of the view below a ceiling, as a share of the rise to the ceiling's front edge from the table's back edge
_SKY = ((0.93, 0.95, 0.97), (0.80, 0.83, 0.87))
_LIT_FLOOR, _BLACK = (0.708, 0.708, 0.7), (0.0, 0.0, 0.0)  # the first is what a plain floor looks like: no horizon is seen
_BACKGROUNDS: Mapping[Surroundings, tuple[Vec3, Vec3]] = {
    "room": _SKY,
    "floor": (_LIT_FLOOR, _LIT_FLOOR),
    "none": (_BLACK, _BLACK),
}
_MAX_FACES = 6000  # a mesh with more faces is simplified for a picture

PALETTE: tuple[str, ...] = (
    "#d1495b", "#edae49", "#3f88c5", "#66a182", "#8d6b94", "#e07a5f", "#457b9d", "#84a98c", "#f2cc8f", "#b56576",
    "#6d9dc5", "#c97c5d", "#7fb7be", "#a3b18a", "#e9c46a", "#9c89b8",
)  # fmt: skip
"""Colours of the categories that have none in OWN_COLOURS, chosen by a hash of the name."""

OWN_COLOURS: Mapping[str, str] = {
    "apple": "#c8323c", "banana": "#f2d14b", "bowl": "#dfe6ea", "bread": "#c58a4a", "crate": "#b98a56", "basket": "#c9a26b",
    "cutting_board": "#cfa06a", "knife": "#8d99a6", "laptop": "#5c6670", "lemon": "#f4de4e", "orange": "#f08a24",
    "plate": "#ece7da", "saucepan": "#8a949e", "soap": "#f3c9d0", "spoon": "#aab4bd", "tray": "#8f6a48", "mirror": "#b9d3df",
    "candle": "#f6ecd2", "box": "#cda777", "can": "#b5484b", "toothbrush": "#3fa7a0",
}  # fmt: skip
"""Colours of categories with a well-known colour."""


def render_scene(
    scene: Scene,
    meshes: Sequence[Mesh | None],
    *,
    size: tuple[int, int] = FRONT_SIZE,
    view: View = "front",
    colors: Sequence[str | Paint] | None = None,
    looks: Sequence[ObjectLook | None] | None = None,
    support: ObjectLook | None = None,
    surroundings: Surroundings = "room",
) -> Picture:
    """Renders a picture of a scene.

    Args:
        scene: The scene.
        meshes: Mesh of each object, metres, yaw frame, centred on its box; for None a transparent box is drawn.
        size: Width and height, pixels; by default those of the format's ``front.png``.
        view: The side from which the camera looks.
        colors: Colour of each object, or of its faces; by default the category's colour, a little lighter or darker for each
            asset.
        looks: What is seen of each object with a mesh, with its textures; for None its colour.
        support: What is seen of the support on which the table lies, in the scene's frame; fixed objects are then not drawn.
        surroundings: What is around the table.

    Raises:
        ConfigError: The machine cannot render (``no_gl``), or the view is not known (``unknown_view``).
    """
    if view not in _DIRECTIONS:
        raise ConfigError(f"view is {view!r}, expected one of {sorted(_DIRECTIONS)}", "unknown_view")
    chosen: list[str | Paint] = [object_colour(o) for o in scene.objects] if colors is None else list(colors)
    spec = mujoco.MjSpec()
    set_lighting(spec, size, _BACKGROUNDS[surroundings])
    given = [None] * len(scene.objects) if looks is None else looks
    is_seen = [support is None or o.instance not in scene.fixed for o in scene.objects]
    for k, (o, mesh, paint, look) in enumerate(zip(scene.objects, meshes, chosen, given, strict=True)):
        if is_seen[k] and (mesh is None or look is None or not _add_look(spec, look, f"object_{k}", o.position, o.yaw)):
            _add_object(spec, o, mesh, paint, k)
    shown = replace(scene, objects=tuple(itertools.compress(scene.objects, is_seen)))
    low, high = scene_bounds(shown, list(itertools.compress(meshes, is_seen)))
    if support is not None:
        _add_look(spec, support, "support")
    add_room(spec, furnish(scene.table, low, high, None if support is None else support.bounds, surroundings))
    add_lights(spec, low, high)
    add_camera(spec, low, high, view, size, scene.table)
    return _with_soft_shadows(*draw_model(spec.compile(), "view", size))


def render_surfaces(surfaces: Sequence[Surface], size: tuple[int, int]) -> Picture:
    """Renders a picture of surfaces alone, without shadows.

    Args:
        surfaces: At least one triangle, metres, z up.
        size: Width and height, pixels.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
        MeshError: An image cannot be decoded.
    """
    spec, look = mujoco.MjSpec(), ObjectLook(tuple(surfaces), (1.0, 1.0, 1.0), UPRIGHT, (0.0, 0.0, 0.0))
    set_lighting(spec, size)
    _add_look(spec, look, "look")
    low, high = look.bounds
    add_lights(spec, low, high)
    for light in spec.worldbody.lights:
        light.castshadow = False
    add_camera(spec, low, high, "perspective", size)
    return draw_model(spec.compile(), "view", size)[0]


def category_colour(category: str) -> str:
    """Returns the colour of a category, ``#rrggbb``, the same in every scene."""
    if category in OWN_COLOURS:
        return OWN_COLOURS[category]
    return PALETTE[hashlib.sha256(category.encode()).digest()[0] % len(PALETTE)]


def object_colour(o: SceneObject) -> str:
    """Returns the colour of an object's category, ``#rrggbb``, shaded so that the assets of a category can be distinguished."""
    share = hashlib.sha256((o.asset_id or "").encode()).digest()[0] / 255
    red, green, blue, _ = rgba(category_colour(o.category))
    shaded = (min(255, round(255 * (0.84 + 0.26 * share) * channel)) for channel in (red, green, blue))
    return "#" + "".join(f"{channel:02x}" for channel in shaded)


def scene_bounds(scene: Scene, meshes: Sequence[Mesh | None]) -> tuple[FloatArray, FloatArray]:
    """Computes the lowest and highest corner of objects and table, (3,) float64 each, metres, world frame."""
    corners = [np.array([[0.0, 0.0, -TABLE_THICKNESS], [*scene.table.size_xy, 0.0]])]
    for o, mesh in zip(scene.objects, meshes, strict=True):
        half = np.asarray(o.size) / 2 if mesh is None else np.abs(mesh.vertices).max(axis=0)
        # Any yaw fits into the circle around the box.
        reach = np.array([np.hypot(half[0], half[1])] * 2 + [half[2]])
        corners.append(np.array([o.position - reach, o.position + reach]))
    every = np.concatenate(corners)
    return every.min(axis=0), every.max(axis=0)


def contact_sheet(images: Sequence[Picture], labels: Sequence[str], columns: int) -> Picture:
    """Arranges pictures in rows, each with its label below.

    Args:
        images: Pictures of one size.
        labels: One for each picture.
        columns: Pictures in a row.

    Raises:
        ConfigError: There is no picture, or their sizes differ (``invalid_sheet``).
    """
    if not images or columns < 1 or len({image.shape for image in images}) > 1:
        raise ConfigError(
            f"a sheet of {len(images)} pictures in {columns} columns, expected pictures of one size", "invalid_sheet"
        )
    height, width, _ = images[0].shape
    strip, gap = max(16, height // 14), max(2, width // 64)
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + strip + gap) + gap), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=strip * 0.62)
    for k, (image, label) in enumerate(zip(images, labels, strict=True)):
        x, y = gap + k % columns * (width + gap), gap + k // columns * (height + strip + gap)
        sheet.paste(Image.fromarray(image), (x, y))
        draw.text((x + width / 2, y + height + strip / 2), label, fill="#333333", font=font, anchor="mm")
    return np.asarray(sheet)


def set_lighting(spec: mujoco.MjSpec, size: tuple[int, int], background: tuple[Vec3, Vec3] = _SKY) -> None:
    """Sets background, buffers and quality for pictures.

    Args:
        spec: The description to set them in.
        size: Width and height of the pictures, pixels.
        background: Its colour above and below the horizon, shares of red, green and blue.
    """
    above, below = background
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=list(above), rgb2=list(below), width=64, height=384,
    )  # fmt: skip
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = size
    # A shadow map costs a CPU as much as a picture; two of its points for each pixel of a row are enough.
    visual.quality.shadowsize, visual.quality.offsamples = min(2048, max(256, 2 * max(size))), 4
    visual.headlight.ambient, visual.headlight.diffuse, visual.headlight.specular = [0.34] * 3, [0.18] * 3, [0.0] * 3
    # The offset of shadows from surfaces is a share of the depth range: with zfar 200 some floors had specks of shadow.
    visual.map.znear, visual.map.zfar = 0.01, 1500.0
    visual.map.shadowclip = 0.8  # in extents: half the width of the shadow map


def add_room(spec: mujoco.MjSpec, parts: Sequence[RoomPart], visual: mujoco.MjsDefault | None = None) -> None:
    """Adds a table and its room, which nothing collides with.

    Args:
        spec: The description to add them to.
        parts: What is seen.
        visual: The class of the geoms that are only visible, if the description has one.
    """
    for part in parts:
        surface, material = part.surface, spec.add_material(name=part.name)
        material.specular, material.shininess = part.material.gloss, 0.4 + 0.5 * part.material.gloss
        material.emission = part.material.glow
        corners = np.arange(surface.triangles.size // 3, dtype=np.int32)
        mesh = spec.add_mesh(
            name=part.name, uservert=surface.triangles.ravel(), userface=corners, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        )  # fmt: skip
        if surface.image is None or surface.corner_uv is None:
            material.rgba = rgba(part.material.colour)
        else:
            pixels = _pixels(surface.image)
            if spec.texture(part.material.name) is None:
                texture = spec.add_texture(name=part.material.name, type=mujoco.mjtTexture.mjTEXTURE_2D)
                texture.height, texture.width, texture.nchannel = pixels.shape
                texture.data = pixels.tobytes()
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = part.material.name
            mesh.usertexcoord, mesh.userfacetexcoord = surface.corner_uv.ravel(), corners
        geom = spec.worldbody.add_geom(
            visual or spec.default, name=part.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=part.name, material=part.name
        )
        geom.contype = geom.conaffinity = 0


_pixels = lru_cache(maxsize=64)(decode_png)


def _add_box(spec: mujoco.MjSpec, centre: Vec3, half: Vec3, rgba: list[float], yaw: float = 0.0) -> None:
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=list(centre),
        size=list(half),
        quat=wxyz(yaw_quat(yaw)),
        rgba=rgba,
        contype=0,
        conaffinity=0,
    )


def _add_object(spec: mujoco.MjSpec, o: SceneObject, mesh: Mesh | None, paint: str | Paint, index: int) -> None:
    parts = _coloured_parts(mesh, paint) if mesh is not None else []
    if not parts:
        colour = paint if isinstance(paint, str) else object_colour(o)
        x, y, z = (max(side / 2, 1e-4) for side in o.size)
        _add_box(spec, o.position, (x, y, z), rgba(colour, 0.45), o.yaw)
    for k, (colour, vertices, normals) in enumerate(parts):
        name, corners = f"object_{index}_{k}", np.arange(len(vertices), dtype=np.int32)
        spec.add_mesh(
            name=name, uservert=vertices.ravel(), usernormal=normals.ravel(), userface=corners, userfacenormal=corners,
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )  # fmt: skip
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=list(o.position), quat=wxyz(yaw_quat(o.yaw)), rgba=rgba(colour),
            contype=0, conaffinity=0,
        )  # fmt: skip


def _add_look(spec: mujoco.MjSpec, look: ObjectLook, prefix: str, position: Vec3 = (0.0, 0.0, 0.0), yaw: float = 0.0) -> bool:
    """Adds what is seen of an object at a pose; returns whether there is anything."""
    turn = Rotation.from_quat(look.tilt_quat_xyzw).as_matrix() * look.scale
    found = look_meshes(look.surfaces)
    for k, mesh in enumerate(found):
        name, corners = f"{prefix}_{k}", np.arange(3 * len(mesh.faces), dtype=np.int32)
        triangles = (mesh.vertices @ turn.T + look.offset)[mesh.faces]
        uv = {} if mesh.corner_uv is None else {"usertexcoord": mesh.corner_uv.ravel(), "userfacetexcoord": corners}
        spec.add_mesh(
            name=name, uservert=triangles.ravel(), userface=corners,
            usernormal=_corner_normals(mesh.faces, area_vectors(triangles)).ravel(), userfacenormal=corners,
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, **uv,
        )  # fmt: skip
        dress = {"rgba": list(mesh.rgba)} if mesh.pixels is None else {"material": add_look_material(spec, mesh, name)}
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=list(position), quat=wxyz(yaw_quat(yaw)), contype=0,
            conaffinity=0, **dress,
        )  # fmt: skip
    return bool(found)


def _coloured_parts(mesh: Mesh, paint: str | Paint) -> list[tuple[str, FloatArray, FloatArray]]:
    """Colour, corners and normals of each single-coloured part of a mesh; empty if no face is visible."""
    pairs = [(paint, mesh)] if isinstance(paint, str) else [(c, Mesh(mesh.vertices, mesh.faces[rows])) for c, rows in paint]
    drawn = [(colour, _visible_faces(part)) for colour, part in pairs]
    return [(colour, *found) for colour, found in drawn if found is not None]


def add_triangles(
    spec: mujoco.MjSpec, name: str, triangles: FloatArray, colour: Sequence[float] = (1.0, 1.0, 1.0, 1.0)
) -> None:
    """Adds a surface of one colour, with which nothing collides.

    Args:
        spec: The description to add it to.
        name: Its name.
        triangles: Corners of its faces, (F, 3, 3), metres, at least one face with an area.
        colour: Red, green, blue and opacity, 0 to 1.
    """
    corners = np.arange(triangles.size // 3, dtype=np.int32)
    spec.add_mesh(
        name=name, uservert=triangles.ravel(), userface=corners, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    )  # fmt: skip
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=list(colour), contype=0, conaffinity=0)


def add_lights(spec: mujoco.MjSpec, low: FloatArray, high: FloatArray) -> None:
    """Adds the lights for a scene between two corners, (3,) each, metres."""
    centre, reach = (low + high) / 2, float((high - low).max())
    spec.stat.center, spec.stat.extent = centre.tolist(), reach
    sun = np.array([-0.45, -0.55, 1.3])
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=(centre + reach * sun).tolist(), dir=(-sun).tolist(), castshadow=True,
        diffuse=[0.54] * 3, specular=[0.12] * 3, ambient=[0.0] * 3,
    )  # fmt: skip
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=(centre + np.array([reach, 0.0, reach])).tolist(), dir=[-0.8, 0.3, -0.7],
        castshadow=False, diffuse=[0.1] * 3, specular=[0.0] * 3, ambient=[0.0] * 3,
    )  # fmt: skip


def add_camera(
    spec: mujoco.MjSpec,
    low: FloatArray,
    high: FloatArray,
    view: View,
    size: tuple[int, int],
    table: Tabletop | None = None,
    name: str = "view",
) -> None:
    """Adds a camera that looks from one side, by the module's rule; all corners of the scene are in the picture.

    Args:
        spec: The description to add it to.
        low: Lowest corner of the scene, (3,), metres.
        high: Highest corner.
        view: The side from which it looks.
        size: Width and height of its pictures; only their ratio matters.
        table: The table; below a ceiling the camera looks from less high.
        name: Its name.
    """
    position, quat = camera_pose(low, high, view, size, table)
    spec.worldbody.add_camera(name=name, pos=list(position), quat=wxyz(quat), fovy=FIELD_OF_VIEW)


def camera_pose(
    low: FloatArray, high: FloatArray, view: View, size: tuple[int, int], table: Tabletop | None = None
) -> tuple[Vec3, QuatXyzw]:
    """Computes the position of the camera of :func:`add_camera`, and its rotation: it looks along its -z, +y is up, xyzw."""
    direction = np.array(_DIRECTIONS[view])
    if table is not None and table.clearance is not None and view != "top":
        steepest = _UNDER * table.clearance / max(table.size_xy[1], 1e-3)
        direction[2] = min(direction[2], steepest * float(np.hypot(direction[0], direction[1])))
    direction /= np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], direction) if abs(direction[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(direction, right)
    quat = np.empty(4)  # w first, as MuJoCo writes it
    mujoco.mju_mat2Quat(quat, np.stack([right, up, direction], axis=1).ravel())
    half = (high - low) / 2
    # The distance at which each corner, at its depth along the view direction, is just inside the picture.
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    ratio = size[0] / size[1]  # the field of view is vertical
    needed = corners @ direction + np.maximum(abs(corners @ right) / ratio, abs(corners @ up)) / _HALF_VIEW
    usual = _DISTANCE * 2 * half.max() / max(1.0, ratio)
    a, b, c = ((low + high) / 2 + max(usual, _MARGIN * needed.max()) * direction).tolist()
    w, x, y, z = quat.tolist()
    return (a, b, c), (x, y, z, w)


def _with_soft_shadows(lit: Picture, shaded: FloatArray) -> Picture:
    """Darkens the picture without shadows by the other one, filtered: shadow maps leave specks at edges."""
    brightness, darkened = lit.astype(np.float32).sum(axis=2) + 1, shaded.astype(np.float32).sum(axis=2) + 1
    share = Image.fromarray((255 * np.minimum(darkened / brightness, 1)).round().astype(np.uint8))
    soft = share.filter(ImageFilter.MedianFilter(3)).filter(ImageFilter.GaussianBlur(1.0))
    return np.asarray((lit * (np.asarray(soft, np.float32)[:, :, None] / 255)).round().astype(np.uint8))


def rgba(colour: str, alpha: float = 1.0) -> list[float]:
    """Returns ``#rrggbb`` as shares of red, green, blue and opacity, 0 to 1."""
    return [*(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)), alpha]


def _visible_faces(mesh: Mesh) -> tuple[FloatArray, FloatArray] | None:
    """Corners and normals (3F, 3) of the visible faces, or None without any. Cached for recent meshes."""
    return _visible_faces_of(mesh.vertices.tobytes(), mesh.faces.tobytes())  # bytes, because a cache needs keys with a hash


@lru_cache(maxsize=32)
def _visible_faces_of(vertex_bytes: bytes, face_bytes: bytes) -> tuple[FloatArray, FloatArray] | None:
    vertices = np.frombuffer(vertex_bytes, np.float64).reshape(-1, 3)
    faces = np.frombuffer(face_bytes, np.int64).reshape(-1, 3)
    if len(faces) > _MAX_FACES:
        light, few = fast_simplification.simplify(vertices.astype(np.float32), faces.astype(np.int32), target_count=_MAX_FACES)
        vertices, faces = light.astype(np.float64), few.astype(np.int64)
    triangles = vertices[faces]
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    solid = np.linalg.norm(areas, axis=1) > 1e-14
    if not solid.any():
        return None
    return triangles[solid].reshape(-1, 3), _corner_normals(faces[solid], areas[solid])


def _corner_normals(faces: npt.NDArray[np.int64], areas: FloatArray) -> FloatArray:
    """Normal of every corner, (3F, 3): the mean of the faces around it that meet its own face at a blunt angle."""
    units = areas / np.linalg.norm(areas, axis=1)[:, None]
    corner_vertex = faces.ravel()
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(corner_vertex[order]) != 0])
    counts = np.diff(np.r_[starts, len(order)])
    # All pairs of corners at the same vertex: pair k of corner c is with the k-th corner of its vertex.
    size = counts.repeat(counts)
    first = order.repeat(size)
    offset = np.arange(len(first)) - (np.cumsum(size) - size).repeat(size)
    second = order[starts.repeat(counts).repeat(size) + offset]
    near = (units[first // 3] * units[second // 3]).sum(axis=1) > CREASE
    normals = np.zeros((len(corner_vertex), 3))
    np.add.at(normals, first[near], areas[second[near] // 3])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])
