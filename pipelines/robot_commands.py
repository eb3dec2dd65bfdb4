"""The command line of the jobs with a robot."""

import json
from pathlib import Path
from typing import Annotated

import typer

from pipelines.job_options import DryRun, JobSettings, NumWorkers, RunOfScenes, RunOut, worker_count
from stable_data.commands.command_line import SOME_FAILED, Address, echo, with_clear_errors
from stable_data.errors import ConfigError

RobotName = Annotated[
    str | None,
    typer.Option(help="panda, panda_2f85, so101 or simple (stable-data robots); overrides the file. Default: panda."),
]


@with_clear_errors
def demonstrate(
    scenes: RunOfScenes,
    out: RunOut,
    where: Annotated[str, typer.Option(help="Which scenes, such as \"task_graspable and split == 'train'\".")] = "",
    robot: RobotName = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table demonstrate is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    lerobot: Annotated[
        bool, typer.Option("--lerobot", help="Also write the successful episodes as a LeRobotDataset v3.0 to OUT/lerobot.")
    ] = False,
    dry_run: DryRun = False,
) -> None:
    """Let a robot carry out the tasks of scenes, and record the episodes. Run again to continue after a stop.

    A scripted expert grasps, moves and places. Successful and failed episodes are in the table episodes, with the reason of each
    failure; --lerobot, or later `stable-data export OUT DIR --format lerobot`, writes a LeRobotDataset.

    Status 0: done. 1: some episodes could not begin; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.demonstrate.job import DemonstrateJob
    from pipelines.demonstrate.job import demonstrate as run
    from pipelines.demonstrate.settings import DemonstrateSettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings
    from stable_data.robot.lerobot.dataset_writer import write_lerobot
    from stable_data.storage.run_folder import RunFolder

    if lerobot and "://" in out:
        raise ConfigError(f"--out is {out}, but --lerobot writes to a local folder; leave it out and export later", "usage")
    count = worker_count(workers, address)
    asked = [f"robot={json.dumps(robot)}"] if robot is not None else []
    settings = resolve_settings(DemonstrateSettings, "demonstrate", config, [*(set_ or []), *asked])
    if dry_run:
        echo(json.dumps(describe(DemonstrateJob(scenes, settings, where)), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    echo(
        f"{out}: {counts['episodes']} of {manifest['num_episodes']} episodes in {manifest['num_scenes']} scenes, {counts['successes']} "
        f"fulfil their goal; {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    for kind, (done, total) in counts["by_task"].items():
        echo(f"  {kind:<14} {done} of {total}")
    dataset = Path(out) / "lerobot"
    if lerobot and not counts["successes"]:
        echo(f"{dataset}: not written, because no episode fulfils its goal", err=True)
    elif lerobot and not dataset.exists():
        made = write_lerobot(RunFolder(out), dataset)
        echo(f"{dataset}: {made.num_episodes} episodes as a LeRobotDataset v3.0")
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@with_clear_errors
def reach(
    scenes: RunOfScenes,
    out: RunOut,
    robot: RobotName = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table reach is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Find what a robot reaches and holds in the scenes of a run. Run again to continue after a stop.

    OUT is a run with all scenes and their assets; its table scenes has the columns task_reachable, task_graspable, task_reason and
    others, its table grasps the grasps that were tried. Status 0: done. 1: some scenes could not be surveyed; the table failures gives
    the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.reach.job import ReachJob
    from pipelines.reach.job import reach as run
    from pipelines.reach.settings import ReachSettings
    from pipelines.settings import resolve_settings

    count = worker_count(workers, address)
    asked = [f"robot={json.dumps(robot)}"] if robot is not None else []
    settings = resolve_settings(ReachSettings, "reach", config, [*(set_ or []), *asked])
    if dry_run:
        echo(json.dumps(describe(ReachJob(scenes, settings)), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address))
    counts = manifest["counts"]
    echo(
        f"{out}: {counts['scenes']} of {manifest['num_scenes']} scenes surveyed, {counts['task_reachable']} tasks reachable, "
        f"{counts['task_graspable']} graspable, {counts['grasps']} grasps tried, {counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@with_clear_errors
def evaluate_policy(
    policy: Annotated[
        str,
        typer.Option(
            help="A folder of train-policy; module:function, which makes an object with reset() and act(observation); or expert. Every "
            "node must see it."
        ),
    ],
    scenes: RunOfScenes,
    out: RunOut,
    where: Annotated[str, typer.Option(help="Which scenes, such as \"task_graspable and split == 'test'\".")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table evaluate_policy is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Let a policy act in scenes, and count its successes. Run again to continue after a stop.

    The episodes are in the table episodes; the report gives success by task, asset and scene. Robot and control are those of the
    policy. Status 0: done. 1: some episodes could not begin, or the policy crashed in them; the table failures gives the reasons. 2:
    could not start.
    """
    from pipelines.evaluate_policy.job import EvaluatePolicyJob, settings_for
    from pipelines.evaluate_policy.job import evaluate_policy as run
    from pipelines.evaluate_policy.settings import EvaluatePolicySettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings

    count = worker_count(workers, address)
    settings = resolve_settings(EvaluatePolicySettings, "evaluate_policy", config, set_ or [], settings_for(policy))
    if dry_run:
        echo(json.dumps(describe(EvaluatePolicyJob(policy, scenes, settings, where)), indent=2))
        return
    manifest = run(policy, scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    low, high = counts["interval"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    echo(
        f"{out}: {manifest['policy']} fulfils its goal in {counts['successes']} of {counts['attempts']} episodes ({low:.0%} to {high:.0%}) "
        f"in {manifest['num_scenes']} scenes; {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    for key in ("by_task_kind", "by_assets"):
        for name, (done, total) in counts[key].items():
            echo(f"  {name:<22} {done} of {total}")
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)
