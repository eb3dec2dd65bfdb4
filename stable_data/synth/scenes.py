"""The embedded set: scenes at rest on six kinds of table, made from a seed and written in the MesaTask-10K format."""

import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from stable_data.errors import ConfigError, SceneError
from stable_data.export.glb import write_glb
from stable_data.mesatask.layout import LAYOUT_FILE
from stable_data.mesatask.library import AssetAnnotation
from stable_data.mesatask.writing import LAYOUT_FOLDER, write_annotations, write_asset, write_scene
from stable_data.mesh import Mesh
from stable_data.metrics.audit import Audit
from stable_data.relations import scene_graph
from stable_data.render import render_scene
from stable_data.scene import Scene, Tabletop, Vec3
from stable_data.shape import Shape
from stable_data.synth.assets import Asset, asset, unit_cube
from stable_data.synth.catalogue import CATALOGUE
from stable_data.synth.placing import Placed, place
from stable_data.synth.plans import TABLES, TablePlan
from stable_data.synth.settling import audit, is_at_rest, settled_objects
from stable_data.task_templates import derive_task, task_rng

TABLE_UID = "3cc47c3f78d34985bf4314de2f8196dd"
"""What the format calls its table top: a unit cube."""

SINK_UID = "sink_cube"
"""What the format calls its sink: a unit cube."""

FEWEST, MOST = 4, 12
"""Objects in a scene."""

_ATTEMPTS = 40
_SINK = (0.36, 0.64, 0.22, 0.86)  # of the table's width and depth

IsClean = Callable[[Scene], bool]
"""A further condition on a scene; one that fails is made anew from the next draw."""

Progress = Callable[[int, int], None]
"""Told how many scenes are done, and of how many."""


@dataclass(frozen=True, slots=True, eq=False)
class MadeScene:
    """A scene at rest and what it was made from.

    Attributes:
        scene: The scene, with a task info where it has one.
        placed: The things, in the order of its objects.
    """

    scene: Scene
    placed: tuple[Placed, ...]


def write_embedded_set(
    out: Path,
    num_scenes: int = 24,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    is_clean: IsClean | None = None,
    pictures: bool = True,
) -> int:
    """Writes the embedded set, or what is missing of it.

    Scene k depends on the seed and k alone. A folder appears whole or not at all, and one that exists is left alone. Pictures
    are left out where the machine cannot draw.

    Args:
        out: The folder, in the MesaTask-10K format once written.
        num_scenes: How many scenes.
        seed: Any whole number from 0 on.
        progress: Called after every scene.
        is_clean: A further condition on scenes, beside rest and the exact audit.
        pictures: Draw front.png.

    Returns:
        How many scenes the folder holds of those asked for.

    Raises:
        ConfigError: The folder cannot be written (``out_not_writable``), or the numbers make no sense (``invalid_count``).
        SceneError: A scene came out unclean at every attempt (``synth_failed``).
    """
    if num_scenes < 1 or seed < 0:
        raise ConfigError(f"num_scenes is {num_scenes} and seed {seed}, expected at least 1 and 0", "invalid_count")
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_library(out)
        for number in range(num_scenes):
            folder = out / LAYOUT_FOLDER / table_type_of(number) / scene_id_of(number)
            if not (folder / LAYOUT_FILE).is_file():
                made = make_scene(number, seed, is_clean=is_clean)
                _write_whole(out, folder, made, pictures=pictures)
            if progress is not None:
                progress(number + 1, num_scenes)
    except OSError as error:
        raise ConfigError(f"{out} cannot be written: {error.strerror}; name another folder", "out_not_writable") from error
    return num_scenes


def table_type_of(number: int) -> str:
    """Scenes take the kinds of table in turn."""
    return tuple(TABLES)[number % len(TABLES)]


def scene_id_of(number: int) -> str:
    """The name of a scene's folder."""
    return f"{table_type_of(number)}_{number:04d}"


def make_scene(number: int, seed: int = 0, *, is_clean: IsClean | None = None) -> MadeScene:
    """Makes one scene: arranged by plan, settled, and kept once it stays at rest and the exact audit finds it clean.

    Args:
        number: Which scene.
        seed: Which set.
        is_clean: A further condition.

    Returns:
        The scene, the same for the same number and seed.

    Raises:
        SceneError: Every attempt came out unclean (``synth_failed``).
    """
    plan = TABLES[table_type_of(number)]
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, number, attempt])
        table = _table(table_type_of(number), plan, rng)
        placed = place(plan.plans[number // len(TABLES) % len(plan.plans)], table, rng)
        if placed is None or not FEWEST <= len(placed) <= MOST:
            continue
        objects = settled_objects(placed, table)
        if objects is None:
            continue
        scene = Scene(scene_id_of(number), table, objects)
        judged = audit(scene, placed)
        if judged.card().clean and (is_clean is None or is_clean(scene)) and is_at_rest(scene, placed):
            return MadeScene(_with_task(scene, judged, placed) if _has_task(number) else scene, tuple(placed))
    raise SceneError(
        f"{scene_id_of(number)}: none of {_ATTEMPTS} attempts came to rest clean, expected one; use another seed",
        "synth_failed",
    )


def _has_task(number: int) -> bool:
    """Every second scene, of every kind of table."""
    return (number + number // len(TABLES)) % 2 == 0


def _table(table_type: str, plan: TablePlan, rng: np.random.Generator) -> Tabletop:
    width, depth = (round(float(rng.uniform(*bounds)), 3) for bounds in (plan.width, plan.depth))
    if not plan.has_sink:
        return Tabletop(table_type, (width, depth))
    x_min, x_max, y_min, y_max = (
        round(share * side, 3) for share, side in zip(_SINK, (width, width, depth, depth), strict=True)
    )
    return Tabletop(table_type, (width, depth), (x_min, x_max, y_min, y_max))


def _with_task(scene: Scene, judged: Audit, placed: Sequence[Placed]) -> Scene:
    """The scene with a task that makes sense in it, by template."""
    contacts = {o.instance: o.supports for o in judged.objects}
    containers = {o.instance: thing.asset.spec.is_container for o, thing in zip(scene.objects, placed, strict=True)}
    graph = scene_graph(scene, contacts, containers=containers)
    return replace(scene, task=derive_task(scene, graph, task_rng(scene.scene_id)))


def write_library(out: Path) -> None:
    """Writes every asset of the catalogue and the annotations, where they are not there yet."""
    library = [asset(key) for key in CATALOGUE]
    cube = write_glb(unit_cube())
    files = {found.uid: found.glb for found in library} | {TABLE_UID: cube, SINK_UID: cube}
    for uid, glb in files.items():
        write_asset(out, uid, glb)
    write_annotations(out, {found.uid: found.annotation for found in library} | dict(_cube_annotations()))


def _cube_annotations() -> list[tuple[str, AssetAnnotation]]:
    """The table top and the sink are no objects: they are marked as not standing on a table."""
    words = ((TABLE_UID, "table", "A table top."), (SINK_UID, "sink", "A sink."))
    return [
        (
            uid,
            AssetAnnotation(
                uid, category, text.rstrip(".").lower(), text, "synth", on_table=False, extents_z_up=(1.0, 1.0, 1.0)
            ),
        )
        for uid, category, text in words
    ]


def _write_whole(out: Path, folder: Path, made: MadeScene, *, pictures: bool) -> None:
    """Writes a scene's folder aside and puts it in place in one step."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(prefix=".scene_", dir=out))
    try:
        written = write_scene(aside, made.scene, _picture(made) if pictures else None, extents=_extents(made.placed))
        if folder.exists():  # left by an earlier version or a hand, without a layout
            shutil.rmtree(folder)
        written.replace(folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _extents(placed: Sequence[Placed]) -> dict[str, Vec3]:
    return {thing.asset.uid: _extent(thing.asset) for thing in placed}


def _extent(source: Asset) -> Vec3:
    """Box of its file's mesh, file units, z up."""
    x, y, z = (source.mesh.extents / source.spec.unit).tolist()
    return (x, y, z)


def _picture(made: MadeScene) -> bytes | None:
    """The front view as PNG; None where the machine cannot draw."""
    try:
        image = render_scene(made.scene, yaw_frame_meshes(made))
    except ConfigError as error:
        if error.code != "no_gl":
            raise
        return None
    stream = BytesIO()
    Image.fromarray(image).save(stream, "png", optimize=False, compress_level=6)
    return stream.getvalue()


def yaw_frame_meshes(made: MadeScene) -> list[Mesh | None]:
    """The mesh of every object, metres, yaw frame, centred on its box."""
    pairs = zip(made.scene.objects, made.placed, strict=True)
    shapes = [Shape.from_mesh(thing.asset.mesh, (thing.item.scale,) * 3, o.tilt_quat_xyzw) for o, thing in pairs]
    return [Mesh(shape.vertices, shape.faces) for shape in shapes]
