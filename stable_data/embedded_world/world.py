"""The embedded world as a folder in the MesaTask-10K format: asset library, scenes, edits and a manifest of the settings."""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from stable_data import __version__
from stable_data.assets.annotation import AssetAnnotation
from stable_data.config_diff import refuse_changed
from stable_data.embedded_world.drafting import kinds_in_turn
from stable_data.embedded_world.edits import SceneEdit, make_edit
from stable_data.embedded_world.families.catalogue import KEYS, LICENCE, asset, unit_cube
from stable_data.embedded_world.scenes import RECORD, EmbeddedScene, make_scene, plan_of, scene_id_of, table_type_of
from stable_data.embedded_world.statistics import count_scene, dataset_card
from stable_data.errors import ConfigError, SceneError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.layout import LAYOUT_FILE
from stable_data.mesatask.library import ANNOTATION_FILE, LIBRARY_FOLDER
from stable_data.mesatask.writing import LAYOUT_FOLDER, write_annotations, write_asset, write_scene
from stable_data.simulation.render import FRONT_SIZE, contact_sheet, render_scene

TABLE_UID = "3cc47c3f78d34985bf4314de2f8196dd"
"""Asset id of the table top in the format: a unit cube."""

SINK_UID = "sink_cube"
"""Asset id of the sink in the format: a unit cube."""

MANIFEST_FILE = "synth.json"
FAILURES_FOLDER = "synth_failures"
EDIT_FOLDER, EDIT_FILE, EDITS_FILE = "Edit_info", "edit.json", "edits.jsonl"

SHEET_FILE = "sheet.png"

_NUM_ON_SHEET, _SHEET_PICTURE = 60, (256, 256)
_EDIT_STREAM = 1_000_003  # larger than any attempt number of a scene, so that the random streams differ

Progress = Callable[[int], None]
"""Called after each scene with the number of finished scenes."""


@dataclass(frozen=True, slots=True)
class EmbeddedWorld:
    """The settings that determine the scenes of a set, together with their numbers.

    Attributes:
        seed: A whole number, at least 0.
        tables: Kinds of table to use in turn; all kinds if empty.
        pictures: Whether to render front.png.
        edits: Whether to write an edit for each scene that allows one.
        whole_library: Whether to write all assets of the catalogue instead of only those in use.
    """

    seed: int = 0
    tables: tuple[str, ...] = ()
    pictures: bool = True
    edits: bool = False
    whole_library: bool = False

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError(f"seed is {self.seed}, expected at least 0", "invalid_count")
        for table_type in self.tables:
            plan_of(table_type)

    def scene_folder(self, out: Path, number: int) -> Path:
        """The folder of a scene."""
        return out / LAYOUT_FOLDER / table_type_of(number, self.tables) / scene_id_of(number, self.tables)


def write_world(
    out: Path, num_scenes: int = 24, world: EmbeddedWorld = EmbeddedWorld(), progress: Progress | None = None
) -> list[SceneError]:
    """Writes a set of the embedded world, or its missing scenes.

    Scene k depends only on the settings and on k. A scene folder is written in one step; an existing one is not changed.

    Args:
        out: The output folder, in the MesaTask-10K format.
        num_scenes: Number of scenes.
        world: The settings.
        progress: Called after each scene.

    Returns:
        An error for each scene that could not be made; each is also a file in ``synth_failures``.

    Raises:
        ConfigError: The folder cannot be written (``out_not_writable``), contains other files (``not_a_world``) or a set with other
            settings (``config_changed``); or a number is out of range (``invalid_count``).
    """
    open_world(out, num_scenes, world)
    failures = write_scenes(out, range(num_scenes), world, progress)
    close_world(out, world)
    return failures


def open_world(out: Path, num_scenes: int, world: EmbeddedWorld) -> None:
    """Prepares a folder for scenes: checks its contents and writes the library and the manifest."""
    if num_scenes < 1:
        raise ConfigError(f"the number of scenes is {num_scenes}, expected at least 1", "invalid_count")
    wanted = _manifest(world)
    try:
        out.mkdir(parents=True, exist_ok=True)
        path = out / MANIFEST_FILE
        if path.is_file():
            found = _read(path)
            refuse_changed(str(out), {key: found.get(key) for key in wanted}, wanted)
        elif any(out.iterdir()):
            raise ConfigError(f"{out} contains other files (no {MANIFEST_FILE}), expected a new or empty folder", "not_a_world")
        else:
            path.write_text(json.dumps(wanted, indent=2) + "\n", "utf-8")
        if not (out / ANNOTATION_FILE).is_file():
            write_library(out, KEYS if world.whole_library else ())
    except OSError as error:
        raise _unwritable(out, error) from error


def write_scenes(out: Path, numbers: Iterable[int], world: EmbeddedWorld, progress: Progress | None = None) -> list[SceneError]:
    """Writes some scenes of a set that :func:`open_world` prepared; existing scenes are not changed.

    Returns:
        An error for each scene that could not be made.

    Raises:
        ConfigError: The folder cannot be written (``out_not_writable``).
    """
    failures = []
    try:
        for done, number in enumerate(numbers, 1):
            error = _write_one(out, number, world)
            if error is not None:
                failures.append(error)
            if progress is not None:
                progress(done)
    except OSError as error:
        raise _unwritable(out, error) from error
    return failures


def _write_one(out: Path, number: int, world: EmbeddedWorld) -> SceneError | None:
    """Writes a scene and its edit if they are missing; the edit first, so that an existing scene always has its edit."""
    folder = world.scene_folder(out, number)
    if (folder / LAYOUT_FILE).is_file():
        return None
    try:
        embedded = make_scene(number, world.seed, world.tables)
    except SceneError as error:
        _write_failure(out, folder.name, error)
        return error
    # The stream of the edit differs from those of the attempts at the scene.
    if world.edits:
        edit = make_edit(embedded, np.random.default_rng([world.seed, number, _EDIT_STREAM]), kinds_in_turn(number))
        if edit is not None:
            _write_edit(out, edit, pictures=world.pictures)
    _write_scene_folder(out, folder, embedded, pictures=world.pictures)
    return None


def _write_edit(out: Path, edit: SceneEdit, *, pictures: bool) -> None:
    """Writes the edited scene into ``Edit_info``, with ``edit.json`` beside its layout."""
    table_type = edit.before.table.table_type
    record = {
        "scene_id": edit.before.scene_id,
        "edited": edit.after.scene_id,
        "kind": edit.kind,
        "instruction": edit.instruction,
        "added": edit.added,
        "removed": edit.removed,
        "moved": edit.moved,
    }
    folder = out / EDIT_FOLDER / table_type / edit.after.scene_id
    _write_scene_folder(out, folder, EmbeddedScene(edit.after, edit.placed), pictures=pictures, beside={EDIT_FILE: record})


def close_world(out: Path, world: EmbeddedWorld) -> None:
    """Writes the files about the whole set: the dataset card (``README.md``), a picture sheet, the annotations, ``edits.jsonl``."""
    dataset = MesaTaskDataset(out)
    scenes = [count_scene(dataset.read(scene_id)[0]) for scene_id in dataset.scene_ids]
    edits = sorted((out / EDIT_FOLDER).glob(f"*/*/{EDIT_FILE}"))
    try:
        if not world.whole_library:
            write_library(out, sorted(used_keys(out)))
        has_sheet = _write_sheet(out)
        if scenes:
            (out / "README.md").write_text(dataset_card(scenes, SHEET_FILE if has_sheet else None), "utf-8")
        if edits:
            (out / EDITS_FILE).write_text("".join(json.dumps(json.loads(p.read_text("utf-8"))) + "\n" for p in edits), "utf-8")
    except OSError as error:
        raise _unwritable(out, error) from error


def _write_sheet(out: Path) -> bool:
    """Draws an even selection of the pictures on one sheet; returns whether there are any."""
    # Every n-th picture, n rounded up, so that the sheet has at most _NUM_ON_SHEET pictures.
    paths = sorted((out / LAYOUT_FOLDER).glob("*/*/front.png"))
    chosen = paths[:: -(-len(paths) // _NUM_ON_SHEET)] if paths else []
    images = [np.asarray(Image.open(path, formats=("PNG",)).convert("RGB").resize(_SHEET_PICTURE)) for path in chosen]
    if images:
        Image.fromarray(contact_sheet(images, [path.parent.name for path in chosen], columns=6)).save(out / SHEET_FILE)
    return bool(images)


def used_keys(out: Path) -> set[str]:
    """Keys of the assets that the scenes and edits of a set use, from their records."""
    found: set[str] = set()
    for folder in (LAYOUT_FOLDER, EDIT_FOLDER):
        for path in (out / folder).glob(f"*/*/{LAYOUT_FILE}"):
            found.update(json.loads(path.read_text("utf-8"))[RECORD]["keys"])
    return found


def _manifest(world: EmbeddedWorld) -> dict[str, Any]:
    # These settings must be equal when a set is continued.
    settings = asdict(world)
    settings.pop("pictures")  # pictures do not change the scenes
    return {"made_by": f"stable-data {__version__}", "num_assets": len(KEYS), **settings, "tables": list(world.tables)}


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON ({error}), expected the settings of a set; choose another folder", "not_a_world")\
            from error  # fmt: skip
    if not isinstance(found, dict):
        raise ConfigError(f"{path} contains {type(found).__name__}, expected an object; choose another folder", "not_a_world")
    return found


def _unwritable(out: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{out} cannot be written: {error.strerror or error}; choose another folder", "out_not_writable")


def _write_failure(out: Path, name: str, error: SceneError) -> None:
    folder = out / FAILURES_FOLDER
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps({"code": error.code, "message": str(error)}, indent=2) + "\n", "utf-8")


def write_library(out: Path, keys: Iterable[str]) -> None:
    """Writes the missing ones of some assets, then the annotations of these assets."""
    cube = write_glb(unit_cube())
    annotations = _cube_annotations()
    for uid in annotations:
        write_asset(out, uid, cube)
    for key in keys:
        found = asset(key)
        if not (out / LIBRARY_FOLDER / f"{found.uid}.glb").is_file():
            write_asset(out, found.uid, found.glb)
        annotations[found.uid] = found.annotation
    write_annotations(out, annotations)


def _cube_annotations() -> dict[str, AssetAnnotation]:
    """Annotations of the table top and the sink, marked as not standing on a table."""
    words = ((TABLE_UID, "table", "A table top."), (SINK_UID, "sink", "A sink."))
    extents, raw = (1.0, 1.0, 1.0), {"licence": LICENCE}
    return {
        uid: AssetAnnotation(uid, name, text.rstrip(".").lower(), text, "synth", on_table=False, extents_z_up=extents, raw=raw)
        for uid, name, text in words
    }


def _write_scene_folder(
    out: Path, folder: Path, embedded: EmbeddedScene, *, pictures: bool, beside: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Writes a scene folder with additional JSON files in one step: into a temporary folder that is then renamed."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for obj in embedded.placed:
        if not (out / LIBRARY_FOLDER / f"{obj.asset.uid}.glb").is_file():
            write_asset(out, obj.asset.uid, obj.asset.glb)
    temporary = Path(tempfile.mkdtemp(prefix=".scene_", dir=out))
    try:
        extents = {obj.asset.uid: obj.asset.file_extents for obj in embedded.placed}
        written = write_scene(temporary, embedded.scene, render_preview(embedded) if pictures else None, extents=extents)
        for name, content in (beside or {}).items():
            (written / name).write_text(json.dumps(content, indent=2) + "\n", "utf-8")
        if folder.exists():  # a folder without a layout, not written by this module
            shutil.rmtree(folder)
        written.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def render_preview(embedded: EmbeddedScene, size: tuple[int, int] = FRONT_SIZE) -> bytes | None:
    """The front view as PNG, with the colours of the assets; None if the machine cannot render."""
    paints = [obj.asset.paint for obj in embedded.placed]
    try:
        image = render_scene(embedded.scene, yaw_frame_meshes(embedded), size=size, colors=paints)
    except ConfigError as error:
        if error.code != "no_gl":
            raise
        return None
    stream = BytesIO()
    Image.fromarray(image).save(stream, "png", optimize=False, compress_level=6)
    return stream.getvalue()


def yaw_frame_meshes(embedded: EmbeddedScene) -> Sequence[Mesh | None]:
    """The mesh of each object, metres, yaw frame, centred on its box."""
    pairs = zip(embedded.scene.objects, embedded.placed, strict=True)
    shapes = [Shape.from_mesh(obj.asset.mesh, obj.item.scale, o.tilt_quat_xyzw) for o, obj in pairs]
    return [Mesh(shape.vertices, shape.faces) for shape in shapes]
