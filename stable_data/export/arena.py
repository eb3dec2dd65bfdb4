"""Exports layouts for Isaac Lab-Arena, beside the OpenUSD of the flavour ``isaaclab``.

An export::

    layouts/<scene>.jsonl      one line: a layout that ``--placement_layouts`` of Isaac Lab-Arena replays
    scenes, props, furniture   see :mod:`stable_data.export.usd`

Isaac Lab-Arena reads the poses of a line and ignores the rest, which is under the key ``stable_data``. All lines of a file must have
the same objects, so that each scene has a file.
"""

from pathlib import Path
from typing import Any

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.export.props import placed_props, sized_prop
from stable_data.export.scene_files import FRAME, json_file, object_facts, scene_facts, sliding_friction, table_box
from stable_data.export.usd import UsdFormat
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry

NEEDS = ("pxr",)

ABOUT = """Layouts for Isaac Lab-Arena: `layouts/<scene>.jsonl` is one line with the poses of the objects that move, in the form that
`--placement_layouts` replays: metres, quaternions xyzw. Its key `stable_data` has the rest: `objects` are entries for `objects` of an
environment YAML (`simready_usd_object` with the USD package of each object at its size); `background` names the stage with the table
and all that does not move; task, relations, verdicts and cameras. Paths are relative to the file. The OpenUSD is that of
`--format usd --flavour isaaclab`: copy `scenes`, `props` and `furniture` with the layouts."""


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the file of a scene: if it exists, the scene is exported."""
    return out / "layouts" / f"{safe_file_name(scene.scene_id)}.jsonl"


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, and those of its packages that do not exist yet, see :class:`~stable_data.export.formats.ExportFormat`.

    Raises:
        MeshError: An object has no solid part.
    """
    stages = UsdFormat("isaaclab")
    stages.export_scene(geometry, out)
    path = scene_path(geometry.scene, out)
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = stages.scene_path(geometry.scene, out).relative_to(out).as_posix()
    write_file_atomically(path, json_file(_layout(geometry, f"../{stage}"), indent=None))


def _layout(geometry: SceneGeometry, stage: str) -> dict[str, Any]:
    """The line of a scene."""
    from stable_data.export.usd_prop import package_path  # OpenUSD is an extra
    from stable_data.export.usd_stage import prim_names

    placed = placed_props(geometry)
    named = list(zip(prim_names(placed), placed, strict=True))
    _, table = table_box(geometry)
    objects = []
    for name, p in named:
        if not p.is_fixed:
            package = package_path(sized_prop(p.prop, p.factor)).as_posix()
            asset = {"registry_name": "simready_usd_object", "params": {"usd_path": f"../props/{package}"}}
            known = {"mass": p.mass.mass, "friction": sliding_friction(p), **object_facts(p)}
            objects.append({"id": name, **asset, "stable_data": known})
    return {
        "variations": {
            "scene.relation_placement": {
                "layout_id": geometry.scene.scene_id,
                "source": "stable-data",
                "poses": {n: {"position_xyz": p.position, "rotation_xyzw": p.quat_xyzw} for n, p in named if not p.is_fixed},
            }
        },
        "stable_data": {
            "frame": FRAME,
            "background": {
                "usd_path": stage,
                "prims": ["/World/Table", "/World/Furniture", *(f"/World/Objects/{n}" for n, p in named if p.is_fixed)],
                "table_size": table,
            },
            "objects": objects,
            **scene_facts(geometry),
        },
    }
