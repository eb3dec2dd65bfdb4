"""A few pictures for the card of a published run: those that the run has, or new ones of its first scenes."""

import io
from collections.abc import Iterator
from itertools import islice
from typing import Any

from stable_data.errors import ConfigError, StableDataError
from stable_data.geometry.images import decode_png
from stable_data.limits import LIMITS
from stable_data.storage.run_folder import RunFolder

FOLDER = "previews"
SHEET = "report/contact_sheet.png"
"""The pictures of the accepted scenes on one sheet, which generate draws."""

_MOST = 6
_MOST_TRIED = 50  # stored pictures: a run may have very many that are none
_SIZE = (640, 480)


def previews(run: RunFolder) -> dict[str, bytes]:
    """Returns pictures of a run by their names in the folder of the dataset; none if there is nothing to show, or nothing to draw with.

    Files of the run are not trusted to be pictures: each is decoded and encoded again, and what is no PNG is left out.

    Raises:
        ConfigError: A table cannot be read.
    """
    try:
        found = _those_of(run)
    except ModuleNotFoundError:  # Pillow
        return {}
    return found or (_drawn(run) if all(run.files(table) for table in ("scenes", "assets", "meshes")) else {})


def _those_of(run: RunFolder) -> dict[str, bytes]:
    """The pictures that a run has: its contact sheet, or the first ones of a table."""
    sheet = run.read_bytes(SHEET, LIMITS.image.max_bytes + 1)
    if sheet is not None and (picture := _encoded_again(sheet)) is not None:
        return {f"{FOLDER}/contact_sheet.png": picture}
    for table, column in (("views", "views"), ("episodes", "pictures")):
        if run.files(table):
            pictures = map(_encoded_again, islice(_stored(run, table, column), _MOST_TRIED))
            found = list(islice((picture for picture in pictures if picture is not None), _MOST))
            if found:
                return {f"{FOLDER}/{number}.png": picture for number, picture in enumerate(found)}
    return {}


def _encoded_again(content: bytes) -> bytes | None:
    """The pixels of a PNG as a PNG; None if it is none."""
    try:
        return _png(decode_png(content))
    except ValueError:
        return None


def _png(pixels: Any) -> bytes:
    """The PNG file of pixels, (H, W, 3) uint8."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()


def _stored(run: RunFolder, table: str, column: str) -> Iterator[bytes]:
    """The first picture of each row of a table."""
    for batch in run.batches(table, [column]):
        for value in batch[column].to_pylist():
            first = value[0] if value else None
            picture = first and (first["picture"] if table == "views" else next(iter(first["images"] or ()), None))
            if picture:
                yield picture


def _drawn(run: RunFolder) -> dict[str, bytes]:
    """Pictures of the first scenes; none where the extras or a way to draw are missing."""
    try:
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
            found[f"{FOLDER}/{number}.png"] = _png(picture)
    except ModuleNotFoundError:
        return {}
    return found
