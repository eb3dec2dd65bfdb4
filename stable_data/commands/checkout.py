"""Runs jobs of ``pipelines``, on which this package does not depend, in a process of their own."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from stable_data.errors import ConfigError


def run_pipelines(arguments: Sequence[str]) -> int:
    """Runs ``python -m pipelines`` of this checkout.

    Args:
        arguments: The verb and its options.

    Returns:
        Its exit status.

    Raises:
        ConfigError: This package was installed without a checkout (``no_pipelines``).
    """
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / "pipelines").is_dir():
        found = f"{arguments[0]} needs pipelines/, which is not installed"
        raise ConfigError(f"{found}, expected a checkout; run the command in one", "no_pipelines")
    path = os.pathsep.join([str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])])  # the checkout need not be installed
    # -P: Python would look for modules in the current folder first, which may hold data of others.
    command = [sys.executable, "-P", "-m", "pipelines", *arguments]
    return subprocess.run(command, check=False, env=os.environ | {"PYTHONPATH": path}).returncode
