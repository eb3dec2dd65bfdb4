"""Assets as readers would give them, of simple shapes."""

from typing import Any

import numpy as np

from stable_data.geometry.mesh import Mesh, double_areas
from stable_data.geometry.surface import Surface
from stable_data.importers.source import GivenLicence, SourceAsset
from stable_data.scene import FloatArray

CC0 = (GivenLicence("CC0 1.0", "LICENSE.txt"),)


def box(x: float, y: float, z: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A closed box around a point."""
    corners = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)]) * (x, y, z)
    sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return Mesh(corners + at, sides[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))


def revolved(radii_heights: list[tuple[float, float]], segments: int = 32) -> Mesh:
    """A closed solid of revolution about z from its profile, from the middle of its bottom to the middle of its top."""
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(segments, h)], axis=1) for r, h in radii_heights]
    vertices = np.concatenate(rings)
    faces = []
    for ring in range(len(rings) - 1):
        for k in range(segments):
            a, b = ring * segments + k, ring * segments + (k + 1) % segments
            faces += [[a, b, b + segments], [a, b + segments, a + segments]]
    kept = Mesh(vertices, np.array(faces))
    areas = double_areas(kept)
    return Mesh(vertices, kept.faces[areas > 1e-15])


CUP = [(0.0, 0.0), (0.03, 0.0), (0.04, 0.09), (0.036, 0.09), (0.027, 0.005), (0.0, 0.005)]
"""Profile of a cup, metres."""

BOTTLE = [(0.0, 0.0), (0.035, 0.0), (0.035, 0.16), (0.013, 0.2), (0.013, 0.25), (0.0, 0.25)]
"""Profile of a bottle, metres."""

PLATE = [(0.0, 0.0), (0.08, 0.0), (0.13, 0.02), (0.13, 0.024), (0.08, 0.004), (0.0, 0.004)]
"""Profile of a plate, metres."""


def asset(mesh: Mesh | FloatArray, name: str = "thing", **given: Any) -> SourceAsset:
    """An asset with one surface and a free licence."""
    triangles = mesh.triangles if isinstance(mesh, Mesh) else mesh
    surface = Surface(triangles, colour=(0.5, 0.2, 0.1))
    return SourceAsset(name, name, (surface,), **({"licences": CC0} | given))
