"""The verbs of ``python -m pipelines`` that have a robot: demonstrate and evaluate-policy."""

import json
from pathlib import Path
from typing import Annotated

import typer

from pipelines.job_options import DryRun, JobSettings, worker_count
from stable_data.cli import SOME_FAILED, Address, with_clear_errors


@with_clear_errors
def demonstrate(
    scenes: Annotated[
        str,
        typer.Option(help="A run with the tables scenes, assets and meshes, such as one of generate; every node must see it."),
    ],
    out: Annotated[str, typer.Option(help="Run folder: a path that every node sees, or a URI such as s3://bucket/prefix.")],
    where: Annotated[str, typer.Option(help="Which scenes, such as \"task_graspable and split == 'train'\".")] = "",
    robot: Annotated[
        str | None,
        typer.Option(help="panda, panda_2f85, so101 or simple (stable-data robots); overrides the file. Default: panda."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table demonstrate is read.")] = None,
    set_: JobSettings = None,
    workers: Annotated[
        int,
        typer.Option(
            help="Worker processes on a local Ray, or shards at once with --address. -1: one for each core. 0: this process."
        ),
    ] = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Let a robot carry out the tasks of scenes, and record the episodes. Run again to continue after a stop.

    A scripted expert grasps, moves and places. Successful and failed episodes are in the table episodes, with the reason of each
    failure; `stable-data export OUT DIR --format lerobot` writes them as a LeRobotDataset. Status 0: done. 1: some episodes could not
    begin; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.demonstrate.job import DemonstrateJob
    from pipelines.demonstrate.job import demonstrate as run
    from pipelines.demonstrate.settings import DemonstrateSettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings

    count = worker_count(workers, address)
    asked = [f"robot={json.dumps(robot)}"] if robot is not None else []
    settings = resolve_settings(DemonstrateSettings, "demonstrate", config, [*(set_ or []), *asked])
    if dry_run:
        typer.echo(json.dumps(describe(DemonstrateJob(scenes, settings, where)), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    typer.echo(
        f"{out}: {counts['episodes']} of {manifest['num_episodes']} episodes in {manifest['num_scenes']} scenes, {counts['successes']} "
        f"fulfil their goal; {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    for kind, (done, total) in counts["by_task"].items():
        typer.echo(f"  {kind:<14} {done} of {total}")
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
    scenes: Annotated[
        str,
        typer.Option(help="A run with the tables scenes, assets and meshes, such as one of generate; every node must see it."),
    ],
    out: Annotated[str, typer.Option(help="Run folder: a path that every node sees, or a URI such as s3://bucket/prefix.")],
    where: Annotated[str, typer.Option(help="Which scenes, such as \"task_graspable and split == 'test'\".")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table evaluate_policy is read.")] = None,
    set_: JobSettings = None,
    workers: Annotated[
        int,
        typer.Option(
            help="Worker processes on a local Ray, or shards at once with --address. -1: one for each core. 0: this process."
        ),
    ] = -1,
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
        typer.echo(json.dumps(describe(EvaluatePolicyJob(policy, scenes, settings, where)), indent=2))
        return
    manifest = run(policy, scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    low, high = counts["interval"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    typer.echo(
        f"{out}: {manifest['policy']} fulfils its goal in {counts['successes']} of {counts['attempts']} episodes ({low:.0%} to {high:.0%}) "
        f"in {manifest['num_scenes']} scenes; {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    for key in ("by_task_kind", "by_assets"):
        for name, (done, total) in counts[key].items():
            typer.echo(f"  {name:<22} {done} of {total}")
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)
