"""The cluster files: valid for the program that reads them, and their commands are ones that our command line knows."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from benchmarks.faults.comparison import compared
from benchmarks.faults.processes import below
from pipelines.__main__ import app
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.storage.run_folder import RunFolder

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = ROOT / "workflows"
SBATCH = WORKFLOWS / "slurm" / "generate.sbatch"
COMMANDS = [
    (path, command.replace("\\\n", " "))
    for path in [*sorted(WORKFLOWS.rglob("*.*")), ROOT / "docs" / "clusters.md"]
    for command in re.findall(r"python -m pipelines ((?:[^'`|&\n#]|\\\n)+)", path.read_text("utf-8").replace("\n    --", " --"))
    if "-" in command  # else it is named and not run
]


def launcher() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((WORKFLOWS / "ray" / "cluster.yaml").read_text("utf-8"))
    return found


def rayjob() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((WORKFLOWS / "kuberay" / "generate.yaml").read_text("utf-8"))
    return found


def test_there_are_commands_in_each_file() -> None:
    assert {path.name for path, _ in COMMANDS} >= {"cluster.yaml", "generate.yaml", "generate.sbatch", "clusters.md"}


@pytest.mark.parametrize(("path", "command"), COMMANDS)
def test_every_command_is_one_of_ours(path: Path, command: str) -> None:
    verb, *arguments = shlex.split(command.strip().rstrip(")."))
    if arguments[:1] == ["$@"]:
        arguments = [*shlex.split("--count 8 --out OUT"), *arguments[1:]]
    known = typer.main.get_command(app)
    assert verb in known.commands, path  # type: ignore[attr-defined]
    known.commands[verb].make_context(verb, arguments)  # type: ignore[attr-defined]


def test_the_launcher_takes_the_cluster_file(recwarn: pytest.WarningsRecorder) -> None:
    config = prepare_config(launcher())
    validate_config(config)
    setup = [*config["setup_commands"], *config["head_setup_commands"], *config["worker_setup_commands"]]
    assert setup == []  # by default Ray installs its latest wheel
    assert config["available_node_types"]["head"]["resources"] == {"CPU": 0}
    assert config["available_node_types"]["spot"]["node_config"]["InstanceMarketOptions"]["MarketType"] == "spot"
    config["available_node_types"]["spot"]["max_wokers"] = 1
    with pytest.raises(Exception, match="max_wokers"):  # the schema does look
        validate_config(config)


SPEC = {
    "entrypoint": str,
    "backoffLimit": int,
    "shutdownAfterJobFinishes": bool,
    "ttlSecondsAfterFinished": int,
    "submissionMode": str,
    "rayClusterSpec": dict,
}
CLUSTER = {
    "rayVersion": str,
    "authOptions": dict,
    "enableInTreeAutoscaling": bool,
    "autoscalerOptions": dict,
    "headGroupSpec": dict,
    "workerGroupSpecs": list,
}
GROUP = {"groupName": str, "replicas": int, "minReplicas": int, "maxReplicas": int, "rayStartParams": dict, "template": dict}
"""Fields of KubeRay's types that are used, by their documented kinds."""


def test_the_rayjob_has_the_fields_of_kuberay() -> None:
    job = rayjob()
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    cluster = job["spec"]["rayClusterSpec"]
    groups = cluster["workerGroupSpecs"]
    for found, known in ((job["spec"], SPEC), (cluster, CLUSTER), *((group, GROUP) for group in groups)):
        assert set(found) <= set(known)
        assert all(isinstance(value, known[key]) for key, value in found.items())
    assert set(cluster["headGroupSpec"]) <= {"rayStartParams", "template"}
    for group in (cluster["headGroupSpec"], *groups):
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
        (container,) = group["template"]["spec"]["containers"]
        assert container["resources"]["requests"] == container["resources"]["limits"]
        assert container["envFrom"] == [{"secretRef": {"name": "stable-data-bucket"}}]
    assert cluster["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"


def test_versions_are_those_of_the_constraints() -> None:
    pinned = dict(re.findall(r"^([\w-]+)==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.MULTILINE))
    assert rayjob()["spec"]["rayClusterSpec"]["rayVersion"] == pinned["ray"]


def test_the_image_is_built_of_what_is_there() -> None:
    lines = (WORKFLOWS / "Dockerfile").read_text("utf-8").splitlines()
    copied = [name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]]
    assert {"Makefile", "pyproject.toml", "constraints.txt"} <= set(copied)
    assert all((ROOT / name).exists() for name in copied)
    assert any("make env LOCKED=1" in line for line in lines)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = {
        project["readme"],
        *(name for name in project["license-files"] if "/" not in name),
        "requirements.lock",
        "requirements-source.lock",
    }
    assert needed <= set(copied)  # else the environment cannot be made
    left_out = (WORKFLOWS / "Dockerfile.dockerignore").read_text("utf-8").split()
    generated = {
        line.strip("/") for line in (ROOT / ".gitignore").read_text("utf-8").split() if line.endswith("/") or line == ".venv"
    }
    assert {name for name in generated if name not in left_out and f"**/{name}" not in left_out} == set()
    assert ".git" in left_out
    launcher_lines = (WORKFLOWS / "ray" / "cluster.yaml").read_text("utf-8")
    assert "/root" not in launcher_lines  # Ray writes files as the user of the image
    assert any("HOME=/home/stable-data" in line for line in lines)
    assert "/home/stable-data/.ray/auth_token" in launcher_lines
    assert lines.index("USER stable-data") > max(k for k, line in enumerate(lines) if line.startswith(("RUN ", "COPY ")))


def test_every_core_that_does_shards_has_the_memory_that_the_page_names() -> None:
    (needed,) = re.findall(r"\*\*(\d+) GiB of memory a core\*\*", (ROOT / "docs" / "clusters.md").read_text("utf-8"))
    found: dict[str, float] = {}
    spot = launcher()["available_node_types"]["spot"]
    assert "CPU" not in spot["resources"]  # all that the machine has
    found["ray"] = {"c": 2, "m": 4, "r": 8}[spot["node_config"]["InstanceType"][0]]  # what AWS gives a core, by family
    for group in rayjob()["spec"]["rayClusterSpec"]["workerGroupSpecs"]:
        (container,) = group["template"]["spec"]["containers"]
        limits = container["resources"]["limits"]
        cores = int(group["rayStartParams"].get("num-cpus", limits["cpu"]))
        found[group["groupName"]] = int(limits["memory"].removesuffix("Gi")) / cores
    (found["slurm"],) = map(int, re.findall(r"^#SBATCH --mem-per-cpu=(\d+)G$", SBATCH.read_text("utf-8"), re.MULTILINE))
    assert all(memory >= int(needed) for memory in found.values()), found


def test_the_batch_script_is_one_that_bash_reads() -> None:
    assert subprocess.run(["bash", "-n", str(SBATCH)], capture_output=True, text=True, check=True).stderr == ""
    options = re.findall(r"^#SBATCH --([\w-]+)", SBATCH.read_text("utf-8"), re.MULTILINE)
    assert {"requeue", "no-kill", "signal", "nodes", "cpus-per-task"} <= set(options)


SRUN = """#!/bin/bash
while [[ $1 == --* ]]; do shift; done
exec "$@"
"""
SCONTROL = """#!/bin/bash
[[ $1 == requeue ]] && touch "$SLURM_SUBMIT_DIR/requeued" || printf 'here\\nthere\\n'
"""


@pytest.fixture
def slurm(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts the batch script with arguments, on two nodes that are both this machine."""
    binaries = tmp_path / "bin"
    binaries.mkdir()
    for name, text in {"srun": SRUN, "scontrol": SCONTROL}.items():
        (binaries / name).write_text(text)
        (binaries / name).chmod(0o755)
    checkout = tmp_path / "checkout"
    (checkout / ".venv" / "bin").mkdir(parents=True)
    (checkout / ".venv" / "bin" / "activate").write_text(f"export PATH={binaries}:{Path(sys.executable).parent}:$PATH\n")
    for package in ("pipelines", "models", "stable_data"):
        (checkout / package).symlink_to(ROOT / package)
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        given = {"SUBMIT_DIR": checkout, "JOB_ID": 4000 + os.getpid(), "JOB_NODELIST": "ignored", "CPUS_PER_TASK": 1}
        process = subprocess.Popen(
            ["bash", str(SBATCH), *arguments],
            env=os.environ | {f"SLURM_{key}": str(value) for key, value in given.items()},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        for pid in below([process.pid]):
            os.kill(pid, signal.SIGKILL)
        process.wait()


@pytest.mark.ray
@pytest.mark.slow
def test_the_batch_script_runs_puts_itself_in_the_queue_again_and_goes_on(
    slurm: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    tasks = tmp_path / "tasks.jsonl"
    row = {"instruction": "Put the apple in the bowl.", "table_type": "dining_table", "table_size_cm": [120, 80]}
    tasks.write_text("".join(json.dumps(row) + "\n" for _ in range(6)))
    settings = ("weights=none", "settle=false", "accept=clean", "scenes_per_shard=1", "num_pictures=0")
    job = ["--tasks", str(tasks), *(f"--set={setting}" for setting in settings), "--out"]
    out = tmp_path / "out"
    first = slurm(*job, str(out))
    while len(RunFolder(str(out)).shard_ids("scenes")) < 2:
        assert first.poll() is None, first.communicate()[0]
        time.sleep(0.5)
    os.kill(first.pid, signal.SIGUSR1)
    said, _ = first.communicate(timeout=120)
    assert first.returncode == 0, said
    assert (tmp_path / "checkout" / "requeued").is_file()
    second = slurm(*job, str(out))
    said, _ = second.communicate(timeout=600)
    assert second.returncode == 0, said
    command = [sys.executable, "-m", "pipelines", "generate", *job, str(tmp_path / "clean"), "--workers", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode in (DONE, SOME_FAILED), done.stderr
    found = compared(RunFolder(str(tmp_path / "clean")), RunFolder(str(out)))
    assert found.pop("rows") > 0
    assert not any(found.values()), found
