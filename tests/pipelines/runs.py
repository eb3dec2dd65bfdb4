"""Small runs of the preprocess job, and what they leave behind."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from pipelines.__main__ import app
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.config_diff import flatten_config

ROOT = Path(__file__).resolve().parents[2]
SMALL = PreprocessSettings(
    scenes_per_shard=2, assets_per_shard=4, num_points=64, num_pictures=0, all_assets=False, features="none"
)


def content(out: Path) -> dict[str, bytes]:
    """Every shard of a run, byte for byte."""
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.glob("*/part-*.parquet"))}


def arguments_of(dataset: Path, out: Path, *more: str) -> list[str]:
    where = ["--data", str(dataset), "--out", str(out)]
    return ["preprocess", *where, f"--set=features={SMALL.features}", *set_options(SMALL.shaping()), *more]


def set_options(shaping: Mapping[str, Any]) -> list[str]:
    """The options of a command that give it the settings that shape rows, and no pictures."""
    own = {name: value for name, value in shaping.items() if name != "shares_correctors"}  # which is derived from correctors
    return ["--set=num_pictures=0", *(f"--set={name}={json.dumps(value)}" for name, value in flatten_config(own).items())]


def command_of(dataset: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "pipelines", *arguments_of(dataset, out, *more)]


def run_here(dataset: Path, out: Path, *more: str) -> Result:
    """The command in this process: on its Ray where it has one, and with what is already imported."""
    return CliRunner().invoke(app, arguments_of(dataset, out, *more))


def run_cli(dataset: Path, out: Path, *more: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    command = command_of(dataset, out, *more)
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=os.environ | environment)


def used_assets(root: Path) -> set[str]:
    """The uids that a dataset's layouts name."""
    layouts = [json.loads(p.read_text("utf-8")) for p in root.glob("Layout_info/*/*/layout.json")]
    return {str(o.get("selected_uid") or o["retrieved_uid"]) for layout in layouts for o in layout["objects"]}
