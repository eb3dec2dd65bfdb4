"""The data of pre-training: assets of the embedded world at several aspects and tilts, with exact signed distances."""

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
"""This variant of every category is not used for training."""

_ASPECT_SPREAD = 0.35  # bound of the logarithm of each axis' scale
_NEAR_SIGMAS = (0.03, 0.1)  # deviations of queries near the surface, in half the largest extent
_AROUND = 1.5  # horizontal range of the queries around an object, in sizes of its box
_PAIR_POINTS = 512  # surface points of each object for the clearance of a pair
_FIRST_POINTS = 64  # evaluated first: their minimum excludes most of the other points
_BOX_SLACK = 1e-6  # metres: the size of a cloud is rounded to float32


@dataclass(frozen=True)
class TrainingShape:
    """An asset at an aspect and tilt, in its yaw frame, box centred at the origin; metres.

    Attributes:
        key: ``category/variant#copy``.
        cloud: Points of its surface.
        outline: Convex footprint, (K, 2) float64.
        mesh: Its triangles.
        queries: Query points, (Q, 3) float64: a quarter uniform in the box, half near the surface, the rest around the object.
        distances: Exact signed distances at the queries, (Q,) float64.
    """

    key: str
    cloud: PointCloud
    outline: FloatArray
    mesh: Mesh
    queries: FloatArray
    distances: FloatArray

    @cached_property
    def signed_distance(self) -> SignedDistance:
        """The exact signed distance to the mesh."""
        return SignedDistance(self.mesh)


@dataclass(frozen=True, slots=True, eq=False)
class PosedShape:
    """A shape at a random pose: rotated about z and possibly mirrored, which preserves distances.

    Attributes:
        shape: The shape.
        turn: Orthogonal matrix from the shape's frame to this frame, (3, 3) float64.
    """

    shape: TrainingShape
    turn: FloatArray

    @classmethod
    def sample(cls, shape: TrainingShape, rng: np.random.Generator) -> "PosedShape":
        """Draws a yaw, and mirrors with probability 1/2."""
        mirror = np.diag([rng.choice([-1.0, 1.0]), 1.0, 1.0])
        return cls(shape, _yaw(float(rng.uniform(0, 2 * math.pi))) @ mirror)

    @property
    def cloud(self) -> PointCloud:
        """The cloud in this frame, with its box in this frame."""
        turn = self.turn.astype(np.float32)
        # The rotation is about the centre of the old box; the new box needs to be centred again.
        points = self.shape.cloud.points @ turn.T - self.centre.astype(np.float32)
        return PointCloud(points, self.shape.cloud.normals @ turn.T, self.size.astype(np.float32))

    @property
    def size(self) -> FloatArray:
        """The size of the box in this frame, (3,) float64, metres."""
        return np.append(np.ptp(self.outline, axis=0), np.float64(self.shape.cloud.size[2]))

    @property
    def outline(self) -> FloatArray:
        """The footprint in this frame before centring, (K, 2) float64, metres."""
        outline: FloatArray = self.shape.outline @ self.turn[:2, :2].T
        return outline

    @property
    def centre(self) -> FloatArray:
        """The centre of the new box before centring, (3,) float64, metres."""
        outline = self.outline
        return np.append((outline.min(axis=0) + outline.max(axis=0)) / 2, 0.0)

    def transform(self, points: FloatArray) -> FloatArray:
        """Transforms points from the shape's frame to this frame, (P, 3) float64."""
        transformed: FloatArray = points @ self.turn.T - self.centre
        return transformed

    def distances(self, points: FloatArray) -> FloatArray:
        """Computes exact signed distances of points in this frame, (P,) float64, metres."""
        return self.shape.signed_distance((points + self.centre) @ self.turn)

    def min_distance(self, points: FloatArray, known: float = math.inf) -> float:
        """Returns the minimum of a number and the exact signed distances of points in this frame, metres.

        The distance to the box is a lower bound of a positive distance: only points with a bound below the present minimum are
        evaluated.
        """
        bounds = np.linalg.norm(np.maximum(np.abs(points) - self.size / 2, 0.0), axis=1)
        order = np.argsort(bounds)
        for chosen in (order[:_FIRST_POINTS], order[_FIRST_POINTS:]):
            if len(chosen := chosen[bounds[chosen] < max(known, 0.0) + _BOX_SLACK]):
                known = min(known, float(self.distances(points[chosen]).min()))
        return known


@dataclass(frozen=True, slots=True, eq=False)
class ShapePair:
    """The pose of a second object beside, on or in a first, with their clearance.

    Attributes:
        offset: Centre of the second box in the frame of the first, (3,) float64, metres.
        yaw: Yaw of the second in the frame of the first, radians.
        clearance: Smallest signed distance between surface samples of one object and the other object, metres.
    """

    offset: FloatArray
    yaw: float
    clearance: float

    @classmethod
    def sample(cls, first: PosedShape, second: PosedShape, rng: np.random.Generator) -> "ShapePair":
        """Draws a pose near contact: mostly both on one table, else one on or in the other."""
        yaw, way = rng.uniform(0, 2 * math.pi, 2)
        direction = np.array([math.cos(way), math.sin(way)])
        rotation = _yaw(float(yaw))
        outlines = (first.outline - first.centre[:2], (second.outline - second.centre[:2]) @ rotation[:2, :2].T)
        reach = (outlines[0] @ direction).max() - (outlines[1] @ direction).min()
        heights = first.shape.cloud.size[2], second.shape.cloud.size[2]
        level = (heights[1] - heights[0]) / 2  # vertical offset of the centres if both are on one plane
        kind = rng.random()
        if kind < 0.7:
            sideways, up = rng.uniform(0.5, 1.3), level + rng.normal(0.0, 2e-3)
        elif kind < 0.85:
            sideways, up = rng.uniform(0.0, 1.0), (heights[0] + heights[1]) / 2 * rng.uniform(0.6, 1.05)
        else:
            sideways, up = rng.uniform(0.0, 0.5), level + heights[0] * rng.uniform(0.0, 1.0)
        offset = np.append(sideways * reach * direction, up)
        of_first = first.transform(first.shape.cloud.points[:_PAIR_POINTS].astype(np.float64))
        of_second = second.transform(second.shape.cloud.points[:_PAIR_POINTS].astype(np.float64)) @ rotation.T + offset
        clearance = first.min_distance(of_second, second.min_distance((of_first - offset) @ rotation))
        return cls(offset, float(yaw), clearance)


def training_shape(key: str, copy: int, num_points: int, num_queries: int) -> TrainingShape:
    """Builds the training example of an asset; the same arguments give the same example.

    Args:
        key: One of ``stable_data.embedded_world.families.catalogue.KEYS``.
        copy: 0 for the asset in its usual tilt and aspect; others have a random aspect and tilt.
        num_points: Points of its cloud.
        num_queries: Q.
    """
    shape, rng = _shape_of_copy(key, copy)
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
    num_categories: int | None, num_copies: int, num_points: int, num_queries: int, cache: Path | None = None
) -> tuple[Sequence[TrainingShape], Sequence[TrainingShape]]:
    """Returns the shapes for training, and held-out shapes in their usual tilt and aspect.

    Args:
        num_categories: Number of evenly chosen categories of the catalogue; None for all.
        num_copies: Examples of each asset for training.
        num_points: Points of a cloud.
        num_queries: Queries of a shape.
        cache: A file of clouds and labels; it is written if it is missing or has other shapes.
    """
    categories = list(BY_CATEGORY)
    num = len(categories) if num_categories is None else min(num_categories, len(categories))
    chosen = {categories[n * len(categories) // num] for n in range(num)}
    keys = [key for key in KEYS if key.partition("/")[0] in chosen]
    jobs = [(key, copy) for key in keys for copy in range(1 if is_held_out(key) else num_copies)]
    shapes = _read_cache(cache, jobs, num_points, num_queries) if cache is not None else None
    if shapes is None:
        shapes = [training_shape(*job, num_points, num_queries) for job in tqdm(jobs, desc="labels", unit="shape")]
        if cache is not None:
            _write_cache(cache, shapes)
    held_out = [shape for (key, _), shape in zip(jobs, shapes, strict=True) if is_held_out(key)]
    return [shape for (key, _), shape in zip(jobs, shapes, strict=True) if not is_held_out(key)], held_out


def _shape_of_copy(key: str, copy: int) -> tuple[Shape, np.random.Generator]:
    """Returns an asset at the aspect and tilt of a copy, and the generator for further draws."""
    found = asset(key)
    rng = np.random.default_rng([zlib.crc32(key.encode()), copy])
    scale, tilt = (1.0, 1.0, 1.0), found.tilts[0]
    if copy:
        x, y, z = np.exp(rng.uniform(-_ASPECT_SPREAD, _ASPECT_SPREAD, 3)).tolist()
        scale, tilts = (x, y, z), (*found.tilts, UPRIGHT, LAID, ON_EDGE)
        tilt = tilts[int(rng.integers(len(tilts)))]
    return Shape.from_mesh(found.mesh, scale, tilt), rng


def _write_cache(path: Path, shapes: Sequence[TrainingShape]) -> None:
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


def _read_cache(
    path: Path, jobs: Sequence[tuple[str, int]], num_points: int, num_queries: int
) -> Sequence[TrainingShape] | None:
    """Reads the shapes of a file; None if it is missing, or a mesh or a number has changed."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as file:
        of = dict(file)
    if of["points"].shape[:2] != (len(jobs), num_points) or of["distances"].shape[1] != num_queries:
        return None
    shapes = []
    for k, (key, copy) in enumerate(tqdm(jobs, desc="labels", unit="shape")):
        shape, _ = _shape_of_copy(key, copy)
        mesh = Mesh(shape.vertices, shape.faces)
        if _digest(mesh) != of["meshes"][k]:
            return None
        cloud = PointCloud(of["points"][k], of["normals"][k], shape.size.astype(np.float32))
        shapes.append(TrainingShape(f"{key}#{copy}", cloud, shape.footprint, mesh, of["queries"][k], of["distances"][k]))
    return shapes


def _digest(mesh: Mesh) -> str:
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()


def is_held_out(key: str) -> bool:
    """Whether an asset is used for evaluation only."""
    return int(key.partition("/")[2]) == HELD_OUT_VARIANT


def _yaw(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
