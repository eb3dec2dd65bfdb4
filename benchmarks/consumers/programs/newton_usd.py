"""Newton reads OpenUSD; its solver is MuJoCo's on Warp or XPBD; see README.md."""

import json
import sys

import newton
import numpy as np
import warp as wp

wp.config.quiet = True


def look(path: str, seconds: float) -> dict[str, object]:
    """Opens a file."""
    builder = newton.ModelBuilder()
    builder.add_usd(path)
    if not builder.body_count:
        return {"error": None, "bodies": {}}
    model = builder.finalize(device="cpu")
    names = [label.rpartition("/")[2] for label in model.body_label]
    shape_body, flags = model.shape_body.numpy(), model.shape_flags.numpy()
    collides = (flags & int(newton.ShapeFlags.COLLIDE_SHAPES)) > 0
    poses, masses = model.body_q.numpy(), model.body_mass.numpy()
    bodies = {}
    for k, name in enumerate(names):
        bodies[name] = {
            "mass": float(masses[k]),
            "center_of_mass": model.body_com.numpy()[k].tolist(),
            "inertia": model.body_inertia.numpy()[k].tolist(),
            "parts": int((collides & (shape_body == k)).sum()),
            **pose(poses[k]),
            "is_fixed": False,
        }
    if seconds:
        for name, after in zip(names, simulate(model, seconds), strict=True):
            bodies[name]["after"] = pose(after)
    return {"error": None, "bodies": bodies}


def simulate(model: "newton.Model", seconds: float) -> np.ndarray:
    """Poses after a simulation with XPBD, (N, 7)."""
    solver = newton.solvers.SolverXPBD(model, iterations=20)
    state, following, control = model.state(), model.state(), model.control()
    step = 1 / 480
    for _ in range(round(seconds / step)):
        state.clear_forces()
        contacts = model.collide(state)
        solver.step(state, following, control, contacts, step)
        state, following = following, state
    return np.asarray(state.body_q.numpy())


def pose(numbers: np.ndarray) -> dict[str, object]:
    """A pose; nulls if it diverged."""
    values = [float(v) if np.isfinite(v) else None for v in numbers]
    return {"position": values[:3], "quat_xyzw": values[3:]}


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        seen = look(file, request["seconds"])
    except Exception as error:  # noqa: BLE001 - the reason is the result
        seen = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(seen), flush=True)
