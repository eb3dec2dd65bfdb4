"""The speed of making the embedded world, and the stability of its scenes.

``python -m benchmarks.synth [--scenes 100] [--json FILE]`` times composing, settling and checking on one core.

``python -m benchmarks.synth --check FOLDER [--scenes N] [--workers 2]`` settles scenes of a written set again with random
changes: friction up to 20 % higher or lower, every object displaced by up to 0.05 mm and 0.02 degrees. It counts how many are
stable by DESIGN section 7 (1 s to settle, 3 s watched).

Run with ``OMP_NUM_THREADS=1``.
"""

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from stable_data.embedded_world import scenes as making
from stable_data.embedded_world.families.catalogue import asset
from stable_data.embedded_world.scenes import RECORD, make_scene
from stable_data.geometry.mesh import Mesh
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Scene
from stable_data.simulation.settling import PhysicsOptions, RigidBody, settle

# Names in stable_data.embedded_world.scenes, which are replaced by timed versions.
_STEPS = {
    "composing": "compose",
    "settling": "settle_objects",
    "audit": "audit",
    "rest check": "unsteady_objects",
    "task": "_finished",
}
_WARM_UP = 100  # scenes after which a process has cached most assets
_NUDGE, _NUDGE_DEGREES, _FRICTION = 5e-5, 0.02, 0.2


@contextmanager
def _timed(seconds: dict[str, float]) -> Iterator[None]:
    """Sums the seconds of every step while scenes are made."""
    original = {name: getattr(making, name) for name in _STEPS.values()}

    def stopwatch(step: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return function(*arguments)
            finally:
                seconds[step] += time.process_time() - began

        return run

    for step, name in _STEPS.items():
        setattr(making, name, stopwatch(step, original[name]))
    try:
        yield
    finally:
        for name, function in original.items():
            setattr(making, name, function)


def speed(num_scenes: int) -> dict[str, Any]:
    """Measures the seconds a scene on one core, in total and by step."""
    for number in range(_WARM_UP):
        make_scene(number, seed=1)
    seconds = dict.fromkeys(_STEPS, 0.0)
    rejected: Counter[str] = Counter()
    num_objects = 0
    with _timed(seconds):
        began = time.process_time()
        for number in range(num_scenes):
            scene = make_scene(number).scene
            num_objects += len(scene.objects)
            rejected.update((scene.source or {})[RECORD]["rejected"])
        total = time.process_time() - began
    return {
        "num_scenes": num_scenes,
        "objects_a_scene": num_objects / num_scenes,
        "seconds_a_scene": total / num_scenes,
        "minutes_for_1000": total / num_scenes * 1000 / 60,
        "seconds_by_step": {step: seconds[step] / num_scenes for step in _STEPS},
        "groups_rejected": dict(rejected),
    }


def nudged(scene: Scene, rng: np.random.Generator) -> tuple[list[RigidBody], PhysicsOptions]:
    """Returns the bodies of a scene of the embedded world with small random displacements, and options with another friction."""
    bodies = []
    for o, key in zip(scene.objects, (scene.source or {})[RECORD]["keys"], strict=True):
        source, scale = asset(key), np.asarray(o.scale) / asset(key).unit
        turn = Rotation.from_rotvec(np.radians(_NUDGE_DEGREES) * rng.uniform(-1, 1, 3)) * Rotation.from_quat(o.tilt_quat_xyzw)
        still = (Rotation.from_quat(o.tilt_quat_xyzw).as_matrix() * scale).T
        tilted = source.mesh.vertices @ still
        centre = (tilted.min(axis=0) + tilted.max(axis=0)) / 2
        parts = tuple(Mesh(part.vertices @ (turn.as_matrix() * scale).T - centre, part.faces) for part in source.parts)
        x, y, z = (np.asarray(o.position) + _NUDGE * rng.uniform(-1, 1, 3)).tolist()
        bodies.append(RigidBody(o.instance, parts, source.mass * float(np.prod(scale)), (x, y, z), o.yaw))
    options = PhysicsOptions()
    slide, *rest = options.friction
    return bodies, replace(options, friction=(slide * rng.uniform(1 - _FRICTION, 1 + _FRICTION), rest[0], rest[1]))


def _verdicts(folder: str, scene_ids: Sequence[str], seed: int) -> list[tuple[str, bool | None, str]]:
    dataset = MesaTaskDataset(Path(folder))
    found = []
    for scene_id in scene_ids:
        scene, _ = dataset.read(scene_id)
        rng = np.random.default_rng([seed, *scene_id.encode()])
        bodies, options = nudged(scene, rng)
        result = settle(bodies, scene.table, options)
        found.append((scene_id, result.stable, result.reason))
    return found


def check(folder: Path, num_scenes: int | None, workers: int, seed: int = 7) -> dict[str, Any]:
    """Measures how many scenes of a set are stable under small changes."""
    ids = MesaTaskDataset(folder).scene_ids
    step = 1 if num_scenes is None else max(1, len(ids) // num_scenes)
    chosen = ids[::step]
    parts = [chosen[k : k + 20] for k in range(0, len(chosen), 20)]
    verdicts: list[tuple[str, bool | None, str]] = []
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool, tqdm(total=len(chosen), unit="scene") as bar:
        for part in pool.map(_verdicts, [str(folder)] * len(parts), parts, [seed] * len(parts)):
            verdicts += part
            bar.update(len(part))
    unstable = {scene_id: reason for scene_id, stable, reason in verdicts if not stable}
    return {"num_scenes": len(verdicts), "stable": 1 - len(unstable) / len(verdicts), "unstable": unstable}


def main(
    scenes: Annotated[
        int | None, typer.Option(help="Number of scenes; by default 100 for the speed, all for the check.")
    ] = None,
    check_: Annotated[Path | None, typer.Option("--check", help="A written set whose scenes are settled again.")] = None,
    workers: Annotated[int, typer.Option(help="Processes of the check.")] = 2,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Times the making of scenes, or tests the stability of those of a set."""
    figures = speed(scenes or 100) if check_ is None else check(check_, scenes, workers)
    print(json.dumps(figures, indent=2))
    if file is not None:
        file.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
