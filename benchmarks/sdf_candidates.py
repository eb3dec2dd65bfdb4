"""Comparison of libraries for signed distance on real meshes: accuracy, robustness, speed.

``python -m benchmarks.sdf_candidates DIR [--limit N] [--json FILE]``, DIR a folder of GLBs; only meshes that are watertight
after repair count. Half of the points are in the box, half within 2 % of the largest extent from the surface.

- distance: compared with the distance to every triangle of the mesh, in numpy, without a library;
- sign: compared with the exact winding number of the closed mesh, for the mesh itself, with a tenth of its faces flipped, with
  those faces repaired by ``repair`` like every mesh of the toolkit, and with a patch of 2 % of its faces removed.

Times are processor seconds of this process, with the construction of trees. Run with ``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``.
"""

import json
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, TypeAlias

import igl
import numpy as np
import pysdf
import trimesh
import typer
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.meshes import repaired_meshes
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.geometry.sdf.build import probe_points, unit_mesh
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.sdf.narrow_band import distance_to_faces
from stable_data.geometry.sdf.second_opinion import PysdfDistance
from stable_data.scene import FloatArray

Candidate: TypeAlias = Callable[[Mesh, FloatArray], FloatArray]
Row: TypeAlias = dict[str, list[float]]

_NUM_SIGN, _NUM_DISTANCE, _NUM_SPEED, _NUM_SLOW = 1000, 100, 20_000, 200
_TURNED, _PATCH, _NEAR = 0.1, 0.02, 0.02
_VARIANTS = ("whole", "turned", "mended", "cut")
_SIGN_ONLY = ("embree parity",)
_SLOW = ("trimesh",)


def _pysdf(is_robust: bool) -> Candidate:
    """Returns a candidate that inverts the sign of pysdf, which is positive inside."""

    def signed(mesh: Mesh, points: FloatArray) -> FloatArray:
        tree = pysdf.SDF(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), robust=is_robust)
        return -np.asarray(tree.calc(points.astype(np.float32), n_threads=1), np.float64)

    return signed


def _pseudonormal(mesh: Mesh, points: FloatArray) -> FloatArray:
    """Returns libigl's distance with the sign of the normal at the nearest point."""
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    found: FloatArray = igl.signed_distance(points, mesh.vertices, mesh.faces, sign_type=kind)[0]
    return found


def _parity(mesh: Mesh, points: FloatArray) -> FloatArray:
    """Embree's ray parity: −1 inside, 1 outside."""
    given = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return np.where(RayMeshIntersector(given).contains_points(points), -1.0, 1.0)


def _trimesh(mesh: Mesh, points: FloatArray) -> FloatArray:
    """Returns trimesh's distance with its sign inverted: it is positive inside."""
    given = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return -np.asarray(trimesh.proximity.signed_distance(given, points), np.float64)


CANDIDATES: dict[str, Candidate] = {
    "libigl tree + winding": lambda mesh, points: SignedDistance(mesh)(points),
    "libigl pseudonormal": _pseudonormal,
    "pysdf robust, subdivided": lambda mesh, points: PysdfDistance(mesh)(points),
    "pysdf robust": _pysdf(True),
    "pysdf": _pysdf(False),
    "embree parity": _parity,
}
if find_spec("rtree"):  # trimesh needs it for this and does not install it
    CANDIDATES["trimesh"] = _trimesh


def _points(mesh: Mesh, num: int, rng: np.random.Generator) -> FloatArray:
    """Returns points, half in the box and a little around it, half near the surface."""
    surface, normals = probe_points(mesh, num // 2)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    beside = surface + rng.uniform(-_NEAR, _NEAR, (len(surface), 1)) * normals
    return rng.permutation(np.concatenate([rng.uniform(low - 0.1, high + 0.1, (num - len(surface), 3)), beside]))


def _turned(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Flips a tenth of the faces."""
    faces = mesh.faces.copy()
    chosen = rng.choice(len(faces), max(1, int(_TURNED * len(faces))), replace=False)
    faces[chosen] = faces[chosen, ::-1]
    return Mesh(mesh.vertices, faces)


def _cut(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Removes the faces around a point of the surface."""
    centre = mesh.triangles.mean(axis=1)
    gap = np.linalg.norm(centre - centre[rng.integers(len(centre))], axis=1)
    return Mesh(mesh.vertices, mesh.faces[np.argsort(gap)[max(1, int(_PATCH * len(gap))) :]])


def _mended(mesh: Mesh) -> Mesh:
    """Repairs a mesh, and moves it back to its place: repair centres it."""
    repaired = repair_mesh(mesh, "turned")[0]
    return Mesh(repaired.vertices + (mesh.vertices.min(axis=0) - repaired.vertices.min(axis=0)), repaired.faces)


def _truth(mesh: Mesh, points: FloatArray) -> FloatArray:
    """Computes the unsigned distance by testing every triangle, (P,)."""
    triangles = mesh.triangles
    return np.array([distance_to_faces(np.tile(p, (len(triangles), 1)), triangles).min() for p in points])


def measure(mesh: Mesh, rng: np.random.Generator, rows: dict[str, Row]) -> None:
    """Adds the figures of one mesh to every candidate."""
    many = _points(mesh, _NUM_SPEED, rng)
    asked = many[:_NUM_SIGN]
    inside = igl.winding_number(mesh.vertices, mesh.faces, asked) > 0.5
    truth = _truth(mesh, asked[:_NUM_DISTANCE])
    turned = _turned(mesh, rng)
    variants = {"whole": mesh, "turned": turned, "mended": _mended(turned), "cut": _cut(mesh, rng)}
    for name, candidate in CANDIDATES.items():
        row = rows[name]
        for kind, variant in variants.items():
            found = candidate(variant, asked)
            row.setdefault(f"wrong_sign_{kind}", []).append(float(np.mean((found < 0) != inside)))
            if kind == "whole" and name not in _SIGN_ONLY:
                error = np.abs(np.abs(found[:_NUM_DISTANCE]) - truth)
                row.setdefault("max_error", []).append(float(error.max()))
        timed = many[:_NUM_SLOW] if name in _SLOW else many
        start = time.process_time()
        candidate(mesh, timed)
        row.setdefault("microseconds", []).append((time.process_time() - start) / len(timed) * 1e6)


def main(
    folder: Annotated[Path, typer.Argument(help="GLB files")],
    limit: Annotated[int, typer.Option(help="assets, spread evenly over the folder; 0 for all")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="file for the figures")] = None,
) -> None:
    """Prints a line for each candidate, and writes the figures as JSON."""
    rng = np.random.default_rng(0)
    rows: dict[str, Row] = {name: {} for name in CANDIDATES}
    for _, mesh, report in repaired_meshes(folder, limit):
        if report.is_watertight:
            measure(unit_mesh(mesh)[0], rng, rows)
    print(f"{'candidate':<24}{'max error':>11}" + "".join(f"{v:>9}" for v in _VARIANTS) + f"{'us/point':>10}")
    for name, row in rows.items():
        error = f"{max(row['max_error']):.1e}" if "max_error" in row else "-"
        wrong = "".join(f"{100 * np.mean(row[f'wrong_sign_{v}']):>8.2f}%" for v in _VARIANTS)
        print(f"{name:<24}{error:>11}{wrong}{np.median(row['microseconds']):>10.2f}")
    if json_file:
        json_file.write_text(json.dumps(rows, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
