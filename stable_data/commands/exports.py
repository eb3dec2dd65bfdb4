"""Commands that export and show scenes."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stable_data.commands.command_line import SOME_FAILED, echo, with_clear_errors
from stable_data.errors import ConfigError

if TYPE_CHECKING:
    from stable_data.robot.lerobot.dataset_writer import EpisodeSelection
    from stable_data.simulation.run_reader import SceneSelection
    from stable_data.storage.run_folder import RunFolder

app = typer.Typer()
_PANEL = "Export and show scenes"


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def export(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Output folder; run again to continue.")],
    format_name: Annotated[
        str,
        typer.Option(
            "--format",
            help="Output format: mjcf, mjcf-objects (robosuite, RoboCasa), usd, sdformat, urdf, arena (Isaac Lab-Arena), glb, "
            "mesatask; manipvqa: pictures with the boxes of handles; lance: the rows as a Lance dataset; lerobot: the successful "
            "episodes as a LeRobotDataset v3.0; envhub: environments for LeRobot's EnvHub; or original: the scene files that were "
            "imported, with the new poses.",
        ),
    ],
    flavour: Annotated[str | None, typer.Option(help="Variant of the format for one consumer; usd has isaaclab.")] = None,
    where: Annotated[
        str | None,
        typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2"; with lerobot, on episodes.'),
    ] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", help="Export only this scene; may be repeated.")] = None,
    limit: Annotated[
        int | None,
        typer.Option(
            min=0, help="At most this many of the selected scenes; with --join, pieces of furniture; with lerobot, episodes."
        ),
    ] = None,
    settled: Annotated[bool, typer.Option(help="Use the poses after the simulation in MuJoCo (table settled).")] = False,
    join: Annotated[bool, typer.Option(help="Export the scenes on one piece of furniture as one scene, others not.")] = False,
    originals: Annotated[Path | None, typer.Option(help="Folder of the scene files, for the format original.")] = None,
    cached: Annotated[
        bool, typer.Option("--cached", help="Copy scenes that did not change from the user's cache, and add others to it.")
    ] = False,
    failures: Annotated[bool, typer.Option("--failures", help="lerobot: export failed episodes too.")] = False,
    video: Annotated[bool, typer.Option("--video", help="lerobot: pictures as videos (AV1), by PyAV or ffmpeg.")] = False,
    robot: Annotated[
        str | None, typer.Option(help="envhub: the robot; `stable-data robots` lists them. Default: panda.")
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", help="envhub: a camera that is observed: wrist, front or top; may be repeated."),
    ] = None,
) -> None:
    """Export scenes of a run to another format, with all files that they need, or its episodes.

    Status 0: done. 1: some scenes could not be exported; they are listed. 2: could not start.
    """
    from stable_data.storage.run_folder import RunFolder

    if flavour is not None:
        format_name = f"{format_name}:{flavour}"
    if format_name == "lerobot":
        if settled or join or cached:
            raise ConfigError("--format lerobot writes episodes as they are; leave out --settled, --join and --cached", "usage")
        from stable_data.robot.lerobot.dataset_writer import EpisodeSelection

        selection = EpisodeSelection(where, tuple(scene or ()), limit, failures)
        _export_lerobot(RunFolder(run), out, selection, is_video=video)
        return
    if format_name == "envhub":
        if settled or join or cached or scene or limit is not None:
            raise ConfigError("--format envhub takes --where, --robot and --camera alone; leave the others out", "usage")
        _export_envhub(RunFolder(run), out, where, robot or "panda", camera or ())
        return
    if robot is not None or camera:
        raise ConfigError("--robot and --camera are options of --format envhub; leave them out", "usage")
    if failures or video:
        raise ConfigError("--failures and --video are options of --format lerobot; leave them out", "usage")
    if format_name == "lance":  # needs neither geometry nor simulation
        if settled or join:
            raise ConfigError("--format lance writes the rows as they are; leave out --settled and --join", "usage")
        export_lance(RunFolder(run), out, where, scene or (), limit)
        return
    from stable_data.simulation.run_reader import SceneSelection

    if format_name == "original":
        if join:
            raise ConfigError("--join makes new scenes, which original does not know; leave it out", "usage")
        _export_originals(run, out, SceneSelection(where, tuple(scene or ()), limit), originals)
        return
    chosen = SceneSelection(where, tuple(scene or ()), limit, settled, join)
    export_scenes(RunFolder(run), out, format_name, chosen, is_cached=cached)


def export_scenes(run: "RunFolder", out: Path, format_name: str, choice: "SceneSelection", *, is_cached: bool) -> None:
    """Exports scenes, prints what was done, and exits with status 1 if some could not be exported."""
    from tqdm import tqdm

    from stable_data.export.exporter import export_run

    with tqdm(desc="export", unit="scene", disable=None) as bar:

        def show(done: int, total: int, num_failed: int) -> None:
            bar.total = total
            bar.update(done - bar.n)
            bar.set_postfix_str(f"{num_failed} failed" if num_failed else "", refresh=False)

        result = export_run(run, out, format_name, choice, show, is_cached=is_cached)
    for line in result.failures:
        echo(f"not exported: {line}", err=True)
    if result.warning is not None:
        echo(f"warning: {result.warning}", err=True)
    echo(
        f"{out}: {result.num_written + result.num_existing} of {result.total} scenes as {format_name}, "
        f"{result.num_existing} of them existed already; "
        + (f"{result.num_cached} were copied from the cache; " if is_cached else "")
        + "README.md explains how to open them"
        + (f"; {result.num_boxes} objects have no mesh and are boxes" if result.num_boxes else "")
    )
    if result.failures:
        raise typer.Exit(SOME_FAILED)


def export_lance(
    run: "RunFolder", out: Path, where: str | None, scene_ids: Sequence[str] = (), limit: int | None = None
) -> None:
    """Writes scenes as a Lance dataset, and prints their number."""
    from stable_data.export.lance_table import LANCE_FOLDER, write_lance

    count = write_lance(run, out, where, scene_ids, limit)
    echo(f"{out}: {count} scenes in {LANCE_FOLDER}")


def _export_lerobot(run: "RunFolder", out: Path, choice: "EpisodeSelection", *, is_video: bool) -> None:
    from tqdm import tqdm

    from stable_data.robot.lerobot.dataset_writer import write_lerobot

    with tqdm(desc="export", unit="episode", disable=None) as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        result = write_lerobot(run, out, choice, show, is_video=is_video)
    echo(
        f"{out}: {result.num_episodes} episodes as a LeRobotDataset v3.0, {result.num_frames} frames, {result.num_tasks} tasks"
        + (f"; {result.num_failed} failed episodes are left out, --failures exports them too" if result.num_failed else "")
    )


def _export_envhub(run: "RunFolder", out: Path, where: str | None, robot: str, cameras: Sequence[str]) -> None:
    from stable_data.robot.env import RobotOptions
    from stable_data.robot.envhub import write_envhub

    counts = write_envhub(run, out, where, RobotOptions(robot=robot, cameras=tuple(cameras)))
    tasks = ", ".join(f"{kind} {count}" for kind, count in counts.items())
    echo(f"{out}: {sum(counts.values())} scenes with goals ({tasks}) as environments; env.py has make_env")


def _export_originals(run: str, out: Path, choice: "SceneSelection", originals: Path | None) -> None:
    from stable_data.importers.scenes.originals import export_originals
    from stable_data.storage.run_folder import RunFolder

    if originals is None:
        raise ConfigError("--format original needs the folder of the scene files; name it with --originals", "usage")
    result = export_originals(RunFolder(run), originals, out, choice)
    for line in result.failures:
        echo(f"not exported: {line}", err=True)
    echo(f"{out}: {result.num_written} scene files, {result.num_moved} bodies moved")
    if result.failures:
        raise typer.Exit(SOME_FAILED)


_PAGE_SCENES = 12
"""Scenes of a page unless their number is given."""


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def view(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    page: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with the scenes, which opens without a network.")
    ] = None,
    live: Annotated[bool, typer.Option(help="Start the live viewer, which pages through all scenes.")] = False,
    where: Annotated[str | None, typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2".')] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", help="Show only this scene; may be repeated.")] = None,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Show at most this many of the selected scenes; a page by default 12.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the live viewer; 0: any free one.")] = 8080,
    host: Annotated[
        str, typer.Option(help="Address of the live viewer; 0.0.0.0 also lets other machines look at the run.")
    ] = "127.0.0.1",
) -> None:
    """Look at scenes in a browser: a page (--page) or a live viewer (--live), with their objects, relations and verdicts.

    Status 0: done. 1: some scenes cannot be shown; they are listed. 2: could not start.
    """
    from stable_data.simulation.run_reader import SceneSelection
    from stable_data.storage.run_folder import RunFolder

    if (page is None) != live:
        raise ConfigError("view makes a page or starts a viewer; pass either --page FILE.html or --live", "usage")
    if page is None:
        from stable_data.viewer.live import serve

        serve(RunFolder(run), SceneSelection(where, tuple(scene or ()), limit), host, port, echo)
        return
    from stable_data.viewer.page import write_run_page

    most = limit or (None if scene else _PAGE_SCENES)
    failures = write_run_page(RunFolder(run), SceneSelection(where, tuple(scene or ()), most), page)
    for line in failures:
        echo(f"not shown: {line}", err=True)
    echo(f"{page}: {page.stat().st_size / 1e6:.1f} MB; open it in a browser")
    if failures:
        raise typer.Exit(SOME_FAILED)
