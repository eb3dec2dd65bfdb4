"""Checks the rows of assets: their meshes, looks, images and grids are what their hashes and the other columns say."""

from collections.abc import Iterator, Sequence
from sys import intern
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_stored_mesh, load_surfaces, texture_addresses
from stable_data.geometry.mesh import Mesh, double_areas, signed_volumes
from stable_data.geometry.sdf.grid import USUAL_LIMITS
from stable_data.scene import FloatArray
from stable_data.storage.checksums import checksum_of
from stable_data.storage.schemas import Row
from stable_data.verification.findings import Findings
from stable_data.verification.images import image_fault
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.shard_files import ShardFile

_ROUNDING = 1e-5  # of the largest extent: vertices of a file are float32
_MASS_SLACK = 0.01  # of the largest extent: by how much a centre of mass may lie outside of the box
_DENSEST = 25_000.0  # kg/m³: nothing is denser
_LIGHTEST = 1e-3  # kg: the least mass that an import gives to an asset
_NODE_SLACK = 0.01  # spacings: vertices of a file are float32
_LOOK_SLACK = 0.02  # of the largest extent: the box of a look may leave out faces without area


class MeshFacts(NamedTuple):
    """What follows from a stored mesh, in its own unit; the names are those of the report of an asset.

    Attributes:
        extents: Of its box.
        num_vertices: Vertices.
        num_faces: Triangles.
        area: Its surface.
        volume: What it encloses, if it is closed.
    """

    extents: tuple[float, float, float]
    num_vertices: int
    num_faces: int
    area: float
    volume: float


class AssetFacts:
    """What follows from every mesh of a run, and the category of every asset: about 0.5 kB an asset."""

    def __init__(self) -> None:
        self._facts: dict[str, MeshFacts] = {}
        self._categories: dict[str, str] = {}

    def add(self, asset_id: str, mesh: Mesh) -> None:
        """Adds a mesh."""
        x, y, z = mesh.extents.tolist()
        area, volume = float(double_areas(mesh).sum() / 2), float(signed_volumes(mesh.triangles).sum())
        self._facts[asset_id] = MeshFacts((x, y, z), len(mesh.vertices), len(mesh.faces), area, volume)

    def name(self, asset_id: str, category: str) -> None:
        """Adds the category of an asset."""
        self._categories[asset_id] = intern(category)

    def category(self, asset_id: str) -> str | None:
        """The category of an asset; None if it is not known."""
        return self._categories.get(asset_id)

    def extents(self, asset_id: str) -> FloatArray | None:
        """The extents of a mesh, (3,) float64, mesh units; None if it is not known."""
        found = self._facts.get(asset_id)
        return None if found is None else np.array(found.extents)

    def mesh(self, asset_id: str) -> MeshFacts | None:
        """What follows from a mesh; None if it is not known."""
        return self._facts.get(asset_id)


class TextureCheck:
    """Checks rows of ``textures``."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            if checksum_of(row["image"] or b"") != row["sha256"]:
                self._findings.damage(file.name, f"the image does not have the hash {row['sha256']!r:.70} of its row", number)
            elif fault := image_fault(row["image"], row["mime"], (row["width"], row["height"])):
                self._findings.damage(file.name, f"image {row['sha256'][:16]}…: {fault}", number)


class MeshCheck:
    """Checks rows of ``meshes``.

    Args:
        known: Ids of the textures.
        facts: Receives what the meshes are.
        findings: Where damage is noted.
    """

    def __init__(self, known: KnownIds, facts: AssetFacts, findings: Findings) -> None:
        self._known, self._facts, self._findings = known, facts, findings

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            for what in self._faults(row):
                self._findings.damage(file.name, f"asset {row['asset_id']}: {what}", number)

    def _faults(self, row: Row) -> Iterator[str]:
        if row["glb"] is None or checksum_of(row["glb"]) != row["sha256"]:
            yield f"glb does not have the hash {row['sha256']!r:.70} of its row"
            return
        try:
            mesh, _ = load_stored_mesh(row["glb"], row["asset_id"])
        except MeshError as error:
            yield str(error)
            return
        self._facts.add(row["asset_id"], mesh)
        yield from _part_faults(row.get("parts") or (), mesh)
        if row.get("look") is not None:
            yield from self._look_faults(row, mesh)

    def _look_faults(self, row: Row, mesh: Mesh) -> Iterator[str]:
        """Faults of a look: the images that it names are in the run, and it lies on its mesh."""
        names = texture_addresses(row["look"])
        missing = self._known.missing(pa.array(names, pa.string()), ["textures"])
        yield from (
            f"its look names the texture {name}, which is in no row" for name, m in zip(names, missing, strict=True) if m
        )
        try:
            surfaces = load_surfaces(row["look"], row["asset_id"], textures=lambda _: b"")
        except MeshError as error:
            yield str(error)
            return
        corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in surfaces])
        extent = float(mesh.extents.max())
        apart = max(
            float(np.abs(corners.min(axis=0) - mesh.vertices.min(axis=0)).max()),
            float(np.abs(corners.max(axis=0) - mesh.vertices.max(axis=0)).max()),
        )
        if apart > _LOOK_SLACK * extent + (row.get("look_distance") or 0.0):
            yield f"its look is {apart / extent:.1%} of its extent beside its mesh, expected on it"


def _part_faults(parts: Sequence[Row], mesh: Mesh) -> Iterator[str]:
    half = mesh.extents / 2 + 0.5 * float(mesh.extents.max())  # hulls of parts reach beyond a mesh, but never that far
    for number, part in enumerate(parts):
        vertices, faces = np.asarray(part["vertices"], np.float64), np.asarray(part["faces"], np.int64)
        if len(vertices) % 3 or len(faces) % 3 or not len(faces) or faces.min() < 0 or 3 * faces.max() >= len(vertices):
            yield f"part {number} has faces without vertices, expected indices of its {len(vertices) // 3} vertices"
        elif (np.abs(vertices.reshape(-1, 3)) > half).any():
            yield f"part {number} lies beside its mesh, expected on it"


class AssetCheck:
    """Checks rows of ``assets`` against the meshes of the run.

    Args:
        facts: What the meshes are.
        findings: Where damage is noted.
    """

    def __init__(self, facts: AssetFacts, findings: Findings) -> None:
        self._facts, self._findings = facts, findings

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            self._facts.name(row["asset_id"], row["category"] or "")
            for what in self._faults(row):
                self._findings.damage(file.name, f"asset {row['asset_id']}: {what}", number)

    def _faults(self, row: Row) -> Iterator[str]:
        mesh, extents = self._facts.mesh(row["asset_id"]), self._facts.extents(row["asset_id"])
        stated, report = row["extents"], row["report"]
        if extents is not None and not np.allclose(extents, stated, rtol=0, atol=_ROUNDING * float(extents.max())):
            yield f"extents are {stated}, expected {extents.tolist()} as of its mesh"
        if mesh is not None and report is not None:
            yield from _report_faults(report, mesh)
        points, normals = (np.asarray(row[name], np.float64) for name in ("points", "normals"))
        if points.size != normals.size or points.size % 3:
            yield f"it has {points.size / 3:g} points and {normals.size / 3:g} normals, expected as many"
            return
        if len(points) and (np.abs(points.reshape(-1, 3)) > np.array(stated) / 2 + _ROUNDING * max(stated)).any():
            yield "a surface point is outside of its box"
        if points.size > 3 and not np.ptp(points.reshape(-1, 3), axis=0).any():
            yield "its surface points are all the same point, expected points all over it"
        if len(normals) and np.abs(np.linalg.norm(normals.reshape(-1, 3), axis=1) - 1).max() > 1e-3:
            yield "a normal is no unit vector"
        scale, volume = row.get("typical_scale"), row.get("volume")
        if scale is not None and volume is not None and report is not None:
            expected = report["volume"] * float(np.prod(scale))
            if not np.isclose(volume, expected, rtol=1e-6, atol=1e-15):
                yield f"volume is {volume}, expected {expected} by its report and typical_scale"
        yield from _mass_faults(row)


def _report_faults(report: Row, mesh: MeshFacts) -> Iterator[str]:
    """Faults of the report on a mesh, in what needs no library for geometry."""
    for name in ("num_vertices", "num_faces"):
        if report[name] != getattr(mesh, name):
            yield f"its report says {name} {report[name]}, expected {getattr(mesh, name)} as of its mesh"
    if report["is_solid"] == report["is_sheet"]:
        yield f"its report says is_solid {report['is_solid']} and is_sheet {report['is_sheet']}, expected one of them"
    volume = mesh.volume if report["is_solid"] else 0.0
    for name, expected, unit in (("area", mesh.area, mesh.area), ("volume", volume, max(mesh.extents) * mesh.area)):
        if abs(report[name] - expected) > _ROUNDING * unit:
            yield f"its report says {name} {report[name]:.6g}, expected {expected:.6g} as of its mesh"


def _mass_faults(row: Row) -> Iterator[str]:
    """Faults of the mass of an asset: its centre is in its box, each inertia is positive, and none is larger than its box allows."""
    scale, centre = row.get("typical_scale") or (1.0, 1.0, 1.0), row.get("center_of_mass")
    half = np.multiply(row["extents"], scale) / 2
    if centre is not None and (np.abs(centre) > half + _MASS_SLACK * half.max()).any():
        yield f"center_of_mass is {centre}, expected in its box of {(2 * half).round(4).tolist()}"
    for name in ("inertia_per_mass", "inertia"):
        if row.get(name) is not None:
            found = np.array(row[name]).reshape(3, 3)
            least, _, most = np.linalg.eigvalsh(found)
            if least <= 0 or not np.allclose(found, found.T, rtol=0, atol=1e-6 * most):
                yield f"{name} is {row[name]}, expected a symmetric and positive matrix"
            elif name == "inertia_per_mass" and row.get("inertia") is None and most > (largest := float((4 * half**2).sum())):
                # That of a source is kept as it is stated; any other one follows from the mesh, whose points are in its box.
                yield f"{name} is up to {most:.4g} m², expected at most {largest:.4g} m², the squared diagonal of its box"
    mass, volume, report = row.get("mass"), row.get("volume"), row["report"]
    follows = row.get("mass_source") in ("material", "category", "default")  # from the volume and a table of densities
    if follows and mass is not None and volume is not None and report is not None and report["is_solid"]:
        most = max(_DENSEST * volume, _LIGHTEST)
        if mass > most:
            yield f"mass is {mass} kg, expected at most {most:.4g} kg by its volume: it rests on {row['mass_source']}"


class GridCheck:
    """Checks rows of ``sdf`` against the meshes of the run.

    Args:
        facts: What the meshes are.
        findings: Where damage is noted.
    """

    def __init__(self, facts: AssetFacts, findings: Findings) -> None:
        self._facts, self._findings = facts, findings

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            for what in self._faults(row):
                self._findings.damage(file.name, f"asset {row['asset_id']}: {what}", number)

    def _faults(self, row: Row) -> Iterator[str]:
        if len(row["values"]) != int(np.prod(np.asarray(row["shape"], np.int64))):
            yield f"its grid has {len(row['values'])} values, expected as many as its shape {list(row['shape'])} says"
        elif abs(max(row["aspect"]) - 1.0) > 1e-9:
            yield f"aspect is {row['aspect']}, expected 1 as largest"
        elif (extents := self._facts.extents(row["asset_id"])) is not None:
            yield from _lattice_faults(row, extents * row["aspect"])


def _lattice_faults(row: Row, extents: FloatArray) -> Iterator[str]:
    """Nodes of a grid that do not lie around the box of its mesh, whose extents at the aspect of the grid are given."""
    unit, spacing, padding = float(extents.max()), row["spacing"], USUAL_LIMITS.padding
    if abs(row["extent"] - unit) > _ROUNDING * unit:
        yield f"extent is {row['extent']}, expected {unit}: the largest extent of its mesh at its aspect"
    spans = np.array(row["shape"]) - 1
    beyond = spans - 2 * padding - extents / unit / max(spacing, 1e-12)  # nodes that the box does not fill: less than one
    if (beyond < -_NODE_SLACK).any() or (beyond >= 1 + _NODE_SLACK).any():
        yield f"spacing is {spacing}, with which its {row['shape']} nodes do not cover its mesh and {padding} nodes around it"
    elif (np.abs(row["origin"] + spacing * spans / 2) > _NODE_SLACK * spacing).any():
        yield f"origin is {row['origin']}, expected {(-spacing * spans / 2).tolist()}: its mesh is in the middle of its grid"


class FeatureCheck:
    """Checks rows of ``features``: a run contains features of one encoder.

    Args:
        encoder: Fingerprint of the encoder that the manifest names; None if it names none.
        findings: Where damage is noted.
    """

    def __init__(self, encoder: str | None, findings: Findings) -> None:
        self._encoder, self._findings = encoder, findings

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            self._encoder = self._encoder or row["encoder_fingerprint"]
            if row["encoder_fingerprint"] != self._encoder:
                what = f"encoder_fingerprint is {row['encoder_fingerprint']}, expected {self._encoder} as of the run"
                self._findings.damage(file.name, f"asset {row['asset_id']}: {what}", number)
