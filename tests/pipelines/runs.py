"""Small runs of the preprocess job, and what they leave behind."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from typer.testing import CliRunner, Result

from pipelines.__main__ import app
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.config_diff import flatten_config

if TYPE_CHECKING:
    from pipelines.correct.settings import CorrectSettings  # which loads torch
    from pipelines.edit.settings import EditSettings

ROOT = Path(__file__).resolve().parents[2]
SMALL = PreprocessSettings(
    scenes_per_shard=2, assets_per_shard=4, num_points=64, num_pictures=0, all_assets=False, features="none"
)


def content(out: Path) -> dict[str, bytes]:
    """Every shard of a run, byte for byte."""
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.glob("*/part-*.parquet"))}


def arguments_of(dataset: Path, out: Path, *more: str) -> list[str]:
    settings = [f"--set={k}={json.dumps(v)}" for k, v in flatten_config(SMALL.shaping()).items()]
    where = ["--data", str(dataset), "--out", str(out)]
    return ["preprocess", *where, "--set=num_pictures=0", f"--set=features={SMALL.features}", *settings, *more]


def set_options(settings: "CorrectSettings | EditSettings") -> list[str]:
    """The options of a command that give it these settings, without pictures; what only tells that correctors are shared is no setting."""
    shaping = settings.shaping() | {"num_pictures": 0}
    return [f"--set={name}={json.dumps(value)}" for name, value in shaping.items() if hasattr(settings, name)]


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
