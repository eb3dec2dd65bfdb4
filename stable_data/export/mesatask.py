"""Exports to the MesaTask-10K format: layouts, task infos and the meshes in use, as :mod:`stable_data.mesatask` reads them."""

from pathlib import Path

from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.surface_matching import surfaces_on_mesh
from stable_data.mesatask.layout import LAYOUT_FILE
from stable_data.mesatask.library import LIBRARY_FOLDER
from stable_data.mesatask.writing import scene_folder, write_asset, write_scene
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import SceneGeometry

ABOUT = """A dataset in the MesaTask-10K format: `Layout_info/<table type>/<scene>/layout.json` with its `task_info.json`, centimetres,
quaternions xyzw; `Assets_library/<uid>.glb`, y up, with the convex parts as a second mesh that no node shows. `stable-data lint`
and `python -m pipelines preprocess` read it. Meshes are the repaired ones of the run; their faces have the textures of the
asset where the repair left them as they were, else one of up to eight colours."""


def scene_path(scene: Scene, out: Path) -> Path:
    """Returns the layout file of a scene: if it exists, the scene is exported.

    Raises:
        SceneError: Its id or its table type cannot be the name of a folder.
    """
    return scene_folder(out, scene) / LAYOUT_FILE


def export_scene(geometry: SceneGeometry, out: Path) -> None:
    """Writes a scene, and those of its meshes that do not exist yet, see :class:`~stable_data.export.formats.ExportFormat`.

    Raises:
        SceneError: The scene's id or its table type cannot be the name of a folder.
        ConfigError: The id of an asset cannot be the name of a file.
        MeshError: No part with a volume could be made of a mesh.
    """
    extents = {}
    for k, (o, mesh) in enumerate(zip(geometry.scene.objects, geometry.meshes, strict=True)):
        if o.asset_id is None or mesh is None:
            continue
        x, y, z = mesh.extents.tolist()
        extents[o.asset_id] = (x, y, z)
        if not (out / LIBRARY_FOLDER / f"{o.asset_id}.glb").exists():
            look, paint = geometry.look(k), geometry.paint(k)
            surfaces = () if look is None else surfaces_on_mesh(mesh, look.surfaces, paint)
            write_asset(out, o.asset_id, write_glb(mesh, paint=paint, parts=geometry.parts(k), surfaces=surfaces))
    write_scene(out, geometry.scene, extents=extents)
