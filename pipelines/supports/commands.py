"""The command ``supports``."""

from pathlib import Path
from typing import Annotated

import typer

from pipelines.supports import SECONDS_PER_ITEM
from stable_data.commands.command_line import SOME_FAILED, echo, with_clear_errors


@with_clear_errors
def supports(
    library: Annotated[str, typer.Argument(metavar="LIBRARY", help="A library with furniture, such as one that import made.")],
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder or URI of the run; generate --supports takes it.")],
    asset: Annotated[
        list[str] | None,
        typer.Option(metavar="ID", help="A support; may be repeated. Default: all assets that are fixed furniture, or all."),
    ] = None,
    table: Annotated[
        str,
        typer.Option(
            metavar="TYPE", help="Table type of the surfaces, such as office_table. Default: by the asset's category."
        ),
    ] = "",
    surface: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="A surface, such as top or shelf_1; may be repeated. Default: all.")
    ] = None,
    seconds_per_item: Annotated[float, typer.Option(min=0.001, help="Time limit of one asset, seconds.")] = SECONDS_PER_ITEM,
) -> None:
    """Find the surfaces of furniture on which scenes can stand: table tops, boards of shelves, counters with sinks.

    Each surface is an empty scene of the run, with what is in the way there. A folder gets a picture of each support.
    Status 0: done. 1: some assets have no surface; the table failures gives the reasons. 2: could not start.
    """
    from PIL import Image

    from pipelines.supports.preparing import SupportOptions, prepare_supports
    from stable_data.atomic_files import safe_file_name
    from stable_data.errors import ConfigError
    from stable_data.storage.run_folder import RunFolder
    from stable_data.supports.picture import draw_surfaces

    options = SupportOptions(table, tuple(surface or ()))
    counts = prepare_supports(library, asset or (), out, options, seconds_per_item=seconds_per_item, progress=True)
    folder = RunFolder(out)
    for support in counts.supports:
        for one in support.scenes:
            size, frame, clearance = one.scene.table.size_xy, one.scene.frame, one.scene.table.clearance
            assert frame is not None
            room = "" if clearance is None else f", {100 * clearance:.0f} cm high"
            zone = "" if one.scene.table.restricted_zone is None else ", with a part where nothing may stand"
            echo(f"{support.asset_id} {frame.surface}: {100 * size[0]:.0f} x {100 * size[1]:.0f} cm{room}{zone}")
        if folder.is_local:
            try:
                picture = Image.fromarray(draw_surfaces(support.mesh, support.surfaces))
            except ConfigError:  # a machine without graphics
                continue
            place = Path(folder.root) / "report"
            place.mkdir(exist_ok=True)
            picture.save(place / f"{safe_file_name(support.asset_id)}.png")
    for notice in counts.failures:
        echo(f"not used: {notice.message}", err=True)
    if counts.num_left_out and not asset:
        echo(f"{counts.num_left_out} other assets were not looked at; name them with --asset ID", err=True)
    num = sum(len(support.scenes) for support in counts.supports)
    echo(f"{out}: {len(counts.supports)} supports, {num} surfaces, {len(counts.failures)} failures")
    if counts.failures:
        raise typer.Exit(SOME_FAILED)
