"""Targets: scene files of other projects, audited and with new poses."""

import json
import tempfile
from pathlib import Path

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.mutation.glb_edits import joined_glb
from benchmarks.fuzzing.targets import source_files as files
from benchmarks.fuzzing.targets.meshes import picture
from benchmarks.fuzzing.targets.results import check_finite, check_lint, check_notices, check_scene
from stable_data.errors import SceneError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.lint import lint_scene_files, scene_candidates
from stable_data.importers.scenes.opening import OpenedScene, read_scene_file
from stable_data.importers.scenes.scene_file import SceneFile
from stable_data.importers.tabletopgen import convert_scene, scene_folders
from stable_data.mesatask import MesaTaskDataset

_PHYSICS_WORDS = (
    *(
        "KHR_physics_rigid_bodies",
        "KHR_implicit_shapes",
        "OMI_physics_body",
        "OMI_physics_shape",
        "motion",
        "collider",
        "geometry",
        "shape",
        "mesh",
    ),
    *(
        "convexHull",
        "mass",
        "centerOfMass",
        "inertiaDiagonal",
        "isKinematic",
        "box",
        "sphere",
        "capsule",
        "cylinder",
        "radiusTop",
        "height",
        "size",
    ),
    *(
        "-rigid",
        "-col",
        "-convcolonly",
        "translation",
        "rotation",
        "scale",
        "matrix",
        "children",
        "animations",
        "channels",
        "extensions",
        "friction",
    ),
)


def _mjcf() -> list[Base]:
    contents = {"scene.xml": files.MJCF_SCENE, "parts/things.xml": files.MJCF_THINGS, "meshes/wedge.obj": files.WEDGE}
    return [Base("scene", contents, {"scene.xml": 6, "parts/things.xml": 2, "meshes/wedge.obj": 1})]


def _gltf() -> list[Base]:
    document, content = files.gltf_scene()
    joined = json.loads(json.dumps(document))
    joined["buffers"][0].pop("uri")
    beside = {"picture.png": picture("PNG")}
    return [
        Base("gltf", {"scene.gltf": files.dumped(document), "thing.bin": content, **beside}, {"scene.gltf": 4, "thing.bin": 1}),
        Base("glb", {"scene.glb": joined_glb(json.dumps(joined).encode(), content), **beside}, {"scene.glb": 1}),
    ]


def _usd() -> list[Base]:
    layers = {"scene.usda": files.USDA_SCENE, "bottle.usda": files.USDA_BOTTLE}
    return [Base("usda", layers, {"scene.usda": 5, "bottle.usda": 1})]


_MAIN = {"scene": "scene.xml", "gltf": "scene.gltf", "glb": "scene.glb", "usda": "scene.usda"}


def _check_file(file: SceneFile) -> None:
    for body in file.bodies:
        check_finite(f"body {body.name!r:.80}", body.position, body.quat_xyzw, body.mass, body.center_of_mass, body.inertia)
        check_finite(f"body {body.name!r:.80}", *(part.vertices for part in body.parts))


def _move(opened: OpenedScene, base: str) -> None:
    """Puts new poses into the file, without a simulation."""
    poses = {
        b.name: ((b.position[0], b.position[1], b.position[2] + 0.01), b.quat_xyzw) for b in opened.file.bodies if b.is_free
    }
    try:
        if base in ("gltf", "glb"):
            from stable_data.importers.scenes.gltf_patch import patch_nodes

            patch_nodes(opened.scene, poses)  # type: ignore[attr-defined]
        elif base == "scene":
            from stable_data.importers.scenes.mjcf_patch import patch_poses

            patch_poses(opened.scene, poses)  # type: ignore[attr-defined]
        else:
            from stable_data.importers.scenes.usd_scenes import write_overrides

            write_overrides(opened, poses)  # type: ignore[arg-type]
    except SceneError:
        return  # a pose that cannot be changed


def _read_scene(folder: Path, base: str) -> bool:
    opened = read_scene_file(Boundary(folder), _MAIN[base])
    _check_file(opened.file)
    _move(opened, base)
    return True


def _audit(folder: Path, base: str) -> bool:
    result = lint_scene_files(folder, scene_candidates(folder))
    check_lint(result)
    return bool(result.rows)


def _audited() -> list[Base]:
    return [*_mjcf(), *_gltf(), *_usd()]


_TABLETOPGEN = {
    "layout_pose.json": {
        "main_object": "table_0",
        "objects": {
            "table_0": {"size": [120, 80, 75], "pose": [0, 0, 37.5]},
            "red thing_1": {"size": [10, 12, 8.5], "pose": [-20.5, 10, 79.25]},
        },
    },
    "layout_rotation.json": {"table_0": 0.0, "red thing_1": 35.5},
    "placement_order.json": {"table_0": {"order": 1, "on_top_of": None}, "red thing_1": {"order": 2, "on_top_of": ["table_0"]}},
}


def _tabletopgen() -> list[Base]:
    document, content = files.gltf()
    document["buffers"][0].pop("uri")
    assets = "scene_1/output_assets"
    layouts = {f"{assets}/layout_json/{name}": files.dumped(content) for name, content in _TABLETOPGEN.items()}
    mesh = f"{assets}/centered_mesh/red thing_1.glb"
    contents = {**layouts, mesh: joined_glb(json.dumps(document).encode(), content), "picture.png": picture("PNG")}
    return [Base("scene", contents, {**dict.fromkeys(layouts, 2.0), mesh: 1.0})]


def _convert_tabletopgen(folder: Path, base: str) -> bool:
    out = Path(tempfile.gettempdir(), "converted")
    (name,) = scene_folders(folder)
    check_notices(convert_scene(folder, name, name, out).notices)
    check_scene(MesaTaskDataset(out).read(name)[0])
    return True


TARGETS = (
    Target("scene_mjcf", 5, _mjcf, _read_scene, files.XML_WORDS),
    Target("scene_gltf", 6, _gltf, _read_scene, _PHYSICS_WORDS),
    Target("scene_usd", 5, _usd, _read_scene, files.USD_WORDS),
    Target("scene_tabletopgen", 5, _tabletopgen, _convert_tabletopgen, ("main_object", "on_top_of", "size", "pose")),
    Target("scene_audit", 5, _audited, _audit, (*_PHYSICS_WORDS, *files.XML_WORDS, *files.USD_WORDS), block=50),
)
"""The targets of this module."""
