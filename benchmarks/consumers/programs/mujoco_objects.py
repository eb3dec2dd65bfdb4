"""MuJoCo reads MJCF objects that a JSON file places; see README.md."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np


def look(path: Path, seconds: float) -> dict[str, object]:
    """Opens a file."""
    layout = json.loads(path.read_text("utf-8"))
    scene = mujoco.MjSpec()
    scene.option.timestep, scene.option.impratio, scene.option.cone = 0.002, 10.0, mujoco.mjtCone.mjCONE_ELLIPTIC
    scene.option.gravity = layout["gravity"]
    for entry in [layout["table"], *layout["objects"]]:
        one = mujoco.MjSpec.from_file(str(path.parent / entry["mjcf"]))
        x, y, z, w = entry["quat_xyzw"]
        frame = scene.worldbody.add_frame(pos=entry["position"], quat=[w, x, y, z])
        body = frame.attach_body(one.body("object"), f"{entry['name']}/", "")
        if not entry["fixed"]:
            body.add_freejoint()
    model = scene.compile()
    data = mujoco.MjData(model)
    numbers = {entry["name"]: model.body(f"{entry['name']}/object").id for entry in layout["objects"]}
    mujoco.mj_kinematics(model, data)
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
