"""Collision shapes as closed meshes."""

import numpy as np

from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray


def closed_mesh(triangles: FloatArray) -> Mesh:
    """Joins the corners of triangles (F, 3, 3) that lie at the very same place, such as those of a simple shape."""
    vertices, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(vertices, corners.reshape(-1, 3))
