"""The construction of signed-distance grids, against exact queries at every node: speed and accuracy.

``python -m benchmarks.sdf_grid DIR [--limit N] [--json FILE]``, DIR a folder of GLBs. For each mesh, repaired:

- dense: the exact signed distance at every node of the same grid, by the same library (libigl), with trees built once;
- ours: all of ``build_grid``, with the choice of the spacing and the measurement of its errors.

Times are processor seconds of this process over all threads, so they do not depend on other work of the machine.
"""

import json
import resource
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from benchmarks.meshes import repaired_meshes
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_repair import MeshReport
from stable_data.geometry.sdf.build import build_grid, measure_grid_errors, unit_mesh
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.sdf.grid import SdfGrid
from stable_data.geometry.sdf.narrow_band import GridNodes
from stable_data.scene import FloatArray

_NUM_NEAR, _NUM_FAR = 4096, 2048


@dataclass(frozen=True, slots=True)
class GridTiming:
    """The figures of one asset. Errors are in spacings, at held-out points within one spacing of the surface if not stated otherwise.

    Attributes:
        asset_id: The asset.
        num_faces: Number of triangles.
        num_nodes: Nodes of the grid.
        nodes_per_wall: Thickness of its wall in spacings, 0 for a sheet.
        dense_seconds: Time of the queries at every node.
        ours_seconds: Time of ``build_grid``.
        dense_error: Mean error of the dense grid.
        ours_error: Mean error of ours.
        dense_max_error: Largest error of the dense grid.
        ours_max_error: Largest error of ours.
        node_error: Largest difference between the two at any node.
        sign_error: Share of nodes at which the two differ in sign.
    """

    asset_id: str
    num_faces: int
    num_nodes: int
    nodes_per_wall: float
    dense_seconds: float
    ours_seconds: float
    dense_error: float
    ours_error: float
    dense_max_error: float
    ours_max_error: float
    node_error: float
    sign_error: float


@dataclass(frozen=True, slots=True)
class GridBenchmark:
    """The measurements of :func:`run`.

    Attributes:
        timings: Asset by asset.
        peak_mebibytes: Largest resident memory of the process until our last grid was built.
        num_threads: Processor seconds divided by wall seconds of the dense evaluation.
    """

    timings: tuple[GridTiming, ...]
    peak_mebibytes: float
    num_threads: float

    def column(self, name: str) -> FloatArray:
        """Returns one attribute of every timing, (assets,)."""
        return np.array([getattr(t, name) for t in self.timings], np.float64)

    def summary(self) -> dict[str, float]:
        """Returns the main figures; ratios are dense over ours for time, ours over dense for errors."""
        dense, ours = self.column("dense_seconds"), self.column("ours_seconds")
        return {
            "assets": len(self.timings),
            "nodes_median": float(np.median(self.column("num_nodes"))),
            "nodes_max": float(self.column("num_nodes").max()),
            "ours_seconds_median": float(np.median(ours)),
            "ours_seconds_max": float(ours.max()),
            "dense_seconds_median": float(np.median(dense)),
            "speedup_median": float(np.median(dense / ours)),
            "speedup_total": float(dense.sum() / ours.sum()),
            "speedup_min": float((dense / ours).min()),
            "error_mean_in_spacings": float(self.column("ours_error").mean()),
            "error_ratio_total": float(self.column("ours_error").sum() / self.column("dense_error").sum()),
            "error_ratio_max": float((self.column("ours_error") / self.column("dense_error")).max()),
            "max_error_ratio_max": float((self.column("ours_max_error") / self.column("dense_max_error")).max()),
            "node_error_max_in_spacings": float(self.column("node_error").max()),
            "wrong_side_share_max": float(self.column("sign_error").max()),
            "peak_mebibytes": self.peak_mebibytes,
            "num_threads": self.num_threads,
        }

    def __str__(self) -> str:
        """Returns the figures, one on each line."""
        return "\n".join(f"{name:<28}{value:>14.4f}" for name, value in self.summary().items())


def run(meshes: Iterable[tuple[str, Mesh, MeshReport]]) -> GridBenchmark:
    """Builds every grid by ``build_grid``, then densely.

    Args:
        meshes: Asset ids, repaired meshes and their reports.

    Returns:
        The figures.
    """
    built = []
    for asset_id, mesh, report in meshes:
        start = time.process_time()
        grid = build_grid(mesh, is_sheet=report.is_sheet)
        built.append((asset_id, mesh, report.is_sheet, grid, time.process_time() - start))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    wall = time.perf_counter()
    cpu = time.process_time()
    timings = tuple(_compare(*one) for one in tqdm(built, "dense"))
    return GridBenchmark(timings, peak, (time.process_time() - cpu) / (time.perf_counter() - wall))


def _compare(asset_id: str, mesh: Mesh, is_sheet: bool, ours: SdfGrid, ours_seconds: float) -> GridTiming:
    """The same grid densely, and both against the exact distance."""
    unit, _ = unit_mesh(mesh)
    nx, ny, nz = ours.values.shape
    lattice = GridNodes(ours.origin, ours.spacing, (nx, ny, nz))
    nodes = np.arange(lattice.size)
    start = time.process_time()
    exact = SignedDistance(unit, is_sheet=is_sheet, shell_thickness=ours.shell_thickness)
    values = exact(lattice.places(nodes)).reshape(lattice.shape)
    dense_seconds = time.process_time() - start
    dense = replace(ours, values=values.astype(np.float16))
    ours, dense = (measure_grid_errors(g, exact, num_near=_NUM_NEAR, num_far=_NUM_FAR) for g in (ours, dense))
    h = ours.spacing
    # A node on the surface has no sign.
    wrong = ((ours.values < 0) != (values < 0)) & (np.abs(values) > 1e-3 * h)
    return GridTiming(
        asset_id=asset_id,
        num_faces=len(mesh.faces),
        num_nodes=lattice.size,
        nodes_per_wall=ours.wall_thickness / h,
        dense_seconds=dense_seconds,
        ours_seconds=ours_seconds,
        dense_error=dense.mean_error / h,
        ours_error=ours.mean_error / h,
        dense_max_error=dense.max_error / h,
        ours_max_error=ours.max_error / h,
        node_error=float(np.abs(ours.values.astype(np.float64) - values).max()) / h,
        sign_error=float(wrong.mean()),
    )


def main(
    folder: Annotated[Path, typer.Argument(help="GLB files")],
    limit: Annotated[int, typer.Option(help="assets, spread evenly over the folder; 0 for all")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="file for the figures")] = None,
) -> None:
    """Prints the figures, and writes them as JSON."""
    found = run(repaired_meshes(folder, limit))
    print(found)
    if json_file:
        document = {"summary": found.summary(), "timings": [asdict(t) for t in found.timings]}
        json_file.write_text(json.dumps(document, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
