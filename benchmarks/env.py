"""The speed of the environment: ``python -m benchmarks.env RUN [--scenes 12] [--steps 100] [--json FILE]``.

The hand makes the same random steps in each of the first scenes: with poses alone, and with two pictures of 128 x 128. For
comparison MuJoCo alone makes as many steps of the same scene at rest. Run with ``OMP_NUM_THREADS=1``.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stable_data.simulation.gym_env import STEP_SECONDS, TabletopEnv
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.mujoco_model import CAMERAS, HOME, engine_spec
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_spec
from stable_data.storage.run_folder import RunFolder

_SIZE = (128, 128)


@dataclass(frozen=True, slots=True)
class EnvFigure:
    """The speed of one way to step.

    Attributes:
        way: Name of the way.
        steps_per_second: Steps of ``STEP_SECONDS`` each, over all scenes.
        of_mujoco: The same as a share of the steps of MuJoCo alone.
    """

    way: str
    steps_per_second: float
    of_mujoco: float


def measure(run: str, num_scenes: int, num_steps: int) -> tuple[list[EnvFigure], float, float]:
    """Measures the figures, the mean number of objects, and the seconds for the construction of one environment."""
    scenes = RunScenes(RunFolder(run), SceneSelection(limit=num_scenes))
    solids = [scenes.geometry(scene) for scene in scenes]
    actions = np.random.default_rng(0).uniform(-1, 1, (num_steps, 3)).astype(np.float32)
    start = time.perf_counter()
    plain = [TabletopEnv(solid) for solid in solids]
    making = (time.perf_counter() - start) / len(solids)
    alone = sum(_mujoco_seconds(solid, num_steps) for solid in solids)
    poses = sum(_seconds(env, actions) for env in plain)
    pictures = sum(_seconds(TabletopEnv(solid, cameras=CAMERAS, image_size=_SIZE), actions) for solid in solids)
    ways = {"MuJoCo alone": alone, "poses": poses, f"poses and {len(CAMERAS)} pictures": pictures}
    figures = [
        EnvFigure(way, round(len(solids) * num_steps / seconds, 1), round(alone / seconds, 2)) for way, seconds in ways.items()
    ]
    return figures, float(np.mean([len(solid.shapes) for solid in solids])), making


def _seconds(env: TabletopEnv, actions: npt.NDArray[np.float32]) -> float:
    """Measures the seconds of an episode, after its reset."""
    env.reset(seed=0)
    start = time.perf_counter()
    for action in actions:
        env.step(action)
    seconds = time.perf_counter() - start
    env.close()
    return seconds


def _mujoco_seconds(solid: SceneGeometry, num_steps: int) -> float:
    """Measures the seconds of MuJoCo alone for as many steps of the same scene, without the hand."""
    model = compile_spec(engine_spec(solid, _SIZE))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(HOME).id)
    start = time.perf_counter()
    mujoco.mj_step(model, data, nstep=num_steps * round(STEP_SECONDS / model.opt.timestep))
    return time.perf_counter() - start


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder")
    parser.add_argument("--scenes", type=int, default=12, help="number of scenes")
    parser.add_argument("--steps", type=int, default=100, help="steps of each")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    figures, num_objects, making = measure(arguments.run, arguments.scenes, arguments.steps)
    print(f"{'way':22} {'steps/s':>8} {'of MuJoCo':>10}")
    for f in figures:
        print(f"{f.way:22} {f.steps_per_second:8.1f} {f.of_mujoco:10.2f}")
    print(f"{num_objects:.1f} objects a scene; {making:.2f} s to construct an environment")
    if arguments.json:
        content = {"ways": [asdict(f) for f in figures], "num_objects": num_objects, "making_seconds": making}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
