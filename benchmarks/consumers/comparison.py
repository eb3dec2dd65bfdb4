"""What a scene says of its bodies, and what a consumer saw of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.export.props import placed_props, prop_parts
from stable_data.export.usd_stage import prim_names
from stable_data.scene import FloatArray, QuatXyzw, Vec3
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT

TOLERANCE = 1e-6
"""Largest difference: of masses and inertias relative, of points in metres, of quaternions absolute."""


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A body of a scene.

    Attributes:
        mass: Kilograms.
        center_of_mass: Metres, frame of the body.
        inertia: About the centre of mass, (3, 3), kg m², axes of the body.
        parts: Number of convex parts that collide.
        position: Origin of its frame, metres, world frame.
        quat_xyzw: Rotation of its frame.
        is_fixed: Whether it does not move; its mass then does not matter.
    """

    mass: float
    center_of_mass: Vec3
    inertia: FloatArray
    parts: int
    position: Vec3
    quat_xyzw: QuatXyzw
    is_fixed: bool


def expected(geometry: SceneGeometry, format_name: str) -> dict[str, Body]:
    """Returns the bodies of a scene by their name in a format."""
    placed = placed_props(geometry)
    names = prim_names(placed) if format_name.startswith("usd") else [p.name for p in placed]
    return {
        name: Body(
            p.mass.mass,
            p.mass.center_of_mass,
            p.mass.inertia,
            len(prop_parts(p.prop, geometry.store)),
            p.position,
            p.quat_xyzw,
            p.is_fixed,
        )
        for name, p in zip(names, placed, strict=True)
    }


def differences(bodies: Mapping[str, Body], seen: Mapping[str, Any]) -> list[str]:
    """Compares what a consumer saw (``programs/README.md``) with the bodies of a scene.

    Returns:
        A line for each difference; none if the scene was understood.
    """
    if seen["error"] is not None:
        return [f"not opened: {seen['error']}"]
    found = seen["bodies"]
    lines = [f"{name} is missing" for name in sorted(bodies.keys() - found.keys())]
    for name, body in bodies.items():
        if name in found:
            lines += [f"{name}: {line}" for line in _of_body(body, found[name])]
    lines += [f"{name} is not of the scene" for name in sorted(found.keys() - bodies.keys())]
    return lines


def _of_body(body: Body, seen: Mapping[str, Any]) -> list[str]:
    off: dict[str, float] = {"position (m)": _distance(body.position, seen["position"])}
    off["rotation"] = min(
        _distance(body.quat_xyzw, seen["quat_xyzw"]), _distance(np.negative(body.quat_xyzw), seen["quat_xyzw"])
    )
    if not body.is_fixed:
        off["mass"] = abs(seen["mass"] / body.mass - 1)
        off["centre of mass (m)"] = _distance(body.center_of_mass, seen["center_of_mass"])
        off["inertia"] = _distance(body.inertia, seen["inertia"]) / float(np.trace(body.inertia))
    lines = [f"{name} differs by {value:.2g}" for name, value in off.items() if not value <= TOLERANCE]
    if seen["parts"] != body.parts:
        lines.append(f"{seen['parts']} parts, expected {body.parts}")
    if seen["is_fixed"] is not body.is_fixed:
        lines.append("is fixed" if seen["is_fixed"] else "is not fixed")
    return lines


def _distance(expected: Any, seen: Any) -> float:
    return float(np.abs(np.subtract(expected, seen)).max())


def stays(bodies: Mapping[str, Body], seen: Mapping[str, Any]) -> bool | None:
    """Whether no movable body of a scene moved or turned farther than a stable scene allows; None if that is not known."""
    if seen["error"] is not None or {name for name, body in bodies.items() if not body.is_fixed} - seen["bodies"].keys():
        return None
    for body in seen["bodies"].values():
        if body["is_fixed"]:
            continue
        after = body.get("after")
        if after is None:
            return None
        if None in (*after["position"], *after["quat_xyzw"]):
            return False
        moved = float(np.linalg.norm(np.subtract(after["position"], body["position"])))
        turned = (Rotation.from_quat(after["quat_xyzw"]) * Rotation.from_quat(body["quat_xyzw"]).inv()).magnitude()
        if moved > MOVE_LIMIT or np.degrees(turned) > TURN_LIMIT:
            return False
    return True
