"""yourdfpy reads URDF files that a JSON file places; it does not simulate; see README.md."""

import json
import sys
from pathlib import Path

import numpy as np
import yourdfpy


def look(path: Path) -> dict[str, object]:
    """Opens a file."""
    layout = json.loads(path.read_text("utf-8"))
    load(path.parent / layout["table"]["urdf"])
    seen = {}
    for entry in layout["objects"]:
        link = load(path.parent / entry["urdf"])
        inertial = link.inertial
        if not np.array_equal(inertial.origin[:3, :3], np.eye(3)):
            raise ValueError("the inertia is in turned axes")
        seen[entry["name"]] = {
            "mass": inertial.mass,
            "center_of_mass": inertial.origin[:3, 3].tolist(),
            "inertia": np.asarray(inertial.inertia).tolist(),
            "parts": len(link.collisions),
            "position": entry["position"],
            "quat_xyzw": entry["quat_xyzw"],
            "is_fixed": entry["fixed"],
        }
    return {"error": None, "bodies": seen}


def load(path: Path) -> yourdfpy.Link:
    """The link of a file whose meshes are all there."""
    robot = yourdfpy.URDF.load(
        str(path), load_collision_meshes=True, build_collision_scene_graph=True, force_collision_mesh=False
    )
    if not robot.validate():
        raise ValueError(f"{path}: {robot.errors}")
    [link] = robot.robot.links
    for what, scene in ((link.visuals, robot.scene), (link.collisions, robot.collision_scene)):
        if len(scene.geometry) != len(what):
            raise ValueError(f"{path}: {len(scene.geometry)} of {len(what)} meshes")
    return link


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file))
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
