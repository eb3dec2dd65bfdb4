"""The meshes of the benchmarks."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_repair import MeshReport, repair_mesh


def repaired_meshes(folder: Path, limit: int) -> Iterator[tuple[str, Mesh, MeshReport]]:
    """Yields asset ids, repaired meshes and their reports; leaves out files that cannot be used, like the preprocess job.

    Args:
        folder: Folder of GLB files.
        limit: Largest number of files, spread evenly over the folder; 0 for all.
    """
    paths = sorted(folder.glob("*.glb"))
    if limit:
        paths = [paths[i] for i in np.linspace(0, len(paths) - 1, min(limit, len(paths))).astype(int)]
    for path in tqdm(paths, "meshes"):
        try:
            mesh, report, _ = repair_mesh(load_glb(path, path.stem)[0], path.stem)
        except MeshError as error:
            tqdm.write(f"left out: {error}")
            continue
        yield path.stem, mesh, report
