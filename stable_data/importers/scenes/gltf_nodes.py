"""Which nodes of a glTF scene are free bodies, which are colliders, and which are left out: by their names and extensions.

The suffixes of names are those that the importer of the Godot engine knows: ``-rigid``, ``-col``, ``-convcol``, ``-colonly``,
``-convcolonly`` and ``-noimp``, with ``_`` or ``$`` in place of ``-``, in any case, and with a number behind, which modelling programs
add to copies.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stable_data.errors import MeshError
from stable_data.json_text import number, numbers

PHYSICS = "KHR_physics_rigid_bodies"
"""The extension that states rigid bodies."""

_SUFFIX = re.compile(r"[-_$](rigid|col|convcol|colonly|convcolonly|noimp|navmesh|occonly)[\s\d._]*$", re.IGNORECASE)
_LEFT_OUT = frozenset({"noimp", "navmesh", "occonly"})
_COLLIDERS = frozenset({"col", "convcol", "colonly", "convcolonly"})


@dataclass(frozen=True, slots=True)
class Motion:
    """What a node states of its motion as a rigid body.

    Attributes:
        mass: Kilograms; None if it states none.
        center_of_mass: In the frame of the node; likewise.
        moments: Principal moments of inertia, kg m²; likewise.
        moments_quat_xyzw: Rotation from the principal axes to the frame of the node.
    """

    mass: float | None = None
    center_of_mass: tuple[float, ...] | None = None
    moments: tuple[float, ...] | None = None
    moments_quat_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)


def name_suffix(node: Mapping[str, Any]) -> str:
    """The suffix of a node's name that has a meaning, lower case, without its dash; empty if there is none."""
    name = node.get("name")
    found = _SUFFIX.search(name) if isinstance(name, str) else None
    return found[1].lower() if found else ""


def is_left_out(node: Mapping[str, Any]) -> bool:
    """Whether a node and all below it are no part of the scene."""
    return name_suffix(node) in _LEFT_OUT


def is_own_object(node: Mapping[str, Any]) -> bool:
    """Whether a node is an object of a scene that this library has exported."""
    extras = node.get("extras")
    return isinstance(extras, dict) and {"category", "asset_id"} <= extras.keys()


def is_free(node: Mapping[str, Any]) -> bool:
    """Whether a node is a free body. What its extension states wins over its name."""
    motion = _entry(physics_of(node), "motion")
    if motion is not None:
        return motion.get("isKinematic") is not True and motion.get("mass") != 0  # 0 stands for an infinite mass
    if is_own_object(node):
        return node["extras"].get("fixed") is not True
    return name_suffix(node) == "rigid"


def has_free_body(document: Mapping[str, Any]) -> bool:
    """Whether a glTF document has a node that is a free body."""
    nodes = document.get("nodes")
    return isinstance(nodes, list) and any(isinstance(node, dict) and is_free(node) for node in nodes)


def physics_of(node: Mapping[str, Any]) -> Mapping[str, Any]:
    """The extension KHR_physics_rigid_bodies of a node; empty without one."""
    return _entry(_entry(node, "extensions") or {}, PHYSICS) or {}


def motion_of(node: Mapping[str, Any]) -> Motion:
    """What a free body states of its mass; what is no usable number is not stated."""
    motion = _entry(physics_of(node), "motion") or {}
    mass, moments = number(motion.get("mass")), numbers(motion.get("inertiaDiagonal"), 3)
    return Motion(
        mass if mass is not None and 0 < mass < float("inf") else None,
        _finite(numbers(motion.get("centerOfMass"), 3)),
        _finite(moments) if moments is not None and min(moments) > 0 else None,
        _finite(numbers(motion.get("inertiaOrientation"), 4)) or (0.0, 0.0, 0.0, 1.0),
    )


def collider_of(node: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The geometry that an extension states for the collisions of a node: ``shape`` or ``node``, and ``convexHull``; else None."""
    collider = _entry(physics_of(node), "collider")
    return None if collider is None else _entry(collider, "geometry") or {}


def is_named_collider(node: Mapping[str, Any]) -> bool:
    """Whether the mesh of a node is a collider by its name."""
    return "mesh" in node and name_suffix(node) in _COLLIDERS


def is_named_hull(node: Mapping[str, Any]) -> bool:
    """Whether the name of a node asks for the convex hull of its mesh."""
    return name_suffix(node).startswith("convcol")


def implicit_shape(document: Mapping[str, Any], index: object, path: str) -> Mapping[str, Any]:
    """A shape of the extension KHR_implicit_shapes.

    Raises:
        MeshError: There is none (``model_unreadable``).
    """
    shapes = (_entry(_entry(document, "extensions") or {}, "KHR_implicit_shapes") or {}).get("shapes")
    if (
        not isinstance(shapes, list)
        or type(index) is not int
        or not 0 <= index < len(shapes)
        or not isinstance(shapes[index], dict)
    ):
        found = f"a collider refers to shape {index!r:.40} of KHR_implicit_shapes"
        raise MeshError(f"{path}: {found}, expected one that the file has; export it again", "model_unreadable")
    shape: Mapping[str, Any] = shapes[index]
    return shape


def animated_nodes(document: Mapping[str, Any]) -> set[int]:
    """The nodes whose transforms an animation of a document changes."""
    found = set()
    for animation in document.get("animations") or []:
        for channel in animation.get("channels") or []:
            target = channel.get("target") or {}
            if type(target.get("node")) is int and target.get("path") in ("translation", "rotation", "scale"):
                found.add(target["node"])
    return found


def _entry(owner: Mapping[str, Any], key: str) -> Mapping[str, Any] | None:
    found = owner.get(key)
    return found if isinstance(found, dict) else None


def _finite(values: tuple[float, ...] | None) -> tuple[float, ...] | None:
    return values if values is not None and all(abs(v) < float("inf") for v in values) else None
