"""The command line of the jobs that evaluate."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.job_options import DryRun, JobSettings, NumWorkers, RunOfScenes, RunOut, worker_count
from stable_data.commands.command_line import SOME_FAILED, Address, echo, with_clear_errors
from stable_data.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.sources.generation_tasks import TaskSource


@with_clear_errors
def views(
    scenes: RunOfScenes,
    out: RunOut,
    where: Annotated[str, typer.Option(help="Which scenes, such as \"clean and split == 'test'\".")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table views is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Draw the scenes of a run from the front and in perspective, and describe the pictures. Run again to continue after a stop.

    Pictures and features are in the table views, for distances between sets of pictures (FID, KID) and their diversity. Status 0:
    done. 1: some scenes could not be drawn; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings
    from pipelines.views.job import ViewsJob, draw_views
    from pipelines.views.settings import ViewsSettings

    count = worker_count(workers, address)
    settings = resolve_settings(ViewsSettings, "views", config, set_ or [])
    if dry_run:
        echo(json.dumps(describe(ViewsJob(scenes, settings, where)), indent=2))
        return
    manifest = draw_views(scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    echo(
        f"{out}: {counts['views']} of {manifest['num_scenes']} scenes drawn, features {manifest['features']}, {counts['failures']} "
        "failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@with_clear_errors
def rate(
    scenes: RunOfScenes,
    out: RunOut,
    where: Annotated[str, typer.Option(help="Which scenes, such as \"split == 'test'\".")] = "",
    judge: Annotated[
        str | None,
        typer.Option(
            help="symbolic (rules on the geometry), or openai:MODEL, a model that sees pictures (--set rating.http.base_url=URL, and "
            "rating.http.key_variable=NAME of the variable that holds the key); overrides the file. Default: symbolic."
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table rate is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Rate scenes by the five criteria of the paper's GPT-score. Run again to continue after a stop.

    The table ratings has a row for each scene: the scores with their rationales, their average, and whether the scene passes (clean
    with an average above 7). What cannot be scored is null, with a code and the reason. Status 0: done. 1: some scenes could not be
    used; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.rate.job import RateJob
    from pipelines.rate.job import rate as run
    from pipelines.rate.settings import RateSettings
    from pipelines.settings import resolve_settings
    from stable_data.rating.criteria import KEYS

    count = worker_count(workers, address)
    asked = [f"rating.judge={json.dumps(judge)}"] if judge is not None else []
    settings = resolve_settings(RateSettings, "rate", config, [*(set_ or []), *asked])
    if dry_run:
        echo(json.dumps(describe(RateJob(scenes, settings, where)), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    unknown = ", ".join(f"{code} {n}" for code, n in counts["unknown_by_code"].items())
    means = ", ".join(f"{key.upper()} {counts['averages'][key]:.1f}" for key in KEYS if key in counts["averages"])
    average = "unknown" if counts["average"] is None else f"{counts['average']:.1f}"
    num_unknown = counts["ratings"] - counts["rated"]
    echo(
        f"{out}: {counts['judge']} rated {counts['rated']} of {manifest['num_scenes']} scenes, average {average}"
        f"{f' ({means})' if means else ''}; {counts['passed']} of {counts['passes_known']} pass; {num_unknown} unknown"
        f"{f' ({unknown})' if unknown else ''}, {counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@with_clear_errors
def evaluate(
    out: RunOut,
    count: Annotated[
        int | None, typer.Option(help="Sample this many tasks of the embedded world, others for each repetition.")
    ] = None,
    tasks: Annotated[Path | None, typer.Option(help="A file of tasks, as generate reads it.")] = None,
    scenes: Annotated[str | None, typer.Option(help="Take the tasks of the scenes of this run or MesaTask-10K folder.")] = None,
    where: Annotated[str, typer.Option(help="Which scenes of a run, such as \"split == 'test'\".")] = "",
    table: Annotated[
        list[str] | None, typer.Option(help="Table type of the tasks of --count; may be repeated. Default: all.")
    ] = None,
    assets: Annotated[
        list[str] | None, typer.Option(help="Asset library, as for generate; may be repeated. Default: embedded.")
    ] = None,
    system: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=ENGINE]",
            help="A system (docs/systems.md), with its own engine if it needs one: mesatask=transformers:FOLDER; files=PLACE for "
            "layouts of another system; LABEL:NAME=… to have one twice. May be repeated. Default: all; what lacks its model is not run.",
        ),
    ] = None,
    engine: Annotated[
        str | None, typer.Option(help="The engine of all other systems, as for generate. Default: embedded.")
    ] = None,
    judge: Annotated[
        str | None, typer.Option(help="Who rates, as for rate: symbolic, or openai:MODEL. Default: symbolic.")
    ] = None,
    reference: Annotated[
        str | None, typer.Option(metavar="RUN", help="Scenes whose pictures those of the systems are compared with (FID, KID).")
    ] = None,
    repetitions: Annotated[int | None, typer.Option(help="How often all is repeated with another seed. Default: 1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the first repetition. Default: 0.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table evaluate is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Compare systems on the same tasks: the paper's Table 1 and more. Run again to continue after a stop, or to add systems.

    Each system generates, is drawn and is rated; what cannot be had is unknown, with a note that says how to supply it. Status 0: done. 1:
    something that was asked for could not be done. 2: could not start.
    """
    from pipelines.evaluate.job import evaluate as run
    from pipelines.evaluate.job import plan
    from pipelines.evaluate.report import evaluation_text
    from pipelines.evaluate.settings import EvaluateSettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.settings import resolve_settings

    options = {
        "systems": system,
        "generate.engine.engine": engine,
        "rate.rating.judge": judge,
        "reference": reference,
        "repetitions": repetitions,
        "generate.seed": seed,
    }
    asked = [f"{key}={json.dumps(value)}" for key, value in options.items() if value is not None]
    settings = resolve_settings(EvaluateSettings, "evaluate", config, [*(set_ or []), *asked])
    source = _TaskChoice(count, tasks, scenes, where, tuple(table or ()))
    pool = WorkerPool(worker_count(workers, address), address)
    if dry_run:
        echo(json.dumps(plan(source, settings, assets or ()), indent=2))
        return
    found = run(source, out, settings, pool, assets or ())
    echo(evaluation_text(found))
    echo(f"{out}/evaluation.json, {out}/report/index.html")
    if found.has_failed:
        raise typer.Exit(SOME_FAILED)


class _TaskChoice:
    """The tasks that were chosen on the command line, by the seed of a repetition."""

    def __init__(self, count: int | None, file: Path | None, scenes: str | None, where: str, tables: tuple[str, ...]) -> None:
        if sum(source is not None for source in (count, file, scenes)) != 1:
            raise ConfigError("an evaluation needs its tasks, expected one of --count, --tasks and --scenes", "usage")
        if where and scenes is None:
            raise ConfigError("--where chooses scenes of --scenes; leave it out", "usage")
        if tables and count is None:
            raise ConfigError("--table is for tasks of --count; leave it out", "usage")
        self._count, self._file, self._scenes, self._where, self._tables = count, file, scenes, where, tables

    def __call__(self, seed: int) -> "TaskSource":
        from pipelines.sources.generation_tasks import sample_tasks, tasks_of_file, tasks_of_scenes

        if self._file is not None:
            return tasks_of_file(self._file)
        if self._scenes is not None:
            return tasks_of_scenes(self._scenes, self._where)
        return sample_tasks(self._count or 0, seed, self._tables)
