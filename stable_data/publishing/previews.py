"""A few pictures for the card of a published run: those that the run has, or new ones of its first scenes."""

from collections.abc import Iterator
from itertools import islice

from stable_data.errors import ConfigError, StableDataError
from stable_data.storage.run_folder import RunFolder

FOLDER = "previews"
SHEET = "report/contact_sheet.png"
"""The pictures of the accepted scenes on one sheet, which generate draws."""

_MOST = 6
_SIZE = (640, 480)


def previews(run: RunFolder) -> dict[str, bytes]:
    """Returns pictures of a run by their names in the folder of the dataset; none if there is nothing to show, or nothing to draw with.

    Raises:
        ConfigError: A table cannot be read.
    """
    if (sheet := run.read_bytes(SHEET)) is not None:
        return {f"{FOLDER}/contact_sheet.png": sheet}
    for table, column in (("views", "views"), ("episodes", "pictures")):
        if run.files(table):
            found = dict(islice(_stored(run, table, column), _MOST))
            if found:
                return found
    return _drawn(run) if all(run.files(table) for table in ("scenes", "assets", "meshes")) else {}


def _stored(run: RunFolder, table: str, column: str) -> Iterator[tuple[str, bytes]]:
    """The first picture of each row of a table."""
    number = 0
    for batch in run.batches(table, [column]):
        for value in batch[column].to_pylist():
            if value:
                picture = value[0]["picture"] if table == "views" else value[0]["images"][0]
                yield f"{FOLDER}/{number}.png", picture
                number += 1


def _drawn(run: RunFolder) -> dict[str, bytes]:
    """Pictures of the first scenes; none where the extras or a way to draw are missing."""
    try:
        import io

        from PIL import Image

        from stable_data.simulation.run_reader import RunScenes, SceneSelection
        from stable_data.simulation.views import draw_geometry

        scenes, found = RunScenes(run, SceneSelection(limit=_MOST)), dict[str, bytes]()
        for number, scene in enumerate(scenes):
            try:
                picture = draw_geometry(scenes.geometry(scene), _SIZE)
            except ConfigError:
                return found  # the machine cannot draw
            except StableDataError:
                continue
            stream = io.BytesIO()
            Image.fromarray(picture).save(stream, "png")
            found[f"{FOLDER}/{number}.png"] = stream.getvalue()
    except ModuleNotFoundError:
        return {}
    return found
