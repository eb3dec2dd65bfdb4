"""The speed of finding surfaces: ``python -m benchmarks.supports [LIBRARY …] [--faces N] [--json FILE]``.

For the furniture of libraries, and for a shelf of six boards that is divided into more and more faces: the time to find its surfaces, to
choose the tables, and to find what is in the way, compared with the time that the repair of the same mesh takes. Run with
``OMP_NUM_THREADS=1``.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipelines.reports.text_table import align_columns
from pipelines.sources.assets import AssetLibraries, absolute_places
from stable_data.assets.store import AssetStore
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.shape import Shape
from stable_data.supports import as_tabletop, find_obstacles, find_surfaces, seen_from_open_side

_ROUNDS = 3
_BOARDS = 6


@dataclass(frozen=True, slots=True)
class SupportFigure:
    """The times of one support, milliseconds, the best of three rounds.

    Attributes:
        name: The support.
        num_faces: Faces of its mesh.
        num_surfaces: Its surfaces.
        num_obstacles: Bodies that are in the way on all of them.
        surfaces_ms: To find the surfaces.
        tables_ms: To choose the tables on all of them, and the sides from which they are seen.
        obstacles_ms: To find what is in the way on all of them.
    """

    name: str
    num_faces: int
    num_surfaces: int
    num_obstacles: int
    surfaces_ms: float
    tables_ms: float
    obstacles_ms: float


def measure(name: str, mesh: Mesh) -> SupportFigure:
    """Measures one support."""
    rows = []
    for _ in range(_ROUNDS):
        times = [time.perf_counter()]
        surfaces = find_surfaces(mesh)
        times.append(time.perf_counter())
        fits = [seen_from_open_side(mesh, s, as_tabletop(s)) for s in surfaces]
        times.append(time.perf_counter())
        parts = [find_obstacles(mesh, fit.frame(s), fit.tabletop) for s, fit in zip(surfaces, fits, strict=True)]
        times.append(time.perf_counter())
        rows.append(np.diff(times))
    best = np.min(rows, axis=0)
    finding, choosing, blocking = (round(1e3 * float(seconds), 1) for seconds in best)
    return SupportFigure(name, len(mesh.faces), len(surfaces), sum(map(len, parts)), finding, choosing, blocking)


def shelf(num_faces: int) -> Mesh:
    """A shelf of six boards between side walls and a back, with about so many faces of equal size."""

    def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
        made = Shape.box((high[0] - low[0], high[1] - low[1], high[2] - low[2]))
        return Mesh(made.vertices + (np.array(low) + high) / 2, made.faces)

    boards = [box((0.02, 0.0, z), (0.78, 0.29, z + 0.02)) for z in np.linspace(0.1, 1.9, _BOARDS).tolist()]
    sides = [box((x, 0.0, 0.0), (x + 0.02, 0.3, 2.0)) for x in (0.0, 0.78)]
    mesh = join_meshes([*boards, *sides, box((0.02, 0.29, 0.0), (0.78, 0.3, 2.0))])
    while len(mesh.faces) < num_faces:
        mesh = _divided(mesh)
    return mesh


def _divided(mesh: Mesh) -> Mesh:
    """The same mesh with each face as four."""
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices, index = np.unique(np.round(corners.reshape(-1, 3), 9), axis=0, return_inverse=True)
    return Mesh(vertices, index.reshape(-1, 3))


def main() -> None:
    """Prints the figures and writes them to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("library", nargs="*", help="libraries with furniture")
    parser.add_argument("--faces", type=int, default=200_000, help="most faces of the shelf")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    figures = []
    for library in arguments.library:
        shelves = AssetLibraries((), scenes=absolute_places([library])[0])
        store = AssetStore(shelves)
        figures += [measure(asset_id, store.asset(asset_id).mesh) for asset_id in shelves.asset_ids]
    size = 100
    while size <= arguments.faces:
        figures.append(measure(f"shelf of {_BOARDS} boards", shelf(size)))
        size *= 12
    names = ["support", "faces", "surfaces", "obstacles", "surfaces, ms", "tables, ms", "obstacles, ms"]
    print(align_columns([names, *([str(value) for value in asdict(figure).values()] for figure in figures)], 1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
