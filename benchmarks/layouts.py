"""Start layouts: reads files of them, one JSON object a line, and makes some from a dataset's own scenes.

A line holds ``id``, ``bucket``, ``n_collisions``, ``table.size_xy_m`` and ``objects``: instance, uid, scale_factor (centimetres
a mesh unit), base_quat_xyzw (the tilt), poses by name ({position_m, yaw}), and the relation and parent of the layout's scene
graph.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.scene import FloatArray, QuatXyzw, Relation, RelationKind, Scene, SceneObject, Tabletop, Vec3

BUCKETS = ("0-10", "10-20", "20-30", "30-40")
"""Buckets by the number of colliding pairs: from the first number (at least 1) to below the second."""

_NOISE = (0.02, 0.04, 0.08, 0.16)  # standard deviations of x and y, metres
_TURN = 5.0  # standard deviation of yaw, radians a metre of the above


@dataclass(frozen=True, slots=True)
class StartLayout:
    """A layout to be corrected.

    Attributes:
        start: The scene to correct, with the relations of the layout's scene graph.
        target: The correct scene; None if it is not known.
        bucket: Its bucket, or empty.
        num_collisions: Pairs that collide at the start, as counted by its maker.
    """

    start: Scene
    target: Scene | None
    bucket: str
    num_collisions: int


def read_layouts(path: Path, store: AssetStore, start: str = "start") -> Iterator[StartLayout]:
    """Reads a file of layouts.

    Args:
        path: The file.
        store: Meshes of its assets; they define the sizes of objects.
        start: Name of the start poses.

    Yields:
        One layout a line.

    Raises:
        SceneError: A line is not a layout (code ``layout_invalid``).
        MeshError: An asset is missing or broken.
    """
    for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
        try:
            yield _layout(json.loads(line), store, start)
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, SceneError) or type(error) not in (KeyError, TypeError, ValueError, json.JSONDecodeError):
                raise
            message = f"{path.name}, line {number}: {type(error).__name__} {error}, expected a start layout (see benchmarks/layouts.py)"
            raise SceneError(message, "layout_invalid") from error


def _layout(row: Mapping[str, Any], store: AssetStore, start: str) -> StartLayout:
    x, y = row["table"]["size_xy_m"]
    relations = tuple(
        Relation(o["instance"], RelationKind(o["relation"]), o["parent"]) for o in row["objects"] if o["relation"] != "table"
    )
    bare = [_object(o, store) for o in row["objects"]]
    scene = Scene(str(row["id"]), Tabletop("", (float(x), float(y))), tuple(bare), relations=relations)

    def at(name: str) -> Scene:
        places = [(o[name]["position_m"], o[name]["yaw"]) for o in row["objects"]]
        moved = tuple(o.moved(_vec3(position), float(yaw)) for o, (position, yaw) in zip(bare, places, strict=True))
        return replace(scene, objects=moved)

    target = at("settled") if row["settled_valid"] else None
    return StartLayout(at(start), target, str(row["bucket"]), int(row["n_collisions"]))


def _object(o: Mapping[str, Any], store: AssetStore) -> SceneObject:
    quat = np.asarray(o["base_quat_xyzw"], np.float64)
    a, b, c, d = (quat / np.linalg.norm(quat)).tolist()
    tilt: QuatXyzw = (a, b, c, d)
    scale = _vec3([s / 100 for s in o["scale_factor"]])
    size = _vec3(Shape.from_mesh(store.asset(o["uid"]).mesh, scale, tilt).size)
    return SceneObject(o["instance"], "object", (0.0, 0.0, 0.0), 0.0, size, o["uid"], scale, tilt, support=o["parent"])


def _vec3(values: Iterable[float]) -> Vec3:
    x, y, z = map(float, values)
    return (x, y, z)


def shaken_layouts(scenes: Iterable[Scene], store: AssetStore, per_bucket: int) -> Iterator[StartLayout]:
    """Makes layouts by perturbing scenes with growing noise, until their collisions fill the buckets.

    Args:
        scenes: Scenes, with their relations if known.
        store: Meshes of their assets.
        per_bucket: Layouts of each bucket; fewer if the scenes have too few objects.

    Yields:
        The layouts, in the order of the scenes. The scene itself is the target.
    """
    wanted = dict.fromkeys(BUCKETS, per_bucket)
    for scene in scenes:
        rng = np.random.default_rng(len(scene.objects))
        scene, shapes, _ = store.resolved(scene)
        for noise in _NOISE:
            if not any(wanted.values()):
                return
            start = shaken(scene, noise, rng)
            count = audit_scene(start, shapes).card().num_collisions
            bucket = bucket_of(count)
            if wanted.get(bucket, 0):
                wanted[bucket] -= 1
                yield StartLayout(replace(start, scene_id=f"{scene.scene_id}+{1e3 * noise:.0f}mm"), scene, bucket, count)


def shaken(scene: Scene, noise: float, rng: np.random.Generator) -> Scene:
    """Shifts the objects of a scene along the table and turns them at random; their centres stay on the table.

    Args:
        scene: The scene.
        noise: Standard deviation of x and y, metres; that of yaw is 5 radians a metre of it.
        rng: Source of randomness.
    """
    deviation = (noise, noise, 0.0, _TURN * noise)
    poses: FloatArray = scene.poses() + rng.normal(0.0, deviation, (len(scene.objects), 4))
    poses[:, :2] = np.clip(poses[:, :2], 0.0, scene.table.size_xy)
    return scene.with_poses(poses)


def bucket_of(count: int) -> str:
    """Returns the bucket of a number of colliding pairs; empty for 0, or for more than in the last bucket."""
    return BUCKETS[count // 10] if 0 < count < 10 * len(BUCKETS) else ""
