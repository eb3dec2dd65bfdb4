"""Columns of the tables ``assets`` and ``meshes`` that follow from a repaired mesh, whoever makes the rows."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from stable_data.geometry.convex_decomposition import ConvexPart, convex_parts
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint
from stable_data.geometry.mesh_repair import MeshReport
from stable_data.geometry.surface_sampling import surface_points
from stable_data.scene import Vec3
from stable_data.storage.schemas import Row


def shape_columns(asset_id: str, mesh: Mesh, report: MeshReport, num_points: int) -> Row:
    """The columns of ``assets`` that describe the mesh in its own unit.

    Args:
        asset_id: The asset; the choice of its surface points depends on it.
        mesh: Repaired, mesh units.
        report: Its properties and repairs.
        num_points: Surface points.
    """
    seed = int(hashlib.sha256(asset_id.encode()).hexdigest()[:8], 16)
    points, normals = surface_points(mesh, num_points, np.random.default_rng(seed))
    return {
        "extents": mesh.extents.tolist(),
        "report": asdict(report),
        "points": points.ravel(),
        "normals": normals.ravel(),
    }


def volume_columns(mesh: Mesh, report: MeshReport, scale: Vec3) -> Row:
    """The columns of ``assets`` that describe the homogeneous object at a scale.

    Args:
        mesh: Repaired, mesh units.
        report: Its properties.
        scale: Metres per mesh unit along the mesh's axes.
    """
    scaled = Mesh(mesh.vertices * scale, mesh.faces)
    weighed = mass_properties(scaled, mass=1.0, is_sheet=not report.is_solid)
    x, y, z = scale
    return {
        "volume": report.volume * x * y * z,
        "center_of_mass": weighed.center_of_mass.tolist(),
        "inertia_per_mass": weighed.inertia.ravel().tolist(),
    }


def file_columns(asset_id: str, mesh: Mesh, paint: Paint) -> Row:
    """The columns of ``meshes`` for the file of a mesh and its hash.

    Args:
        asset_id: The asset.
        mesh: Repaired, mesh units.
        paint: Display colours and the faces that have them.
    """
    glb = write_glb(mesh, paint=paint, keeps_order=True)
    return {"asset_id": asset_id, "glb": glb, "sha256": hashlib.sha256(glb).hexdigest()}


def part_columns(mesh: Mesh, *, given: Sequence[ConvexPart] = (), kept: bool = False) -> Row:
    """The columns of ``meshes`` for its convex parts; the arguments are those of :func:`convex_parts`.

    Raises:
        MeshError: ``convex_failed``: the mesh gives no part with a volume.
    """
    parts = convex_parts(mesh, given=given, kept=kept)
    return {
        "parts": [{"vertices": p.vertices.ravel(), "faces": p.faces.ravel()} for p in parts.parts],
        "parts_method": parts.method,
        "parts_overfill_max": parts.overfill_max,
        "parts_overfill_mean": parts.overfill_mean,
        "parts_uncovered_max": parts.uncovered_max,
        "parts_uncovered_mean": parts.uncovered_mean,
        "hull_distance": parts.hull_distance,
    }
