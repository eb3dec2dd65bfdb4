"""A folder for LeRobot's EnvHub: scenes with their goals and an ``env.py`` whose ``make_env`` gives environments of a robot."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError, SceneError, cannot_write
from stable_data.json_text import ReadLog, json_value, read_bounded
from stable_data.limits import LIMITS
from stable_data.robot.arm.robots import robot_named
from stable_data.robot.env import RobotOptions
from stable_data.robot.randomization import RandomizationOptions
from stable_data.robot.vector import SceneEnvs, make_vector_env, scenes_by_task
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.subset import select

_RUN, _SETTINGS = "run", "settings.json"

_ENV = '''"""Environments of a robot at tables: make_env(n_envs, use_async_envs), as LeRobot's EnvHub expects it.

settings.json holds the robot, its cameras and the scenes of each kind of task. Needs: pip install 'stable-data[geometry,sim,env]'
"""

from pathlib import Path

from stable_data.robot.envhub import make_suites


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Returns {kind of task: {0: n_envs environments side by side}}."""
    return make_suites(Path(__file__).parent, n_envs, use_async_envs)
'''

_README = """---
license: other
tags:
- LeRobot
- robotics
---

# {title}

{num_scenes} tabletop scenes with tasks, and a {robot} that shall carry them out, as environments for LeRobot's EnvHub.

| kind of task | scenes |
|---|---|
{rows}

```
pip install 'stable-data[geometry,sim,env]'
{fetch}
```

```python
from env import make_env

suites = make_env(n_envs=4)
observation, info = suites["{first}"][0].reset(seed=[0, 1, 2, 3])
```

An observation has `agent_pos`, `environment_state` and, for each camera in `settings.json`, a picture in `pixels`. `info["is_success"]`
says whether the goal is fulfilled. The licences of the assets are in `run/assets`.
"""


def write_envhub(run: RunFolder, out: Path, where: str | None, options: RobotOptions) -> dict[str, int]:
    """Writes a folder for EnvHub: ``env.py``, ``settings.json``, ``README.md``, and the scenes.

    These are the scenes with a checkable goal in which the robot can start.

    Args:
        run: The run.
        out: The folder; it may not exist, or must be empty.
        where: A condition on the table ``scenes``; None: all.
        options: The robot.

    Returns:
        The number of scenes of each kind of task.

    Raises:
        ConfigError: The files of the robot are missing (``robot_missing``), there is no such scene (``no_goal``), or the folder is
            not empty or cannot be written (``output_unwritable``).
    """
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out}: is not empty, expected a new folder; choose another one", "output_unwritable")
    robot = robot_named(options.robot)  # its files are needed to try the scenes
    kinds = scenes_by_task(run.uri, where=where, options=options)
    if not kinds:
        raise ConfigError(
            f"{run.uri}: no scene has a goal that can be checked, with room for the robot; `stable-data tasks` says why",
            "no_goal",
        )
    counts = {kind: len(ids) for kind, ids in kinds.items()}
    package = robot.package is not None
    readme = _README.format(
        title=Path(run.root).name,
        num_scenes=sum(counts.values()),
        robot=robot.title,
        rows="\n".join(f"| {kind} | {count} |" for kind, count in counts.items()),
        fetch=f"stable-data robots --fetch {robot.name}" if package else "# the robot needs no further files",
        first=next(iter(counts)),
    )
    settings = {"robot": asdict(options), "scenes": kinds}
    target = RunFolder(str(out / _RUN))
    with target.locked():
        select(run, where or "scene_id is not None", target)
    files = {"env.py": _ENV, "README.md": readme, _SETTINGS: json.dumps(settings, indent=1)}
    try:
        for name, text in files.items():
            write_file_atomically(out / name, text.encode())
    except OSError as error:
        raise cannot_write(str(out), error) from error
    return counts


def make_suites(folder: Path, n_envs: int = 1, use_async_envs: bool = False) -> dict[str, dict[int, SceneEnvs]]:
    """Makes the environments of a folder that :func:`write_envhub` wrote.

    Args:
        folder: The folder.
        n_envs: How many environments of each kind of task.
        use_async_envs: Each in a process of its own.

    Raises:
        ConfigError: ``settings.json`` is missing or has another form (``setting_invalid``), or the robot is missing.
    """
    settings, scenes = _settings(folder)
    return {
        kind: {0: make_vector_env(str(folder / _RUN), ids, n_envs, use_async_envs, **settings)} for kind, ids in scenes.items()
    }


def _settings(folder: Path) -> tuple[dict[str, Any], dict[str, list[str]]]:
    path = folder / _SETTINGS
    try:
        document = json_value(read_bounded(path, LIMITS.text, "max_document_bytes", ReadLog(_SETTINGS)).decode())
        robot, scenes = dict(document["robot"]), {str(kind): list(ids) for kind, ids in document["scenes"].items()}
        robot["randomization"] = RandomizationOptions(**robot["randomization"])
        robot["cameras"], robot["image_size"] = tuple(robot["cameras"]), tuple(robot["image_size"])
        RobotOptions(**robot)
    except ConfigError:
        raise
    except (SceneError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{path}: is no settings file of an EnvHub folder ({type(error).__name__}: {error}); export the folder again",
            "setting_invalid",
        ) from error
    return robot, scenes
