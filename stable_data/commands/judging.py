"""Commands that judge scenes."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from stable_data.commands.command_line import SOME_FAILED, echo, with_clear_errors
from stable_data.errors import ConfigError

app = typer.Typer()
_PANEL = "Judge scenes"


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def lint(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder in the MesaTask-10K format, or of scene files (MuJoCo, USD, glTF).")
    ],
    table: Annotated[Path | None, typer.Option(metavar="FILE", help="Output file with one row per scene (Parquet).")] = None,
    quiet: Annotated[bool, typer.Option(help="Show no progress bar.")] = False,
) -> None:
    """Audit every scene exactly: collisions with their depths, floating and sunk objects, objects out of bounds.

    The audit runs in this process: a file that crashes its parser ends the command.

    Status 0: all scenes were judged. 1: some are not usable and are listed. 2: there is no scene, or could not start.
    """
    from stable_data.mesatask.lint import lint_folder, prepare_place
    from stable_data.mesatask.writing import LAYOUT_FOLDER

    if table is not None:
        prepare_place(table)
    shows_progress = not quiet and sys.stderr.isatty()
    if folder.is_dir() and not (folder / LAYOUT_FOLDER).exists():
        from stable_data.importers.scenes.lint import lint_scene_files, scene_candidates

        result = lint_scene_files(folder, scene_candidates(folder), progress=shows_progress)
    else:
        result = lint_folder(folder, progress=shows_progress)
    echo(str(result))
    if table is not None:
        result.write(table)
    if result.failures:
        raise typer.Exit(SOME_FAILED)


@app.command("diversity", rich_help_panel=_PANEL)
@with_clear_errors
def compare_diversity(
    runs: Annotated[list[str], typer.Argument(metavar="RUN...", help="Runs with the table scenes: folders or URIs.")],
    where: Annotated[str | None, typer.Option(help='Only scenes that satisfy this, for example "clean".')] = None,
    limit: Annotated[int, typer.Option(min=0, help="Most scenes of a run; of more, so many are drawn. 0: all.")] = 20_000,
    sample: Annotated[int, typer.Option(min=1, help="Scenes of which a Vendi score is computed.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the draws.")] = 0,
    table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Output file with the group of near-duplicates of each scene (Parquet).")
    ] = None,
    figures: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Output file of the figures.")] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="RUNs are runs of the job views; compare their pictures instead of layouts.")
    ] = False,
    alike: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="With --pictures: least cosine of near-duplicates. Default: that of the features."),
    ] = None,
) -> None:
    """Say how diverse runs are, and which scenes are near-duplicates, within a run, between splits and between runs.

    Two scenes are near-duplicates if nine tenths of their objects have a counterpart of the same category within 2 cm. In the
    table, group_split is a split that all scenes of a group have, in all of the runs. With --pictures, pictures are near-duplicates
    whose features point in nearly the same direction.
    """
    import json
    from dataclasses import replace

    import polars as pl

    from stable_data.diversity.comparison import compare_sets
    from stable_data.diversity.scene_set import SceneSet, whole_library
    from stable_data.mesatask.dataset_split import split_of
    from stable_data.mesatask.lint import prepare_place

    if len(set(runs)) < len(runs):
        raise ConfigError(f"runs are {runs}, expected no duplicates", "usage")
    for file in (table, figures):
        if file is not None:
            prepare_place(file)
    if pictures:
        from stable_data.diversity.pictures import PictureSet, compare_pictures

        if where is not None:
            raise ConfigError("--where chooses scenes, expected no --pictures; choose them in the job views", "usage")
        seen = compare_pictures([PictureSet.read(run) for run in runs], alike=alike, sample=sample, seed=seed)
        echo(str(seen))
        if table is not None:
            pl.DataFrame(list(seen.groups)).write_parquet(table)
        if figures is not None:
            figures.write_text(json.dumps(seen.figures(), indent=2) + "\n", "utf-8")
        return
    if alike is not None:
        raise ConfigError("--alike is a limit for pictures, expected --pictures", "usage")
    read = [replace(SceneSet.read(run, where=where, limit=limit, seed=seed), library=whole_library(run)) for run in runs]
    found = compare_sets(read, sample=sample, seed=seed)
    echo(str(found))
    if table is not None:
        groups = [row | {"group_split": split_of(row["group"], row["table_type"])} for row in found.groups]
        # The type of a column does not follow from its first rows: runs may have no splits.
        pl.DataFrame(groups, schema_overrides={"split": pl.String}).write_parquet(table)
    if figures is not None:
        figures.write_text(json.dumps(found.figures(), indent=2) + "\n", "utf-8")


@app.command("judge", rich_help_panel=_PANEL)
@with_clear_errors
def judge_scenes(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    judges: Annotated[
        str, typer.Option(help="Physics engines, joined by commas: mujoco, sapien (PhysX), drake.")
    ] = "mujoco,sapien",
    arbiter: Annotated[str, typer.Option(help="A further judge, which is asked only where the others disagree.")] = "",
    where: Annotated[str | None, typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2".')] = None,
    limit: Annotated[int | None, typer.Option(min=0, help="At most this many of the selected scenes.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Output file with one row per scene (Parquet).")] = None,
) -> None:
    """Ask physics engines whether the scenes of a run stay at rest, and list those on which they disagree.

    Status 0: done. 1: a judge could not judge some scenes; they count as unknown. 2: could not start.
    """
    from tqdm import tqdm

    from stable_data.judges import run_verdicts
    from stable_data.judges.registry import check_judges, describe
    from stable_data.mesatask.lint import prepare_place
    from stable_data.simulation.run_reader import RunScenes, SceneSelection
    from stable_data.storage.run_folder import RunFolder

    names = check_judges(judges, arbiter)
    if not names:
        raise ConfigError("--judges names no judge, expected some of mujoco, sapien, drake", "usage")
    if out is not None:
        prepare_place(out)
    scenes = RunScenes(RunFolder(run), SceneSelection(where, limit=limit))
    if not len(scenes):
        raise ConfigError(f"{run}: no scene is selected, expected at least one; change --where or --limit", "scene_unknown")
    asked = run_verdicts.judge_run(scenes, names, arbiter)
    found = list(tqdm(asked, desc="judge", unit="scene", total=len(scenes), disable=None))
    for pair, words, count in run_verdicts.agreement(found, names):
        echo(f"{pair}: {words}: {count} scenes")
    for scene_id, verdicts in run_verdicts.disagreements(found):
        echo(f"{scene_id}: {describe(verdicts)}")
    if out is not None:
        run_verdicts.write_verdicts(found, [*names, *([arbiter] if arbiter else [])], out)
    num_unknown = sum(
        not set(names) <= verdicts.keys() or None in {v.stable for v in verdicts.values()} for _, verdicts in found
    )
    echo(f"{run}: {len(found)} scenes judged by {', '.join(names)}, {num_unknown} with an unknown verdict")
    if num_unknown:
        for scene_id, verdicts in found:
            if not verdicts or None in {verdict.stable for verdict in verdicts.values()}:
                echo(f"unknown: {scene_id}: {describe(verdicts) or 'an object has no solid part'}", err=True)
        raise typer.Exit(SOME_FAILED)


@app.command("tasks", rich_help_panel=_PANEL)
@with_clear_errors
def compile_tasks(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    where: Annotated[str | None, typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2".')] = None,
    limit: Annotated[int | None, typer.Option(min=0, help="At most this many of the selected scenes.")] = None,
    examples: Annotated[int, typer.Option(min=0, help="Examples of each kind of goal and of each reason.")] = 1,
) -> None:
    """Compile the tasks of a run into goals that can be checked; print how many compile, by kind, and why others do not.

    Status 0: done. 2: could not start, or no scene is selected.
    """
    from collections import Counter

    from tqdm import tqdm

    from stable_data.storage.run_folder import RunFolder
    from stable_data.tasks.run_goals import goals_table, run_goals

    found = list(tqdm(run_goals(RunFolder(run), where, limit), desc="compile", unit="task", disable=None))
    if not found:
        raise ConfigError(f"{run}: no scene is selected, expected at least one; change --where or --limit", "scene_unknown")
    echo(goals_table(found))
    shown: Counter[str] = Counter()
    for one in found:
        key = one.code if one.goal is None else str(one.goal.kind)
        if shown[key] < examples:
            shown[key] += 1
            task = None if one.scene is None else one.scene.task
            echo(f"\n{'a scene' if one.scene is None else one.scene.scene_id}: {'no task' if task is None else task.task}")
            echo(f"  {one.message}" if one.goal is None else f"  {one.goal}")
            for step in () if one.goal is None else one.goal.steps:
                echo(f"    {step}")


@app.command("score-boxes", rich_help_panel=_PANEL)
@with_clear_errors
def score_boxes(
    labels: Annotated[Path, typer.Argument(metavar="LABELS", help="manipvqa.json of export --format manipvqa.")],
    boxes: Annotated[
        Path,
        typer.Argument(
            metavar="BOXES",
            help="JSON list: image, category or question, box, score; or COCO results.",
        ),
    ],
    category: Annotated[
        list[str] | None, typer.Option("--category", help="Only this category, such as kettle; may be repeated.")
    ] = None,
    figures: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Output file of the figures.")] = None,
) -> None:
    """Score the boxes of a detector by their average precision at overlaps of 0.5 and 0.75, by category.

    A box has left, top, right and bottom, as shares of the picture or as pixels. What ManipVQA writes is read too, and results in COCO's
    format: image_id, a file name or the number of the picture in the order of LABELS, from 1; category_id, the number of the category
    in alphabetical order, from 1, or category; bbox, left, top, width and height in pixels; and score. Boxes of pictures and categories
    that LABELS does not have are left out and told.

    Status 0: done. 2: a file cannot be used, or no box belongs to a question, from which no score follows.
    """
    import json
    from dataclasses import asdict

    from stable_data.mesatask.lint import prepare_place
    from stable_data.scores.detection import OVERLAPS, read_detections, read_labels, score_detections

    if figures is not None:
        prepare_place(figures)
    known = read_labels(labels)
    found = read_detections(boxes, known)
    for line in found.warnings:
        echo(f"warning: {line}", err=True)
    if category and (strange := sorted(set(category) - {label.category for label in known})):
        raise ConfigError(f"{labels} has no {', '.join(strange)}, expected some of its categories", "usage")
    scores = [s for s in score_detections(known, found.boxes) if not category or s.category in category]
    head = [*(f"AP@{at}" for at in OVERLAPS), *(f"running@{at}" for at in OVERLAPS)]
    echo(f"{'object':<20} {'labels':>6} {'boxes':>6} {'  '.join(head)}")
    for one in scores:
        values = [one.precision[at] for at in OVERLAPS] + [one.running_precision[at] for at in OVERLAPS]
        cells = "  ".join(f"{value:>{len(name)}.2f}" for name, value in zip(head, values, strict=True))
        echo(f"{one.category:<20} {one.labels:>6} {one.detections:>6} {cells}")
    if figures is not None:
        figures.write_text(json.dumps([asdict(one) for one in scores], indent=2) + "\n", "utf-8")
