"""The MesaTask-10K format: layouts, task infos, and the meshes that they use, as :mod:`stable_data.mesatask` reads them."""

from pathlib import Path

from stable_data.geometry.gltf_writer import write_glb
from stable_data.mesatask.layout import LAYOUT_FILE
from stable_data.mesatask.library import LIBRARY_FOLDER
from stable_data.mesatask.writing import scene_folder, write_asset, write_scene
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry

ABOUT = """A dataset in the MesaTask-10K format: `Layout_info/<table type>/<scene>/layout.json` with its `task_info.json`, centimetres,
quaternions xyzw; `Assets_library/<uid>.glb`, y up, with the convex parts as a second mesh that no node shows. `stable-data lint`
and `python -m pipelines preprocess` take it. Meshes are the repaired ones of the run, in up to eight colours each."""


def scene_path(scene: Scene, out: Path) -> Path:
    """Where a scene's layout is: once it is there, the scene is exported.

    Raises:
        SceneError: Its id or its table type cannot be the name of a folder.
    """
    return scene_folder(out, scene) / LAYOUT_FILE


def export_scene(solid: SceneGeometry, out: Path) -> None:
    """Writes a scene, and the meshes that are not there yet.

    Args:
        solid: The scene with its geometry.
        out: The folder of the export.

    Raises:
        SceneError: Its id or its table type cannot be the name of a folder.
        ConfigError: The id of an asset cannot be the name of a file.
        MeshError: Nothing that has a volume could be made of a mesh.
        OSError: The folder cannot be written.
    """
    extents = {}
    for k, (o, mesh) in enumerate(zip(solid.scene.objects, solid.meshes, strict=True)):
        if o.asset_id is None or mesh is None:
            continue
        x, y, z = mesh.extents.tolist()
        extents[o.asset_id] = (x, y, z)
        if not (out / LIBRARY_FOLDER / f"{o.asset_id}.glb").exists():
            write_asset(out, o.asset_id, write_glb(mesh, paint=solid.paint(k), parts=solid.parts(k)))
    write_scene(out, solid.scene, extents=extents)
