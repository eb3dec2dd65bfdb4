"""Reads COLLADA (DAE) by pycollada: unit, upward axis, transforms of nodes, polygons, materials."""

import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from stable_data.errors import ConfigError, MeshError
from stable_data.extras import install_hint
from stable_data.geometry.mesh_colors import to_linear
from stable_data.geometry.surface import Surface
from stable_data.importers.formats.mesh_file import Companions, FileAxis, MeshFile, check_face_count, parsing, taken
from stable_data.importers.formats.xml_text import parse_xml
from stable_data.limits import LIMITS, at_most
from stable_data.scene import FloatArray

_UP: dict[str, FileAxis] = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
_NOT_FINITE = re.compile(r"nan|inf", re.IGNORECASE)
_LOOKS = ("bind_material", "library_materials", "library_effects", "library_images")
_LEAST_OPACITY = 0.05  # below it the file means the opposite: many exporters write transparency the wrong way round


def read_dae(content: bytes, path: str, companions: Companions, *, max_faces: int) -> MeshFile:
    """Reads a COLLADA document: polygons as fans, the first set of texture coordinates, diffuse colour or texture.

    Args:
        content: The file; not trusted.
        path: Its name in messages.
        companions: Where textures come from.
        max_faces: Triangles beyond which it is refused.

    Raises:
        MeshError: ``model_unreadable`` or ``mesh_too_large``.
        ConfigError: pycollada is not installed.
    """
    try:
        import collada
    except ModuleNotFoundError as error:
        raise ConfigError(f"{path}: reading COLLADA {install_hint(error) or error}", "package_missing") from error
    tree = parse_xml(content, path)  # bounds first: pycollada has none
    with parsing(path, "a COLLADA document"):
        _check_positions(tree, path)
        document = _opened(content, tree, path, companions)
        surfaces, names, num_primitives, num_faces = [], [], 0, 0
        looks, cut = dict[int, dict[str, Any]](), dict[int, Any]()
        for node, matrix, called in _placed(document.scene.nodes, path):
            num_primitives += len(node.geometry.primitives)
            if num_primitives > LIMITS.mesh.max_primitives:
                most = at_most(LIMITS.mesh, "max_primitives")
                raise MeshError(f"{path}: shows more primitives, expected {most}; simplify it", "mesh_too_large")
            if id(node) not in looks:  # others may show it again
                looks[id(node)] = {material.symbol: material.target for material in node.materials}
            for primitive in node.geometry.primitives:
                if id(primitive) not in cut:  # many nodes may show one geometry
                    cut[id(primitive)] = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
                triangles = cut[id(primitive)]
                if isinstance(triangles, collada.triangleset.TriangleSet) and len(triangles.index):
                    num_faces += len(triangles.index)
                    check_face_count(path, num_faces, max_faces)
                    surfaces.append(_surface(triangles, matrix, looks[id(node)], path, companions))
                    names.append(frozenset(name for name in (*called, node.geometry.name, node.geometry.id) if name))
        asset = document.assetInfo
        contributor = asset.contributors[0] if asset.contributors else None
        states_up = any(_name(element) == "up_axis" for element in document.xmlnode.getroot().iter())
    unit = asset.unitmeter if asset.unitmeter is not None and np.isfinite(asset.unitmeter) and asset.unitmeter > 0 else None
    up: FileAxis = _UP.get(asset.upaxis, "") if states_up else ""
    rights, author = ("", "") if contributor is None else (contributor.copyright or "", contributor.author or "")
    return MeshFile(tuple(surfaces), unit, up, "", rights.strip(), author.strip(), tuple(names))


def _name(element: Any) -> str:
    """The name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _plain_name(element: ET.Element) -> str:
    """The name of an element without its prefix."""
    return element.tag.rpartition(":")[2]


def _check_positions(tree: ET.Element, path: str) -> None:
    """Refuses positions that are not finite: pycollada makes them 0.

    Raises:
        MeshError: ``mesh_not_finite``.
    """
    inputs = [e for e in tree.iter() if _plain_name(e) == "input" and e.get("semantic") == "POSITION"]
    wanted = {element.get("source", "").removeprefix("#") for element in inputs}
    for source in (e for e in tree.iter() if _plain_name(e) == "source" and e.get("id") in wanted):
        if any(_plain_name(e) == "float_array" and _NOT_FINITE.search(e.text or "") for e in source):
            raise MeshError(f"{path}: a vertex is not finite, expected finite coordinates; export it again", "mesh_not_finite")


def _opened(content: bytes, tree: ET.Element, path: str, companions: Companions) -> Any:
    """Opens a document; if a broken material would cost a part of the mesh, without its materials.

    Raises:
        MeshError: ``model_unreadable`` or ``mesh_empty``.
    """
    import collada

    document = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    if lost := _lost_part(document):
        for parent in list(tree.iter()):
            for child in [c for c in parent if _plain_name(c) in _LOOKS]:
                parent.remove(child)
        document = collada.Collada(io.BytesIO(ET.tostring(tree)), ignore=[collada.common.DaeError])
        if still_lost := _lost_part(document):
            message = f"{path}: a part cannot be read ({still_lost:.200}), expected whole geometry; export it again"
            raise MeshError(message, "model_unreadable")
        companions.note_lost_look(lost)
    if document.scene is None:
        raise MeshError(f"{path}: has no scene, expected a COLLADA scene; export it again", "mesh_empty")
    return document


def _lost_part(document: Any) -> str:
    """Why pycollada left out a geometry or a node; empty if it did not."""
    import collada

    reason = " ".join(str(document.errors[0]).split()) if document.errors else "no reason is given"
    if document.scene is None:
        return reason if document.errors else ""
    meshes = [g for g in document.xmlnode.getroot().iter() if _name(g) == "geometry" and any(_name(c) == "mesh" for c in g)]
    asked = sum(_name(element) in ("instance_geometry", "instance_node") for element in document.scene.xmlnode.iter())
    shown, stack = 0, list(document.scene.nodes)
    while stack:
        node = stack.pop()
        shown += isinstance(node, (collada.scene.GeometryNode, collada.scene.NodeNode))
        if isinstance(node, collada.scene.Node) and not isinstance(node, collada.scene.NodeNode):
            stack += node.children or []
    return reason if len(document.geometries) < len(meshes) or shown < asked else ""


def _placed(nodes: list[Any], path: str) -> Iterator[tuple[Any, FloatArray, tuple[str | None, ...]]]:
    """Every node with a geometry in file order, its transform (4, 4), and the names of the node above it."""
    import collada

    top: tuple[str | None, ...] = ()
    stack, count = [(node, np.eye(4), top) for node in reversed(nodes)], 0
    while stack:
        node, matrix, names = stack.pop()
        count += 1
        if count + len(stack) > LIMITS.model.max_nodes:  # a node may show another one twice, which shows another one twice, ...
            raise MeshError(
                f"{path}: shows more nodes, expected {at_most(LIMITS.model, 'max_nodes')}; simplify it", "mesh_too_large"
            )
        if isinstance(node, collada.scene.GeometryNode):
            yield node, matrix, names
        elif isinstance(node, collada.scene.Node):
            inner = matrix @ np.asarray(node.matrix, np.float64)
            called = (getattr(node, "name", None), node.id)
            stack += [(child, inner, called) for child in reversed(node.children or [])]


def _surface(primitive: Any, matrix: FloatArray, materials: Mapping[str, Any], path: str, companions: Companions) -> Surface:
    corners = taken(np.asarray(primitive.vertex), np.asarray(primitive.vertex_index), path, "vertex")
    triangles = corners.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    order = slice(None, None, -1) if np.linalg.det(matrix[:3, :3]) < 0 else slice(None)  # a mirrored mesh would be inside out
    material = materials.get(primitive.material)
    colour, texture, opacity = (None, "", 1.0) if material is None else _look(getattr(material, "effect", material))
    image = corner_uv = None
    if len(primitive.texcoordset):
        image = companions.image(texture)
        if image is not None:
            uv = np.asarray(primitive.texcoordset[0])[:, :2]
            corner_uv = taken(uv, np.asarray(primitive.texcoord_indexset[0]), path, "texture coordinate").astype(np.float64)
            corner_uv = (corner_uv * (1.0, -1.0) + (0.0, 1.0))[:, order]  # its origin is lower left
            colour = (1.0, 1.0, 1.0)
    colours = None if image is not None else _corner_colours(primitive, path)
    return Surface(triangles[:, order], colour, None if colours is None else colours[:, order], image, corner_uv, opacity)


def _look(effect: Any) -> tuple[tuple[float, float, float] | None, str, float]:
    """Linear colour, reference of the texture and opacity of an effect."""
    import collada

    colour, texture, diffuse = None, "", effect.diffuse
    if isinstance(diffuse, collada.material.Map):
        texture = str(diffuse.sampler.surface.image.path)
    elif diffuse is not None:
        red, green, blue = to_linear(np.clip(np.asarray(diffuse, np.float64)[:3], 0.0, 1.0)).tolist()
        colour = (red, green, blue)
    transparent, share = effect.transparent, effect.transparency
    if isinstance(transparent, collada.material.Map) or isinstance(share, collada.material.Map) or transparent is None:
        return colour, texture, 1.0
    channels = np.asarray(transparent, np.float64)
    amount = 1.0 if share is None else float(share)
    is_of_rgb = effect.opaque_mode == collada.material.OPAQUE_MODE.RGB_ZERO
    opacity = 1.0 - float(channels[:3] @ (0.2126, 0.7152, 0.0722)) * amount if is_of_rgb else float(channels[-1]) * amount
    return colour, texture, opacity if _LEAST_OPACITY <= opacity <= 1.0 else 1.0


def _corner_colours(primitive: Any, path: str) -> FloatArray | None:
    """Linear colours of the corners, (F, 3, 3)."""
    found = primitive.sources.get("COLOR", [])
    if not found:
        return None
    offset, source = found[0][0], found[0][4]
    colours = np.asarray(source.data)
    colours = taken(colours.reshape(len(colours), -1)[:, :3], np.asarray(primitive.index)[:, :, offset], path, "colour")
    colours = colours.astype(np.float64)
    return to_linear(np.clip(colours, 0.0, 1.0)) if colours.shape[-1] == 3 else None
