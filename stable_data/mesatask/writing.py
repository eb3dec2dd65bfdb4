"""Writes scenes and annotations in the MesaTask-10K format.

Unchanged content is written as it was read, entry by entry and key by key. Changed and new values are written in full precision, so
that reading them gives the same double or a neighbouring one.
"""

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_data.assets.annotation import AssetAnnotation
from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError, SceneError
from stable_data.json_text import ReadLog, exact_preimage, json_text, quote_value
from stable_data.limits import LayoutLimits
from stable_data.mesatask.entry import BOX_YAW, POSE_KEYS, ReadContext, read_object, scaled_extents
from stable_data.mesatask.layout import LAYOUT_FILE, read_table
from stable_data.mesatask.library import ANNOTATION_FILE, LIBRARY_FOLDER, MAX_NAME_BYTES, is_file_name, write_annotation
from stable_data.mesatask.task_info import TASK_INFO_FILE, write_task_info
from stable_data.rotations import is_upright, is_yaw_of, normalise_quat, quat_product, yaw_quat
from stable_data.scene import UPRIGHT, QuatXyzw, Scene, SceneObject, Vec3

LAYOUT_FOLDER = "Layout_info"
SCENE_SETTINGS = {"units": "centimeters", "up_axis": "Z"}

_NAME_LENGTH = 63  # longest name of an object in Blender
_SAME_SIZE = 1e-9  # metres
_UNLIMITED = LayoutLimits(max_reach=math.inf)


def write_layout(
    scene: Scene,
    *,
    extents: Mapping[str, Vec3] | None = None,
    decimals: int | None = None,
    annotations: Mapping[str, AssetAnnotation] | None = None,
) -> dict[str, Any]:
    """Returns the content of a scene's layout.json, which has no stages, supports, relations or task info.

    Args:
        scene: The scene.
        extents: Box of each asset's mesh by uid, mesh units, z up: it becomes ``original_size`` of an object that has none.
        decimals: Decimals of a centimetre to which new positions and sizes are rounded; the format's own files have 1. None:
            full precision.
        annotations: Those that the scene was read with. A description is written if it differs from the annotation's; None: if it
            differs from that of the source.
    """
    source = copy.deepcopy(dict(scene.source or {}))
    is_dataset_form = any(_has_pose(o) for o in scene.objects)
    origin_cm, zones = _zones(scene, source, is_dataset_form)
    rest = {key: value for key, value in source.items() if key not in ("sink_zone", "restricted_zone")}
    objects = [_object_entry(o, origin_cm, extents or {}, decimals, annotations) for o in scene.objects]
    settings = {} if is_dataset_form else {"scene_settings": dict(SCENE_SETTINGS)}
    return settings | rest | zones | {"objects": objects}


def write_reply_layout(scene: Scene, *, decimals: int | None = None) -> dict[str, Any]:
    """Returns the layout in a language model's form: centimetres, degrees, descriptions; neither tilt nor asset.

    Lengths and angles are rounded to ``decimals``; None: full precision.
    """
    width, depth = (_centimetres(side, decimals=decimals) for side in scene.table.size_xy)
    layout: dict[str, Any] = {"item_placement_zone": [0.0, width, 0.0, depth]}
    if scene.table.restricted_zone is not None:
        layout["sink_zone"] = [_centimetres(side, decimals=decimals) for side in scene.table.restricted_zone]
    layout["objects"] = [
        {
            "instance": o.instance,
            "description": o.description,
            "z_rotation": _rounded(exact_preimage(math.radians, math.degrees(o.yaw), o.yaw), decimals),
            "size": [_centimetres(side, decimals=decimals) for side in o.size],
            "position": [_centimetres(side, decimals=decimals) for side in o.position],
        }
        for o in scene.objects
    ]
    return layout


def write_scene(
    root: Path,
    scene: Scene,
    front_png: bytes | None = None,
    *,
    extents: Mapping[str, Vec3] | None = None,
    decimals: int | None = None,
    annotations: Mapping[str, AssetAnnotation] | None = None,
) -> Path:
    """Writes a scene's folder: layout.json, and front.png and task_info.json if there are any.

    Args:
        root: The dataset's folder.
        scene: The scene; its id is the folder's name, its table type the name of the folder above.
        front_png: The image, if there is one.
        extents: As for :func:`write_layout`.
        decimals: As for :func:`write_layout`.
        annotations: As for :func:`write_layout`.

    Returns:
        The folder.

    Raises:
        SceneError: ``scene_id_invalid``: the id or the table type cannot be the name of a folder.
    """
    folder = scene_folder(root, scene)
    folder.mkdir(parents=True, exist_ok=True)
    if front_png is not None:
        write_file_atomically(folder / "front.png", front_png)
    if scene.task is not None:
        write_file_atomically(folder / TASK_INFO_FILE, _json(write_task_info(scene.task, scene.table)))
    layout = write_layout(scene, extents=extents, decimals=decimals, annotations=annotations)
    write_file_atomically(folder / LAYOUT_FILE, _json(layout))
    return folder


def scene_folder(root: Path, scene: Scene) -> Path:
    """The folder of a scene in a dataset's folder.

    Raises:
        SceneError: ``scene_id_invalid``: the id or the table type cannot be the name of a folder.
    """
    name = scene.scene_id.removeprefix(f"{scene.table.table_type}/")
    for part in (name, scene.table.table_type):
        if not part or not is_file_name(part):
            found = f"{scene.scene_id}: {quote_value(part)} cannot name a folder"
            raise SceneError(f"{found}, expected a plain name of at most {MAX_NAME_BYTES} bytes", "scene_id_invalid")
    return root / LAYOUT_FOLDER / scene.table.table_type / name


def write_annotations(root: Path, annotations: Mapping[str, AssetAnnotation]) -> Path:
    """Writes Asset_annotation.json, uids sorted, and returns its path."""
    root.mkdir(parents=True, exist_ok=True)
    path = root / ANNOTATION_FILE
    write_file_atomically(path, _json({asset_id: write_annotation(annotations[asset_id]) for asset_id in sorted(annotations)}))
    return path


def write_asset(root: Path, asset_id: str, glb: bytes) -> Path:
    """Writes a mesh, y up, to Assets_library and returns its path.

    Raises:
        ConfigError: ``uid_path_traversal``: the id cannot be the name of a file.
    """
    if not asset_id or not is_file_name(asset_id):
        found = f"asset id {quote_value(asset_id)} cannot name a file"
        raise ConfigError(f"{found}, expected a plain name of at most {MAX_NAME_BYTES} bytes", "uid_path_traversal")
    folder = root / LIBRARY_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{asset_id}.glb"
    write_file_atomically(path, glb)
    return path


def _zones(scene: Scene, source: Mapping[str, Any], is_dataset_form: bool) -> tuple[tuple[float, float], dict[str, Any]]:
    """Returns the corner from which positions are written, centimetres, and the zones; unchanged zones as they were read."""
    keys = ("item_placement_zone", "restricted_zone", "sink_zone")
    x = y = 0.0
    if source.get("item_placement_zone") is not None:
        table, (x, y) = read_table(source, scene.table.table_type, ReadLog(scene.scene_id))
        if table == scene.table and is_dataset_form:
            return (x, y), {key: source[key] for key in keys if key in source}
    width, depth = scene.table.size_xy
    zones: dict[str, Any] = {"item_placement_zone": [x, _centimetres(width, x), y, _centimetres(depth, y)]}
    if scene.table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = scene.table.restricted_zone
        zones["restricted_zone"] = [
            _centimetres(side, offset) for side, offset in zip((x_min, x_max, y_min, y_max), (x, x, y, y), strict=True)
        ]
    return (x, y), zones


def _object_entry(
    o: SceneObject,
    origin_cm: tuple[float, float],
    extents: Mapping[str, Vec3],
    decimals: int | None,
    annotations: Mapping[str, AssetAnnotation] | None,
) -> dict[str, Any]:
    """Returns the entry of an object: its source with all changes since it was read."""
    entry = copy.deepcopy(dict(o.source or {}))
    was = _as_read(o, origin_cm, annotations or {})
    is_other_asset = was is None or (o.asset_id is not None and was.asset_id != o.asset_id)
    if is_other_asset or entry.get("instance") != o.instance:
        _write_names(entry, o)
    if is_other_asset:
        # In the reply's form the key has another meaning, and another asset has another size.
        entry.pop("original_size", None)
        if o.asset_id is not None and o.asset_id in extents:
            entry["original_size"] = list(extents[o.asset_id])
    words = "" if was is None else was.description
    # A description that the source does not have may be an annotation's, which another file stores.
    if o.description != words and (was is None or words or annotations is not None):
        entry["description"] = o.description
    if o.scale is not None and (was is None or was.scale != o.scale):
        entry["scale_factor"] = [_centimetres(factor) for factor in o.scale]
    elif was is not None and was.scale != o.scale:
        entry["scale_factor"] = None
    if was is None or (was.yaw, was.tilt_quat_xyzw) != (o.yaw, o.tilt_quat_xyzw):
        _write_rotation(entry, o)
    if was is None or (was.size, was.scale) != (o.size, o.scale):
        entry["size"] = [_centimetres(side, decimals=decimals) for side in o.size]
        own = None if is_other_asset else scaled_extents(entry, o.scale)
        if own is not None and is_upright(o.tilt_quat_xyzw) and math.dist(own, o.size) > _SAME_SIZE:
            del entry["original_size"]  # a reader would take its product with the scale as the size
    if was is None or was.position != o.position:
        entry["position"] = [
            _centimetres(side, offset, decimals) for side, offset in zip(o.position, (*origin_cm, 0.0), strict=True)
        ]
    return entry


def _has_pose(o: SceneObject) -> bool:
    """Whether the object was read from an entry of the dataset's form."""
    return o.source is not None and any(key in o.source for key in POSE_KEYS)


def _as_read(o: SceneObject, origin_cm: tuple[float, float], annotations: Mapping[str, AssetAnnotation]) -> SceneObject | None:
    """Reads the source of an object again; None if it has none, or one of a reply's form."""
    if o.source is None or not _has_pose(o):
        return None
    context = ReadContext(ReadLog(o.instance), origin_cm, (0.0, 0.0), annotations=annotations, limits=_UNLIMITED)
    return read_object(o.source, o.instance, context)


def _write_names(entry: dict[str, Any], o: SceneObject) -> None:
    """Writes the instance, Blender's name and both uid keys. An asset that could not be used keeps its uid."""
    uid = o.asset_id or entry.get("selected_uid") or entry.get("retrieved_uid")
    entry["name"] = (f"{o.instance}_{uid}" if isinstance(uid, str) else o.instance)[:_NAME_LENGTH]
    entry["instance"] = o.instance
    if o.asset_id is not None:
        entry["retrieved_uid"] = entry["selected_uid"] = o.asset_id


def _write_rotation(entry: dict[str, Any], o: SceneObject) -> None:
    """Writes the whole rotation and the yaw of the box, which is marked if it is no Euler angle of the rotation."""
    rotation: QuatXyzw = yaw_quat(o.yaw)
    if o.tilt_quat_xyzw != UPRIGHT:
        rotation = normalise_quat(quat_product(rotation, o.tilt_quat_xyzw))
    entry["rotation"] = list(rotation)
    entry["z_rotation"] = yaw = math.remainder(o.yaw, 2 * math.pi)  # in [-pi, pi]
    entry.pop(BOX_YAW, None)
    if not is_yaw_of(yaw, rotation):
        entry[BOX_YAW] = yaw


def _centimetres(metres: float, offset_cm: float = 0.0, decimals: int | None = None) -> float:
    """Returns the number of centimetres that reads back as exactly this distance from ``offset_cm``."""
    if decimals is not None:
        return _rounded(metres * 100 + offset_cm, decimals)
    return exact_preimage(lambda found: (found - offset_cm) / 100, metres * 100 + offset_cm, metres)


def _rounded(value: float, decimals: int | None) -> float:
    return value if decimals is None else round(value, decimals) + 0.0  # no -0.0


def _json(document: object) -> bytes:
    """Returns JSON in the style of the format's files."""
    return (json_text(document, indent=2) + "\n").encode()
