"""What the encoder is pre-trained on: the embedded world's assets at aspects and tilts, with exact signed distances."""

import hashlib
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from tqdm import tqdm

from models.point_encoder.cloud import PointCloud
from stable_data.embedded_world.families.catalogue import BY_CATEGORY, KEYS, NUM_VARIANTS, asset
from stable_data.embedded_world.modelling.family import LAID, ON_EDGE
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.shape import Shape
from stable_data.scene import UPRIGHT, FloatArray

HELD_OUT_VARIANT = NUM_VARIANTS - 1
"""This variant of every category is never trained on."""

_ASPECT_SPREAD = 0.35  # of the logarithm of each axis' scale, where an asset is stretched
_NEAR_SIGMAS = (0.03, 0.1)  # of half the largest extent
_AROUND = 1.5  # how far sideways queries reach, in boxes
_PAIR_POINTS = 512  # of each surface, for the clearance of a pair
_ASKED_FIRST = 64  # of them; what they say spares most of the others
_BOX_SLACK = 1e-6  # metres: the box of a cloud is rounded


@dataclass(frozen=True)
class TrainingShape:
    """An asset at an aspect and tilt. Frame: its yaw frame, its box centred on the origin; metres.

    Attributes:
        key: ``category/variant#copy``.
        cloud: Its surface.
        outline: Convex footprint, (K, 2) float64.
        mesh: Its triangles.
        queries: (Q, 3) float64: a quarter evenly in its box, half near its surface, the rest around it.
        distances: Exact signed distance at these, (Q,) float64.
    """

    key: str
    cloud: PointCloud
    outline: FloatArray
    mesh: Mesh
    queries: FloatArray
    distances: FloatArray

    @cached_property
    def signed_distance(self) -> SignedDistance:
        """Exact distance to it."""
        return SignedDistance(self.mesh)


@dataclass(frozen=True, slots=True, eq=False)
class PosedShape:
    """A shape as it is shown once: turned about z and perhaps mirrored, which leaves distances as they are.

    Attributes:
        shape: What is shown.
        turn: Orthogonal, (3, 3) float64, from the shape's frame to this one.
    """

    shape: TrainingShape
    turn: FloatArray

    @classmethod
    def drawn(cls, shape: TrainingShape, rng: np.random.Generator) -> "PosedShape":
        """A shape at a random yaw, mirrored half of the time."""
        mirror = np.diag([rng.choice([-1.0, 1.0]), 1.0, 1.0])
        return cls(shape, _yaw(float(rng.uniform(0, 2 * math.pi))) @ mirror)

    @property
    def cloud(self) -> PointCloud:
        """The cloud in this frame, with its box there."""
        turn = self.turn.astype(np.float32)
        # The footprint turns about the old box's centre; the cloud's box is centred anew.
        points = self.shape.cloud.points @ turn.T - self.centre.astype(np.float32)
        return PointCloud(points, self.shape.cloud.normals @ turn.T, self.size.astype(np.float32))

    @property
    def size(self) -> FloatArray:
        """Box in this frame, (3,) float64, metres."""
        return np.append(np.ptp(self.outline, axis=0), np.float64(self.shape.cloud.size[2]))

    @property
    def outline(self) -> FloatArray:
        """Footprint in this frame before it is centred, (K, 2) float64, metres."""
        turned: FloatArray = self.shape.outline @ self.turn[:2, :2].T
        return turned

    @property
    def centre(self) -> FloatArray:
        """Where the new box's centre is, (3,) float64, metres."""
        outline = self.outline
        return np.append((outline.min(axis=0) + outline.max(axis=0)) / 2, 0.0)

    def shown(self, points: FloatArray) -> FloatArray:
        """Points of the shape's frame in this one, (P, 3) float64."""
        shown: FloatArray = points @ self.turn.T - self.centre
        return shown

    def distances(self, points: FloatArray) -> FloatArray:
        """Exact signed distances of points of this frame, (P,) float64, metres."""
        return self.shape.signed_distance((points + self.centre) @ self.turn)

    def lowest(self, points: FloatArray, known: float = math.inf) -> float:
        """Smallest of a number and the exact signed distances of points of this frame, metres.

        Points are asked in the order of their distance to the box, which none is nearer than: few are asked.
        """
        bounds = np.linalg.norm(np.maximum(np.abs(points) - self.size / 2, 0.0), axis=1)
        order = np.argsort(bounds)
        for asked in (order[:_ASKED_FIRST], order[_ASKED_FIRST:]):
            if len(asked := asked[bounds[asked] < max(known, 0.0) + _BOX_SLACK]):
                known = min(known, float(self.distances(points[asked]).min()))
        return known


@dataclass(frozen=True, slots=True, eq=False)
class ShapePair:
    """The second of two objects beside, on or in the first.

    Attributes:
        offset: Its box's centre in the frame of the first, (3,) float64, metres.
        yaw: Its yaw there, radians.
        clearance: Smallest signed distance between samples of either surface and the other object, metres.
    """

    offset: FloatArray
    yaw: float
    clearance: float

    @classmethod
    def drawn(cls, first: PosedShape, second: PosedShape, rng: np.random.Generator) -> "ShapePair":
        """A pose near contact: mostly on the same table, else one on or in the other."""
        yaw, way = rng.uniform(0, 2 * math.pi, 2)
        direction = np.array([math.cos(way), math.sin(way)])
        rotation = _yaw(float(yaw))
        outlines = (first.outline - first.centre[:2], (second.outline - second.centre[:2]) @ rotation[:2, :2].T)
        reach = (outlines[0] @ direction).max() - (outlines[1] @ direction).min()
        heights = first.shape.cloud.size[2], second.shape.cloud.size[2]
        level = (heights[1] - heights[0]) / 2  # both stand on one plane
        kind = rng.random()
        if kind < 0.7:
            sideways, up = rng.uniform(0.5, 1.3), level + rng.normal(0.0, 2e-3)
        elif kind < 0.85:
            sideways, up = rng.uniform(0.0, 1.0), (heights[0] + heights[1]) / 2 * rng.uniform(0.6, 1.05)
        else:
            sideways, up = rng.uniform(0.0, 0.5), level + heights[0] * rng.uniform(0.0, 1.0)
        offset = np.append(sideways * reach * direction, up)
        ours = first.shown(first.shape.cloud.points[:_PAIR_POINTS].astype(np.float64))
        theirs = second.shown(second.shape.cloud.points[:_PAIR_POINTS].astype(np.float64)) @ rotation.T + offset
        return cls(offset, float(yaw), first.lowest(theirs, second.lowest((ours - offset) @ rotation)))


def training_shape(key: str, copy: int, num_points: int, num_queries: int) -> TrainingShape:
    """An asset as one example; the same arguments give the same example.

    Args:
        key: One of ``stable_data.embedded_world.families.catalogue.KEYS``.
        copy: 0 for the asset as it usually stands; others are stretched and tilted at random.
        num_points: Points of its cloud.
        num_queries: Q.
    """
    shape, rng = _placed(key, copy)
    cloud = PointCloud.of_shape(shape, num_points)
    half = float(shape.size.max()) / 2
    quarter = num_queries // 4
    box = rng.uniform(-0.5, 0.5, (quarter, 3)) * (1.05 * shape.size + 0.05 * half)
    seeds = cloud.points[rng.integers(num_points, size=2 * quarter)]
    near = seeds + rng.normal(size=seeds.shape) * rng.choice(_NEAR_SIGMAS, (len(seeds), 1)) * half
    around = rng.uniform(-0.5, 0.5, (num_queries - 3 * quarter, 3)) * shape.size * (_AROUND, _AROUND, 1.1)
    queries = np.concatenate([box, near, around])
    mesh = Mesh(shape.vertices, shape.faces)
    return TrainingShape(f"{key}#{copy}", cloud, shape.footprint, mesh, queries, SignedDistance(mesh)(queries))


def pretraining_corpus(
    num_categories: int | None, num_copies: int, num_points: int, num_queries: int, kept: Path | None = None
) -> tuple[Sequence[TrainingShape], Sequence[TrainingShape]]:
    """Shapes to train on, and shapes of assets that are held out, as they usually stand.

    Args:
        num_categories: So many of the catalogue, evenly chosen; None for all.
        num_copies: Examples of each asset that is trained on.
        num_points: Points of a cloud.
        num_queries: Queries of a shape.
        kept: A file that keeps clouds and labels for the next time; made where it is missing or of other shapes.
    """
    categories = list(BY_CATEGORY)
    num = len(categories) if num_categories is None else min(num_categories, len(categories))
    chosen = {categories[n * len(categories) // num] for n in range(num)}
    keys = [key for key in KEYS if key.partition("/")[0] in chosen]
    jobs = [(key, copy) for key in keys for copy in range(1 if is_held_out(key) else num_copies)]
    shapes = _read(kept, jobs, num_points, num_queries) if kept is not None else None
    if shapes is None:
        shapes = [training_shape(*job, num_points, num_queries) for job in tqdm(jobs, desc="labels", unit="shape")]
        if kept is not None:
            _write(kept, shapes)
    held_out = [shape for (key, _), shape in zip(jobs, shapes, strict=True) if is_held_out(key)]
    return [shape for (key, _), shape in zip(jobs, shapes, strict=True) if not is_held_out(key)], held_out


def _placed(key: str, copy: int) -> tuple[Shape, np.random.Generator]:
    """An asset at the aspect and tilt of a copy, and the stream that goes on from there."""
    found = asset(key)
    rng = np.random.default_rng([zlib.crc32(key.encode()), copy])
    scale, tilt = (1.0, 1.0, 1.0), found.tilts[0]
    if copy:
        x, y, z = np.exp(rng.uniform(-_ASPECT_SPREAD, _ASPECT_SPREAD, 3)).tolist()
        scale, tilts = (x, y, z), (*found.tilts, UPRIGHT, LAID, ON_EDGE)
        tilt = tilts[int(rng.integers(len(tilts)))]
    return Shape.from_mesh(found.mesh, scale, tilt), rng


def _write(path: Path, shapes: Sequence[TrainingShape]) -> None:
    aside = path.with_name(f"{path.name}.tmp")
    with aside.open("wb") as stream:
        np.savez(
            stream,
            meshes=np.array([_digest(s.mesh) for s in shapes]),
            points=np.stack([s.cloud.points for s in shapes]),
            normals=np.stack([s.cloud.normals for s in shapes]),
            queries=np.stack([s.queries for s in shapes]),
            distances=np.stack([s.distances for s in shapes]),
        )
    aside.replace(path)


def _read(path: Path, jobs: Sequence[tuple[str, int]], num_points: int, num_queries: int) -> Sequence[TrainingShape] | None:
    """The shapes that a file keeps, or None where they are others: a mesh or a number has changed."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as file:
        of = dict(file)
    if of["points"].shape[:2] != (len(jobs), num_points) or of["distances"].shape[1] != num_queries:
        return None
    shapes = []
    for k, (key, copy) in enumerate(tqdm(jobs, desc="labels", unit="shape")):
        shape, _ = _placed(key, copy)
        mesh = Mesh(shape.vertices, shape.faces)
        if _digest(mesh) != of["meshes"][k]:
            return None
        cloud = PointCloud(of["points"][k], of["normals"][k], shape.size.astype(np.float32))
        shapes.append(TrainingShape(f"{key}#{copy}", cloud, shape.footprint, mesh, of["queries"][k], of["distances"][k]))
    return shapes


def _digest(mesh: Mesh) -> str:
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()


def is_held_out(key: str) -> bool:
    """Whether an asset is kept for judging."""
    return int(key.partition("/")[2]) == HELD_OUT_VARIANT


def _yaw(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
