"""Consumers of exports, and the environments in which they run."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stable_data.errors import ConfigError
from stable_data.extras import install_hint

_HERE = Path(__file__).parent
FOLDER = _HERE.parents[1] / ".consumers"
"""Where ``make consumers`` puts the environments, one folder each."""

OURS = "ours"
"""Name of the project's own environment, for consumers that can live in it."""


@dataclass(frozen=True)
class Consumer:
    """A program that opens exports.

    Attributes:
        name: Its name.
        format_name: The format that it reads.
        environment: The environment in which it runs, a file of ``requirements``, or ``ours``.
        engine: Whether it simulates.
        judges: Whether it is a validator, which names problems and no bodies.
        program: Name of its file in ``programs``; its own name if it is empty.
        module: A package that it needs in the project's own environment.
        library: A library of the system that it needs.
    """

    name: str
    format_name: str
    environment: str
    engine: bool = True
    judges: bool = False
    program: str = ""
    module: str = ""
    library: str = ""

    @cached_property
    def python(self) -> Path:
        """The Python of its environment."""
        return Path(sys.executable) if self.environment == OURS else FOLDER / self.environment / "bin" / "python"

    @property
    def is_there(self) -> bool:
        """Whether its environment has been made."""
        has_module = not self.module or find_spec(self.module) is not None
        return self.python.exists() and has_module and (not self.library or find_library(self.library) is not None)

    @property
    def missing(self) -> str:
        """How to get its environment."""
        if self.library:
            return f"{self.name} needs the library {self.library}, see benchmarks/consumers/programs/README.md"
        if self.environment == OURS:
            hint = install_hint(ModuleNotFoundError(name=self.module))
            return f"{self.name} {hint or f'needs {self.module}, which is not installed'}"
        return f"{self.name} has no environment yet: make consumers NAME={self.environment}"

    def open(self, files: Sequence[Path], seconds: float = 0.0, timeout: float = 3600.0) -> list[dict[str, Any]]:
        """Opens files in the consumer.

        Args:
            files: Main files of exported scenes.
            seconds: How long each is simulated; 0 only opens it.
            timeout: Seconds.

        Returns:
            What it saw of each file, see ``programs/README.md``; ``error`` says why it could not be opened, or that the program
            ended over it.

        Raises:
            ConfigError: The program ended over the first file, or with an error after the last one, or its environment is missing
                (``consumer``).
        """
        if not self.is_there:
            raise ConfigError(self.missing, "consumer")
        seen: list[dict[str, Any]] = []
        while len(seen) < len(files):
            more, end = self._open(files[len(seen) :], seconds, timeout)
            seen += more
            if len(seen) == len(files) and not end.startswith("status 0"):
                raise ConfigError(f"{self.name} saw all files, but ended with an error: {end}", "consumer")
            if len(seen) < len(files):  # the program ended over this file
                if not seen:
                    raise ConfigError(f"{self.name} does not run: {end}", "consumer")
                seen.append({"error": f"the program ended: {end}"})
        return seen

    def _open(self, files: Sequence[Path], seconds: float, timeout: float) -> tuple[list[dict[str, Any]], str]:
        """What it saw of the files until it ended, and how it ended."""
        program = _HERE / "programs" / f"{self.program or self.name}.py"
        request = json.dumps({"files": [str(path) for path in files], "seconds": seconds})
        # -P: a program has the name of the package that it imports.
        done = subprocess.run(
            [str(self.python), "-P", str(program)], input=request, capture_output=True, text=True, timeout=timeout, check=False
        )
        seen = [json.loads(line[5:]) for line in done.stdout.splitlines() if line.startswith("SEEN ")]
        return seen, f"status {done.returncode}, {' '.join(done.stderr.split())[-2000:]}"


CONSUMERS: Mapping[str, Consumer] = {
    consumer.name: consumer
    for consumer in (
        Consumer("mujoco_usd", "usd", "usd"),
        Consumer("newton_usd", "usd", "usd"),
        Consumer("simready", "usd", "simready", engine=False, judges=True),
        Consumer("nvidia_usd", "usd", "simready", engine=False, judges=True),
        Consumer("libsdformat", "sdformat", OURS, engine=False, judges=True, library="sdformat12"),
        Consumer("drake_sdformat", "sdformat", "robotics", program="drake_scene"),
        Consumer("drake_urdf", "urdf", "robotics", program="drake_scene"),
        Consumer("pybullet_urdf", "urdf", "robotics"),
        Consumer("yourdfpy_urdf", "urdf", "robotics", engine=False),
        Consumer("sapien_urdf", "urdf", OURS, module="sapien"),
        Consumer("mujoco_objects", "mjcf-objects", OURS, module="mujoco"),
        Consumer("robosuite_objects", "mjcf-objects", "robosuite"),
        Consumer("lerobot_dataset", "lerobot", "lerobot", engine=False, judges=True),
        Consumer("lerobot_envhub", "envhub", "lerobot", engine=False, judges=True),
    )
}
"""The consumers by name."""

FID_LIBRARIES = Consumer("fid_libraries", "features", "fid", engine=False, judges=True)
"""pytorch-fid and torch-fidelity. They open features and pictures instead of exports, so they are not among the others."""

CROISSANT = Consumer("croissant_dataset", "publish", "croissant", engine=False, judges=True)
"""mlcroissant. It opens published runs instead of exports, so it is not among the others."""
