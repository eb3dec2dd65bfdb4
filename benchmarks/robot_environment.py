"""Steps a second of the robot's environment: with states, with one and three cameras, and eight environments side by side.

    python -m benchmarks.robot_environment RUN [--robot simple] [--steps 200]

RUN has scenes with goals that can be checked. Actions are small and random; the time of resets is left out. All rows spread
their steps over the same scenes, since one scene can be twice as fast as another.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stable_data.errors import StableDataError
from stable_data.robot.arm.assembly import CAMERAS
from stable_data.robot.env import RobotOptions
from stable_data.robot.vector import make_vector_env, scenes_by_task

_SIDE_BY_SIDE = 8
_SHARE = 0.2  # of the largest action


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("run", help="a run whose scenes have goals")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args(arguments)
    try:
        found = scenes_by_task(given.run, options=RobotOptions(robot=given.robot))
    except StableDataError as error:
        parser.exit(2, f"{error}\n")
    ids = [scene_id for names in found.values() for scene_id in names][: given.scenes]
    if not ids:
        parser.exit(2, f"{given.run}: no scene has a goal that can be checked and a place for {given.robot}\n")
    print(f"{len(ids)} scenes, robot {given.robot}, pictures 128 x 128 without shadows")
    print("| environments | cameras | steps a second |\n|---|---|---|")
    rows = []
    cases: list[tuple[int, tuple[str, ...]]] = [
        (1, ()),
        (1, CAMERAS[:1]),
        (1, CAMERAS),
        (_SIDE_BY_SIDE, ()),
        (_SIDE_BY_SIDE, CAMERAS[:1]),
    ]
    for count, cameras in cases:
        rate = steps_a_second(given.run, ids, count, cameras, given.robot, given.steps)
        print(f"| {count} | {', '.join(cameras) or 'none'} | {rate:.0f} |", flush=True)
        rows.append({"environments": count, "cameras": list(cameras), "steps_a_second": rate})
    if given.json is not None:
        given.json.write_text(json.dumps({"scenes": len(ids), "robot": given.robot, "rows": rows}, indent=2) + "\n", "utf-8")


def steps_a_second(run: str, scene_ids: Sequence[str], count: int, cameras: tuple[str, ...], robot: str, steps: int) -> float:
    """Measures the rate of environments side by side, all together; several run in processes of their own.

    One environment takes one scene after the other.
    """
    groups = [list(scene_ids)] if count > 1 else [[scene_id] for scene_id in scene_ids]
    each = -(-steps // len(groups))
    seconds = sum(_seconds(run, group, count, cameras, robot, each) for group in groups)
    return count * each * len(groups) / seconds


def _seconds(run: str, scene_ids: Sequence[str], count: int, cameras: tuple[str, ...], robot: str, steps: int) -> float:
    envs: Any = make_vector_env(run, scene_ids, count, count > 1, robot=robot, cameras=cameras, max_steps=10 * steps)
    envs.reset(seed=list(range(count)))
    rng = np.random.default_rng(0)
    low, high = envs.action_space.low, envs.action_space.high
    actions = [(low + high) / 2 + _SHARE * (high - low) / 2 * rng.uniform(-1, 1, low.shape) for _ in range(steps)]
    envs.step(actions[0].astype(np.float32))
    began = time.perf_counter()
    for action in actions:
        envs.step(action.astype(np.float32))
    seconds = time.perf_counter() - began
    envs.close()
    return seconds


if __name__ == "__main__":
    main()
