"""Mass, centre of mass and inertia of an imported asset: as its source states them, where they can be; else from a density.

The table ``densities.csv`` names the source of each density. They are effective ones: a bottle counts as it stands on a table, with
air or liquid in it. A density of a thing with thin walls would make a model with thick ones, or a solid one, far too heavy: ``fill`` is the
largest share of its convex hull that a thing of the category fills, and more does not count.
"""

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.geometry.convex_decomposition import hull_of_mesh, inside_convex
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_repair import MeshReport
from stable_data.importers.conversion.naming import Vocabulary
from stable_data.importers.source import GivenInertial
from stable_data.instructions.wording.words import type_words
from stable_data.scene import FloatArray

DEFAULT_DENSITY = 400.0
"""Density of what is not known, kg/m³: that of the stability verdict."""

_LIKELY = (5.0, 25_000.0)  # densities of solids, kg/m³: from foam to gold and platinum
_OUTSIDE = 0.05  # by how much a centre of mass may lie outside of the hull, share of its size
_ROUNDING = 1e-3  # relative error of an inertia that was written with few digits
_LIGHTEST = 1e-3  # kilograms
_FULLER = 1.1  # share of the hull that an asset may fill, relative to the fullest thing of its category
_MOST_DENSE = 2.0  # density of a thing of a dense material, relative to that of its category


@dataclass(frozen=True, slots=True, eq=False)
class AssetInertial:
    """Mass properties of an asset, in the frame of its mesh (centred box), metres.

    Attributes:
        mass: Kilograms.
        mass_source: ``given``, ``material``, ``category`` or ``default``.
        material: Main material; None if unknown.
        center_of_mass: (3,) float64; None if the source states none that can be.
        inertia: About the centre of mass, (3, 3) float64, kg m²; None likewise.
    """

    mass: float
    mass_source: str
    material: str | None
    center_of_mass: FloatArray | None
    inertia: FloatArray | None


def inertial_of(
    given: GivenInertial | None,
    mesh: Mesh,
    report: MeshReport,
    *,
    asset_id: str,
    category: str,
    words: Iterable[str] = (),
    center: FloatArray | None = None,
) -> tuple[AssetInertial, tuple[Notice, ...]]:
    """Checks what a source states about the mass of an asset, and fills what it does not.

    Args:
        given: As the source states it, metres, frame of its surfaces; None if it states nothing.
        mesh: Repaired, metres, centred on its box.
        report: Its properties.
        asset_id: The asset, for notices.
        category: Its category.
        words: Words of its name, description and tags, among which a material may be.
        center: The origin of the mesh in the frame of ``given``, metres; None for no shift.
    """
    material = material_of(words)
    volume = report.volume if report.is_solid else 0.0
    if given is None or not given.is_weighed or not 0 < given.mass < float("inf"):
        density, source = _density(material, category)
        mass = mass_properties(mesh, density=density, is_sheet=not report.is_solid).mass
        if volume > 0:
            mass *= _counted_share(mesh, volume, category)
        return AssetInertial(max(_LIGHTEST, mass), source, material, None, None), _not_a_mass(asset_id, given)
    notices: tuple[Notice, ...] = ()
    if volume > 0 and not _LIKELY[0] <= given.mass / volume <= _LIKELY[1]:
        message = (
            f"asset {asset_id}: weighs {given.mass:.4g} kg at {1e6 * volume:.4g} cm3, which is {given.mass / volume:.3g} kg/m3, expected "
            f"{_LIKELY[0]:g} to {_LIKELY[1]:g}; the mass is kept; check the unit of the file"
        )
        notices += (Notice(asset_id, "inertial", "mass_implausible", message),)
    com, wrong = _center_of_mass(given, mesh, np.zeros(3) if center is None else center, asset_id)
    inertia, odd = _inertia(given, com, asset_id)
    return AssetInertial(given.mass, "given", material, com, inertia), (*notices, *wrong, *odd)


def material_of(words: Iterable[str]) -> str | None:
    """Returns the main material that words name, None if they name none or several."""
    found = {_materials()[word] for word in words if word in _materials()}
    return found.pop() if len(found) == 1 else None


def _density(material: str | None, category: str) -> tuple[float, str]:
    """Density, kg/m³, and what it rests on. A thing is rarely as dense as its material: a steel bottle is hollow."""
    densities = _densities()
    of_category = densities.get(("category", _weighed_categories().known(category)))
    if material is not None:
        own = densities["material", material]
        return (own if of_category is None else min(own, _MOST_DENSE * of_category)), "material"
    return (DEFAULT_DENSITY, "default") if of_category is None else (of_category, "category")


def _counted_share(mesh: Mesh, volume: float, category: str) -> float:
    """The share of a solid's volume that things of its category have too."""
    most = _fills().get(_weighed_categories().known(category))
    if most is None:
        return 1.0
    try:
        hull = mass_properties(hull_of_mesh(mesh), density=1.0).mass
    except MeshError:  # too thin for a hull
        return 1.0
    return min(1.0, _FULLER * most * hull / volume)


def _not_a_mass(asset_id: str, given: GivenInertial | None) -> tuple[Notice, ...]:
    if given is None or not given.is_weighed:
        return ()
    message = f"asset {asset_id}: mass is {given.mass} kg, expected a finite value above 0; it is estimated instead"
    return (Notice(asset_id, "inertial", "mass_implausible", message),)


def _center_of_mass(
    given: GivenInertial, mesh: Mesh, center: FloatArray, asset_id: str
) -> tuple[FloatArray | None, tuple[Notice, ...]]:
    """The centre of mass in the frame of the mesh, if it can be."""
    if given.center_of_mass is None:
        return None, ()
    com = np.asarray(given.center_of_mass, np.float64) - center
    try:
        hull = hull_of_mesh(Mesh(mesh.vertices * (1 + 2 * _OUTSIDE), mesh.faces))
        is_inside = bool(np.isfinite(com).all()) and bool(inside_convex(hull, com[None])[0])
    except MeshError:
        is_inside = False
    if is_inside:
        return com, ()
    message = (
        f"asset {asset_id}: its centre of mass is {np.round(com, 4).tolist()} m from the centre of its box, expected a point in its hull; "
        "that of a homogeneous body is used"
    )
    return None, (Notice(asset_id, "inertial", "inertia_replaced", message),)


def _inertia(given: GivenInertial, com: FloatArray | None, asset_id: str) -> tuple[FloatArray | None, tuple[Notice, ...]]:
    """The inertia, if it is one that a body can have; it is about the centre of mass, so it counts only with that."""
    if given.inertia is None:
        return None, ()
    tensor = np.asarray(given.inertia, np.float64).reshape(3, 3)
    if com is None and given.center_of_mass is not None:
        return None, ()  # the notice about the centre of mass says it
    is_symmetric = np.isfinite(tensor).all() and np.allclose(tensor, tensor.T, rtol=0, atol=_ROUNDING * np.abs(tensor).max())
    if is_symmetric:
        tensor = (tensor + tensor.T) / 2
        moments = np.linalg.eigvalsh(tensor)
        if moments[0] > 0 and moments[2] <= (moments[0] + moments[1]) * (1 + _ROUNDING):
            return tensor, ()
    message = (
        f"asset {asset_id}: its inertia {np.round(tensor, 8).tolist()} kg m2 is none that a body can have, expected a symmetric positive "
        "tensor whose moments fulfil the triangle inequality; that of a homogeneous body is used"
    )
    return None, (Notice(asset_id, "inertial", "inertia_replaced", message),)


@lru_cache(maxsize=1)
def _rows() -> tuple[Mapping[str, str], ...]:
    text = files("stable_data.importers.conversion").joinpath("densities.csv").read_text("utf-8")
    return tuple(csv.DictReader(text.splitlines()))


@lru_cache(maxsize=1)
def _densities() -> Mapping[tuple[str, str], float]:
    return {(row["kind"], row["name"]): float(row["density"]) for row in _rows()}


@lru_cache(maxsize=1)
def _fills() -> Mapping[str, float]:
    return {row["name"]: float(row["fill"]) for row in _rows() if row["fill"]}


@lru_cache(maxsize=1)
def _weighed_categories() -> Vocabulary:
    return Vocabulary(name for kind, name in _densities() if kind == "category")


@lru_cache(maxsize=1)
def _materials() -> Mapping[str, str]:
    return {word: row["name"] for row in _rows() if row["kind"] == "material" for word in type_words(row["words"])}
