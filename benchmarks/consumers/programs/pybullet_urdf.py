"""PyBullet reads URDF files that a JSON file places; see README.md."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

STEP = 1 / 240


def look(path: Path, seconds: float) -> dict[str, object]:
    """Opens a file."""
    layout = json.loads(path.read_text("utf-8"))
    pybullet.resetSimulation()
    pybullet.setGravity(*layout["gravity"])
    pybullet.setTimeStep(STEP)
    # The engine makes convex meshes a millimetre larger: what touches overlaps at the start and is to part slowly.
    pybullet.setPhysicsEngineParameter(numSolverIterations=200, contactERP=0.05)
    load(layout["table"], path.parent)
    numbers = {entry["name"]: load(entry, path.parent) for entry in layout["objects"]}
    fixed = {entry["name"]: entry["fixed"] for entry in layout["objects"]}
    seen = {}
    for name, number in numbers.items():
        mass, _, moments, at, axes, *_ = pybullet.getDynamicsInfo(number, -1)
        turn = Rotation.from_quat(axes).as_matrix()
        seen[name] = {
            "mass": mass,
            "center_of_mass": list(at),
            "inertia": ((turn * moments) @ turn.T).tolist(),
            "parts": len(pybullet.getCollisionShapeData(number, -1)),
            **pose(number),
            "is_fixed": fixed[name],
        }
    if seconds:
        for _ in range(round(seconds / STEP)):
            pybullet.stepSimulation()
        for name, number in numbers.items():
            seen[name]["after"] = pose(number)
    return {"error": None, "bodies": seen}


def load(entry: dict[str, Any], folder: Path) -> int:
    """Loads a body at its pose."""
    where = {"basePosition": entry["position"], "baseOrientation": entry["quat_xyzw"], "useFixedBase": entry["fixed"]}
    number: int = pybullet.loadURDF(str(folder / entry["urdf"]), flags=pybullet.URDF_USE_INERTIA_FROM_FILE, **where)
    return number


def pose(number: int) -> dict[str, object]:
    """The pose of the frame of a body; the engine gives that of its principal axes."""
    position, quat = pybullet.getBasePositionAndOrientation(number)
    at, axes = pybullet.getDynamicsInfo(number, -1)[3:5]
    if not np.isfinite((*position, *quat)).all():
        return {"position": [None] * 3, "quat_xyzw": [None] * 4}
    turn = Rotation.from_quat(quat) * Rotation.from_quat(axes).inv()
    return {"position": (np.array(position) - turn.apply(at)).tolist(), "quat_xyzw": turn.as_quat().tolist()}


pybullet.connect(pybullet.DIRECT)
request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file), request["seconds"])
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("\nSEEN", json.dumps(opened), flush=True)  # a library may have left a line open
