"""Mass properties of a mesh: mass, centre of mass and inertia."""

from dataclasses import dataclass

import numpy as np

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, double_areas, signed_volumes
from stable_data.scene import FloatArray

# Second moments of a body are never negative. Numbers that were rounded may give one that is slightly below 0: it is raised to a
# small share of their sum, which a physics engine accepts. One that is farther below 0 belongs to no body, and two that are nearly 0
# belong to a rod without thickness, which could spin at any speed.
_ROUNDED, _SMALLEST, _THINNEST = 1e-2, 1e-6, 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class MassProperties:
    """The mass of an object and its distribution.

    Attributes:
        mass: Kilograms.
        center_of_mass: (3,) float64, metres, the mesh's frame.
        inertia: About the centre of mass, (3, 3) float64, kg m², axes of the mesh's frame.
    """

    mass: float
    center_of_mass: FloatArray
    inertia: FloatArray


def mass_properties(
    mesh: Mesh, *, mass: float | None = None, density: float | None = None, is_sheet: bool = False, thickness: float = 2e-3
) -> MassProperties:
    """Computes mass, centre and inertia of a homogeneous object in the mesh's frame, exactly for its triangles.

    Args:
        mesh: Metres; the faces of a solid point outward.
        mass: Kilograms; this or ``density``.
        density: kg/m³; this or ``mass``.
        is_sheet: Treat the surface as a shell instead of the volume (``MeshReport.is_sheet``).
        thickness: Of the shell, metres; it changes the mass that a density gives, but not the shape of the inertia.

    Raises:
        MeshError: ``mass_invalid``: both or neither of mass and density are given, or a value is not positive.
        MeshError: ``mass_no_volume``: a solid that encloses no volume; it may be a sheet, or inside out.
    """
    given = [m for m in (mass, density) if m is not None]
    if len(given) != 1 or not (0 < given[0] < float("inf") and thickness > 0):
        raise MeshError(
            f"mass is {mass}, density {density}, thickness {thickness}, expected exactly one of mass and density, and positive values",
            "mass_invalid",
        )
    corners = mesh.triangles
    total = corners.sum(axis=1)
    # Exact integrals of 1, x and x xᵀ: over a triangle (d = 2), or over the tetrahedron from the origin to it (d = 3).
    weight, d = (double_areas(mesh) / 2 * thickness, 2) if is_sheet else (signed_volumes(corners), 3)
    content = float(weight.sum())
    if content <= 0:
        message = f"mesh encloses {content:.3g} m3, expected more than 0; is it a sheet, or inside out?"
        raise MeshError(message, "mass_no_volume")
    center = weight @ total / ((d + 1) * content)
    second = np.einsum("f,fni,fnj->ij", weight, corners, corners) + np.einsum("f,fi,fj->ij", weight, total, total)
    second = second / ((d + 1) * (d + 2)) - content * np.outer(center, center)  # parallel axis theorem
    kilograms = mass if mass is not None else given[0] * content
    inertia = inertia_of(second) * (kilograms / content)  # second moments are those of density 1
    return MassProperties(kilograms, center, inertia)


def inertia_of(moments: FloatArray) -> FloatArray:
    """Computes the inertia tensor of a body, (3, 3), from the second moments of its mass, ∫ x xᵀ dm, (3, 3)."""
    return np.asarray(np.trace(moments) * np.eye(3) - moments)


def second_moments(inertia: FloatArray) -> FloatArray:
    """Computes the second moments of a body's mass, ∫ x xᵀ dm, (3, 3), from its inertia tensor, (3, 3)."""
    return np.asarray(np.trace(inertia) / 2 * np.eye(3) - inertia)


def usable_inertia(tensor: FloatArray) -> FloatArray | None:
    """Returns an inertia tensor, (3, 3), without its rounding errors; None if no body can have it, or only a rod without thickness."""
    tensor = (tensor + tensor.T) / 2
    moments, axes = np.linalg.eigh(second_moments(tensor))
    total = float(moments.sum())
    if not (total > 0 and moments[0] >= -_ROUNDED * total and moments[1] >= _THINNEST * total):
        return None
    if moments[0] >= _SMALLEST * total:
        return tensor
    return inertia_of((axes * np.maximum(moments, _SMALLEST * total)) @ axes.T)
