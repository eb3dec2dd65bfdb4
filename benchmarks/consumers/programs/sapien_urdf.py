"""SAPIEN reads URDF files that a JSON file places; its solver is PhysX on the CPU; see README.md."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien import physx
from sapien.wrapper.urdf_loader import URDFLoader
from scipy.spatial.transform import Rotation

STEP = 1 / 240


class Loader(URDFLoader):  # type: ignore[misc]  # no types are published
    """The loader without what is seen, whose materials ask for a device that draws."""

    def _build_link(self, link: Any, link_builder: Any) -> None:
        link.visuals.clear()
        super()._build_link(link, link_builder)


def look(path: Path, seconds: float) -> dict[str, object]:
    """Opens a file."""
    layout = json.loads(path.read_text("utf-8"))
    physx.set_scene_config(gravity=np.array(layout["gravity"]))
    physx.set_body_config(sleep_threshold=0.0)
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.set_timestep(STEP)
    load(scene, layout["table"], path.parent)
    entities = {entry["name"]: load(scene, entry, path.parent) for entry in layout["objects"]}
    seen = {}
    for name, entity in entities.items():
        body = entity.find_component_by_type(physx.PhysxRigidDynamicComponent)
        turn = Rotation.from_quat(np.roll(body.cmass_local_pose.q, -1)).as_matrix()
        seen[name] = {
            "mass": float(body.mass),
            "center_of_mass": body.cmass_local_pose.p.tolist(),
            "inertia": ((turn * body.inertia) @ turn.T).tolist(),
            "parts": len(body.collision_shapes),
            **pose(entity),
            "is_fixed": bool(body.kinematic),
        }
    if seconds:
        for _ in range(round(seconds / STEP)):
            scene.step()
        for name, entity in entities.items():
            seen[name]["after"] = pose(entity)
    return {"error": None, "bodies": seen}


def load(scene: sapien.Scene, entry: dict[str, Any], folder: Path) -> sapien.Entity:
    """Loads a body at its pose, with the friction of the layout: the loader takes none from a file."""
    loader = Loader()
    loader.set_scene(scene)
    loader.set_material(entry["friction"], entry["friction"], 0.0)
    _, [builder], _ = loader.parse(str(folder / entry["urdf"]))
    x, y, z, w = entry["quat_xyzw"]
    builder.set_initial_pose(sapien.Pose(entry["position"], [w, x, y, z]))
    # A static body has no mass, which the builder sets.
    builder.set_physx_body_type("kinematic" if entry["fixed"] else "dynamic")
    return builder.build()


def pose(entity: sapien.Entity) -> dict[str, object]:
    """The pose of an entity; nulls if it diverged."""
    w, x, y, z = entity.pose.q.tolist()
    numbers = [float(v) if np.isfinite(v) else None for v in (*entity.pose.p, x, y, z, w)]
    return {"position": numbers[:3], "quat_xyzw": numbers[3:]}


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file), request["seconds"])
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
