"""Opens a folder in the MesaTask-10K format."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from stable_data.assets.annotation import AssetAnnotation
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.json_text import ReadLog, as_text, read_bounded
from stable_data.limits import LIMITS, LayoutLimits
from stable_data.mesatask.layout import LAYOUT_FILE, read_layout
from stable_data.mesatask.library import AssetFolder
from stable_data.mesatask.task_info import TASK_INFO_FILE, read_task_info
from stable_data.mesatask.writing import LAYOUT_FOLDER
from stable_data.scene import Scene, SceneObject, TaskInfo

TABLE_TYPES = ("bathroom_vanity", "coffee_table", "dining_table", "dressing_table", "kitchen_counter", "office_table")
"""The kinds of table in MesaTask-10K."""


class MesaTaskDataset:
    """A dataset on disk: Layout_info/<table type>/<scene>/layout.json, with annotations and meshes.

    Args:
        root: Its folder.
        limits: Limits beyond which a layout is refused.

    Attributes:
        root: Its folder.
        scene_ids: Its scenes, sorted: the names of their folders, of which a byte that is not UTF-8 is written
            as ``%FF``; a name that occurs again becomes ``<table type>/<name>``.
        notices: Remarks on the folder as a whole.

    Raises:
        ConfigError: ``root_missing``, ``not_a_dataset``, ``dataset_empty``, or the annotations cannot be read.
    """

    def __init__(self, root: Path, limits: LayoutLimits | None = None) -> None:
        self.root = Path(root)
        self._limits = limits or LIMITS.layout
        self._layouts = (self.root / LAYOUT_FOLDER).resolve()
        log = ReadLog(self.root.name)
        self._folders = _scene_folders(self.root, log)
        self.scene_ids: tuple[str, ...] = tuple(sorted(self._folders))
        self._assets = AssetFolder(self.root)
        self.notices: tuple[Notice, ...] = (*log.notices, *self._assets.notices)

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.scene_ids)

    @property
    def asset_ids(self) -> tuple[str, ...]:
        """Every uid that is annotated or has a GLB, sorted."""
        return self._assets.asset_ids

    @property
    def annotations(self) -> Mapping[str, AssetAnnotation]:
        """The annotations by uid."""
        return self._assets.annotations

    def asset_path(self, asset_id: str) -> Path | None:
        """The path of an asset's GLB, always inside Assets_library; None if there is none."""
        return self._assets.path(asset_id)

    def annotation(self, asset_id: str) -> AssetAnnotation:
        """Returns the annotation of an asset; defaults for an asset that only has a GLB.

        Raises:
            KeyError: The asset is neither annotated nor on disk.
        """
        return self._assets.annotation(asset_id)

    def layout_path(self, scene_id: str) -> Path:
        """The path of a scene's layout.json.

        Raises:
            SceneError: ``scene_unknown``: there is no such scene.
        """
        if scene_id not in self._folders:
            raise SceneError(f"{scene_id}: {self.root} has no such scene, expected one of its {len(self)}", "scene_unknown")
        return self._folders[scene_id] / LAYOUT_FILE

    def read(self, scene_id: str) -> tuple[Scene, tuple[Notice, ...]]:
        """Reads the scene with an id of ``scene_ids``, with its task info, if there is one.

        Returns:
            The scene, and notices about it. An object with an unknown asset loses its asset id; an object whose GLB is missing or
            broken keeps it.

        Raises:
            SceneError: The scene cannot be used; ``code`` gives the reason.
        """
        path = self.layout_path(scene_id)
        log = ReadLog(scene_id)
        data = self._content(path, self._limits, "max_bytes", log)
        table_type = path.parent.parent.name
        scene, notices = read_layout(data, scene_id, table_type, annotations=self.annotations, limits=self._limits)
        objects = tuple(self._with_known_asset(scene_object, log) for scene_object in scene.objects)
        scene = replace(scene, objects=objects, task=self._task_beside(path, log))
        return scene, (*notices, *log.notices)

    def _content(self, path: Path, limits: LayoutLimits, name: str, log: ReadLog) -> bytes:
        """Reads a file whose real path is among the layouts."""
        if not path.resolve().is_relative_to(self._layouts):
            raise log.error(
                "path_outside", f"{path} leads out of {LAYOUT_FOLDER}, expected a file inside; put the file itself there"
            )
        return read_bounded(path, limits, name, log)

    def _task_beside(self, layout_path: Path, log: ReadLog) -> TaskInfo | None:
        """Reads the task info of a scene; an invalid one is only a notice, because the scene is usable without it."""
        path = layout_path.with_name(TASK_INFO_FILE)
        if not path.exists():
            return None
        try:
            return read_task_info(self._content(path, LIMITS.layout, "max_task_bytes", log), log.item_id)
        except SceneError as error:
            log.warn("task_info_invalid", f"{str(error).removeprefix(log.item_id + ': ')}; the scene is read without it")
            return None

    def _with_known_asset(self, scene_object: SceneObject, log: ReadLog) -> SceneObject:
        """Removes the asset of an object if it is unknown."""
        uid, name = scene_object.asset_id, scene_object.instance
        if uid is None:
            return scene_object
        if uid not in self._assets:
            message = f"object {name} has uid {uid}, neither annotated nor in Assets_library; a box of its size replaces it"
            log.warn("unknown_uid", message)
            return replace(scene_object, asset_id=None)
        path = self.asset_path(uid)
        if path is None:
            log.warn("glb_missing", f"object {name} has uid {uid}, whose GLB is missing; a box of its size replaces it")
        elif path.stem != uid:
            message = (
                f"object {name} has uid {uid}, which has no GLB; {path.name} is used instead and may have another orientation"
            )
            log.warn("asset_variant_served", message)
        return scene_object


def _scene_folders(root: Path, log: ReadLog) -> dict[str, Path]:
    """Finds the folders of the scenes by id."""
    if not root.is_dir():
        hint = f"; did you mean its folder, {root.parent}?" if root.is_file() else ""
        raise ConfigError(
            f"{root} is not a folder, expected one in the MesaTask-10K format or of scene files{hint}", "root_missing"
        )
    layouts = root / LAYOUT_FOLDER
    if not layouts.is_dir():
        hint = f"; did you mean {root.parent}?" if root.name == LAYOUT_FOLDER else ""
        message = f"{root} has no folder {LAYOUT_FOLDER}, expected {LAYOUT_FOLDER}/<table type>/<scene>{hint}"
        raise ConfigError(message, "not_a_dataset")
    every = sorted(path for path in layouts.glob("*/*") if path.is_dir() and not path.name.startswith("."))
    folders: dict[str, Path] = {}
    for folder in every:
        if (folder / LAYOUT_FILE).is_file():
            folders[_free_name(folder, folders)] = folder
    if not folders:
        raise ConfigError(f"{layouts} contains no <table type>/<scene>/{LAYOUT_FILE}; unpack the archive", "dataset_empty")
    named = dict(folders)  # scenes get their names first, so that a folder without a layout cannot take one
    for folder in (folder for folder in every if not (folder / LAYOUT_FILE).is_file()):
        name = _free_name(folder, named)
        named[name] = folder
        where = as_text(str(folder.relative_to(root)))
        message = f"{name}: {where} has no {LAYOUT_FILE}; it is not a scene; add the file or remove the folder"
        log.notices.append(Notice(name, "read", "layout_missing", message))
    return folders


def _free_name(folder: Path, taken: Mapping[str, Path]) -> str:
    """The id of a scene: its folder's name, with the table type if another scene has that name."""
    name = as_text(folder.name)
    if name in taken and taken[name].parent != folder.parent:
        name = f"{as_text(folder.parent.name)}/{name}"
    while name in taken:  # of a name that is not UTF-8, and of one that is written like it
        name += "_"
    return name
