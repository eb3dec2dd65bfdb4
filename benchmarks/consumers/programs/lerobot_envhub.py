"""LeRobot loads an EnvHub folder and rolls a policy out in its environments, with its own code; see README.md."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.envs.utils import _call_make_env, _import_hub_module, _normalize_hub_result
from lerobot.scripts.lerobot_eval import rollout

sys.path.insert(0, str(Path(__file__).parents[3]))  # the folder's env.py needs stable_data

ENVS = 2


class Still(torch.nn.Module):
    """A policy that keeps the arm where it is, with an open hand."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size, self.seen = size, dict[str, tuple[int, ...]]()

    def reset(self) -> None:
        """Starts an episode."""

    def select_action(self, observation: dict[str, Any]) -> torch.Tensor:
        """The action."""
        self.seen = {key: tuple(value.shape) for key, value in observation.items() if hasattr(value, "shape")}
        action = torch.zeros(ENVS, self.size)
        action[:, -1] = 0.08
        return action


def same(value: Any) -> Any:
    """What a processor that changes nothing returns."""
    return value


def suites_of(folder: Path, *, is_async: bool) -> Any:
    """The environments of a folder, {suite: {number: environments}}, by LeRobot's own functions."""
    module = _import_hub_module(str(folder / "env.py"), "local/folder")
    return _normalize_hub_result(_call_make_env(module, n_envs=ENVS, use_async_envs=is_async, cfg=None))


def roll_out(folder: Path) -> list[str]:
    """Rolls out one episode in each environment of a folder; returns what is against it."""
    problems = []
    for kind, tasks in suites_of(folder, is_async=False).items():
        for number, env in tasks.items():
            policy = Still(env.single_action_space.shape[0])
            found = rollout(env, policy, same, same, same, same, seeds=[1, 2])
            where = f"{kind}, environment {number}"
            if not found["done"][:, -1].all():
                problems.append(f"{where}: the episodes do not end")
            if found["success"].any():
                problems.append(f"{where}: keeping still is a success")
            if not np.isfinite(found["reward"].numpy()).all():
                problems.append(f"{where}: rewards are not finite")
            if not {"observation.state", "observation.environment_state"} <= policy.seen.keys():
                problems.append(f"{where}: LeRobot sees {sorted(policy.seen)}")
            env.close()
    return problems


def step_processes(folder: Path) -> list[str]:
    """Steps environments in processes of their own, which LeRobot 0.4.4 makes but cannot roll out, to the end of an episode."""
    problems = []
    for kind, tasks in suites_of(folder, is_async=True).items():
        for env in tasks.values():
            env.reset(seed=[1, 2])
            for _ in range(env.call("_max_episode_steps")[0]):
                *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
            if info.get("final_info", {}).get("is_success", np.ones(1)).tolist() != [False] * ENVS:
                problems.append(f"{kind}: the last info is {info}")
            env.close()
    return problems


if __name__ == "__main__":  # processes of the environments import this file
    request = json.load(sys.stdin)
    for file in request["files"]:
        try:
            opened: dict[str, Any] = {"error": None, "problems": roll_out(Path(file)) + step_processes(Path(file))}
        except Exception as error:  # noqa: BLE001 - the reason is the result
            opened = {"error": f"{type(error).__name__}: {error}"}
        print("SEEN", json.dumps(opened), flush=True)
