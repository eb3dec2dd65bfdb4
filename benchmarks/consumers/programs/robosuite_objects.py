"""robosuite reads MJCF objects that a JSON file places; see README.md."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
from robosuite.models.objects import MujocoXMLObject
from robosuite.models.world import MujocoWorldBase


def look(path: Path, seconds: float) -> dict[str, object]:
    """Opens a file."""
    layout = json.loads(path.read_text("utf-8"))
    world = MujocoWorldBase()
    objects = {}
    for entry in [layout["table"], *layout["objects"]]:
        joints = None if entry["fixed"] else "default"
        file = str(path.parent / entry["mjcf"])
        one = MujocoXMLObject(file, entry["name"], joints=joints, duplicate_collision_geoms=False)
        x, y, z, w = entry["quat_xyzw"]
        body = one.get_obj()
        body.set("pos", " ".join(map(str, entry["position"])))
        body.set("quat", " ".join(map(str, (w, x, y, z))))
        world.merge_assets(one)
        world.worldbody.append(body)
        objects[entry["name"]] = one
    for entry in layout["objects"]:
        if not np.allclose(objects[entry["name"]].get_bounding_box_size(), entry["size"], atol=1e-6):
            raise ValueError(f"{entry['name']}: the sites are not those of its box")
    del objects["table"]
    model = world.get_model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    numbers = {name: model.body(one.root_body).id for name, one in objects.items()}
    seen = {name: of_body(model, data, k) for name, k in numbers.items()}
    if seconds:
        mujoco.mj_step(model, data, nstep=round(seconds / model.opt.timestep))
        for name, k in numbers.items():
            seen[name]["after"] = pose(data, k)
    return {"error": None, "bodies": seen}


def of_body(model: mujoco.MjModel, data: mujoco.MjData, k: int) -> dict[str, object]:
    """What is known of a body."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[k])
    axes = turn.reshape(3, 3)
    first, count = model.body_geomadr[k], model.body_geomnum[k]
    return {
        "mass": float(model.body_mass[k]),
        "center_of_mass": model.body_ipos[k].tolist(),
        "inertia": ((axes * model.body_inertia[k]) @ axes.T).tolist(),
        "parts": int((model.geom_contype[first : first + count] > 0).sum()),
        **pose(data, k),
        "is_fixed": bool(model.body_dofnum[k] == 0),
    }


def pose(data: mujoco.MjData, k: int) -> dict[str, object]:
    """A pose with the real part last; nulls if it diverged."""
    position, (w, x, y, z) = data.xpos[k], data.xquat[k]
    numbers = [float(v) if np.isfinite(v) else None for v in (*position, x, y, z, w)]
    return {"position": numbers[:3], "quat_xyzw": numbers[3:]}


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file), request["seconds"])
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
