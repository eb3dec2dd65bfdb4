"""Start layouts: reads files of them, one JSON object a line, and makes some from a dataset's own scenes.

A line holds ``id``, ``bucket``, ``n_collisions``, ``table.size_xy_m``, the name of its source scene, which begins with the kind of
table, and ``objects``: instance, which contains the category, uid, scale_factor (centimetres
a mesh unit), base_quat_xyzw (the tilt), poses by name ({position_m, yaw}), and the relation and parent of the layout's scene
graph.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from models.physics_corrector.geometry.scene_batch import LayoutBatch, pad_scenes
from models.physics_corrector.stabilization.drop_simulation import drop_new_objects
from models.physics_corrector.training.perturbation import KINDS, PerturbationSettings, perturb
from models.physics_corrector.training.sources import clean_targets
from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import Audit
from stable_data.random_seeds import named_seed
from stable_data.scene import TABLE, FloatArray, QuatXyzw, Relation, RelationKind, Scene, SceneObject, Tabletop, Vec3
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

BUCKETS = ("0-10", "10-20", "20-30", "30-40")
"""Buckets by the number of colliding pairs: from the first number (at least 1) to below the second."""

_FIRST_NUMBER, _NUMBER = re.compile(r"^\d+_"), re.compile(r"_\d+$")
_CARRYING = (RelationKind.ON, RelationKind.IN)
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
    kind = _NUMBER.sub("", str(row.get("source_scene", "")))
    scene = Scene(str(row["id"]), Tabletop(kind, (float(x), float(y))), tuple(bare), relations=relations)

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
    category = _NUMBER.sub("", _FIRST_NUMBER.sub("", o["instance"])) or "object"
    return SceneObject(o["instance"], category, (0.0, 0.0, 0.0), 0.0, size, o["uid"], scale, tilt, support=o["parent"])


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


def held_out_scenes(uri: str, num_scenes: int, splits: Sequence[str] = ("validation", "test", "unseen")) -> list[Scene]:
    """Returns clean scenes of a preprocess run that no training has seen.

    Args:
        uri: The run.
        num_scenes: The largest number of scenes.
        splits: Their splits; scenes of the first come first.
    """
    split_of = {row["scene_id"]: row["split"] for row in RunFolder(uri).table("scenes", ["scene_id", "split"]).to_pylist()}
    scenes, _, _ = clean_targets(uri)
    return [scene for split in splits for scene in scenes if split_of[scene.scene_id] == split][:num_scenes]


def perturbed_layouts(
    scenes: Sequence[Scene], store: AssetStore, settings: PerturbationSettings, seed: int = 0
) -> Iterator[StartLayout]:
    """Makes clean scenes coarse by every kind of error of the training.

    Args:
        scenes: The scenes.
        store: Their meshes.
        settings: Sizes of the errors.
        seed: Seed of the errors; each kind has its own random stream.

    Yields:
        The layouts, kind by kind, with the supports and relations of the clean scene, which is the target.
    """
    resolved = [store.resolved(scene)[:2] for scene in scenes]
    arrays = pad_scenes([scene for scene, _ in resolved], [own for _, own in resolved], [frozenset()] * len(resolved))
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    batch = LayoutBatch(shape_index=torch.zeros_like(tensors["parent"]), **tensors)
    for number, kind in enumerate(KINDS):
        poses = perturb(batch, settings, torch.Generator().manual_seed(seed + number), kind).poses
        for (scene, own), at in zip(resolved, poses.double().numpy(), strict=True):
            clean = _untold(scene)
            yield StartLayout(clean.with_poses(at[: len(own)]), clean, kind, 0)


def noisy_layouts(
    scenes: Iterable[Scene], store: AssetStore, noise: float, seed: int, *, along_z: bool = True
) -> Iterator[StartLayout]:
    """Makes the paper's rearrangement inputs: every object of clean scenes gets Gaussian noise on its translation and its yaw.

    Objects are displaced independently, also from what carries them, and may leave the table.

    Args:
        scenes: The scenes.
        store: Their meshes.
        noise: Standard deviation along each axis in metres, and of yaw in radians.
        seed: Seed of the noise; a scene's noise depends on it and on the scene's id alone.
        along_z: Whether the noise also acts along z.

    Yields:
        The layouts, named after scene and seed, in the bucket of the seed, with the supports and relations of the clean scene,
        which is the target.
    """
    deviation = (noise, noise, noise if along_z else 0.0, noise)
    for scene in scenes:
        clean = _untold(store.resolved(scene)[0])
        rng = np.random.default_rng(named_seed(seed, scene.scene_id))
        poses: FloatArray = clean.poses() + rng.normal(0.0, 1.0, (len(clean.objects), 4)) * deviation
        start = replace(clean.with_poses(poses), scene_id=f"{scene.scene_id}+{seed}")
        yield StartLayout(start, clean, str(seed), 0)


def _untold(scene: Scene) -> Scene:
    """A scene with the relations of what carries what alone: its task would tell directions."""
    carried = tuple(r for r in scene.relations if r.kind in _CARRYING and r.target != TABLE)
    return replace(scene, relations=carried, task=None)


def proposed_layouts(run: RunFolder, *, is_whole: bool = False, store: AssetStore | None = None) -> Iterator[StartLayout]:
    """Reads the layouts of each stage of a generate run before its correction; objects have the tilts of the finished scene.

    Args:
        run: The run.
        is_whole: Whether only the last stage of each scene is read.
        store: Meshes of the assets, to drop the objects of the stage onto and into their carriers, as generation does before
            its correction; None leaves them where they were proposed.

    Yields:
        The layouts, without a target; those with objects that the finished scene does not have are left out.
    """
    finished = {row["scene_id"]: scene_from_row(row) for row in run.table("scenes").to_pylist()}
    turns = [turn for turn in run.table("turns").to_pylist() if turn["scene_id"] in finished and turn["coarse"]]
    last = {turn["scene_id"]: turn["stage"] for turn in turns}
    for turn in turns:
        scene = finished[turn["scene_id"]]
        objects = {o.instance: o for o in scene.objects}
        is_known = all(pose["instance"] in objects for pose in turn["coarse"])
        if not is_known or (is_whole and turn["stage"] != last[turn["scene_id"]]):
            continue
        moved = tuple(objects[p["instance"]].moved(_vec3(p["position"]), p["yaw"]) for p in turn["coarse"])
        there = {o.instance for o in moved}
        carried = tuple(
            r for r in scene.relations if r.kind in _CARRYING and r.target != TABLE and {r.subject, r.target} <= there
        )
        on = {r.subject: r.target for r in carried}
        standing = tuple(replace(o, support=on.get(o.instance, TABLE)) for o in moved)
        layout = replace(scene, scene_id=f"{scene.scene_id}, {turn['stage']}", objects=standing, relations=carried)
        if store is not None:
            new = {o.instance for o in layout.objects if str(o.stage) == turn["stage"]}
            layout = drop_new_objects(store.resolved(layout)[0], new, frozenset(), store).scene
        yield StartLayout(layout, None, str(turn["stage"]), 0)


def audit_layout(scene: Scene, shapes: Sequence[Shape]) -> Audit:
    """Audits a layout, see :func:`~stable_data.metrics.audit.audit_scene`; the last audits are kept: all methods have one start."""
    return _audit_layout(scene, tuple(shapes))


@lru_cache(maxsize=4)  # the start, its target, and the results of one or two methods
def _audit_layout(scene: Scene, shapes: tuple[Shape, ...]) -> Audit:
    return audit_scene(scene, shapes)


def bucket_of(count: int) -> str:
    """Returns the bucket of a number of colliding pairs; empty for 0, or for more than in the last bucket."""
    return BUCKETS[count // 10] if 0 < count < 10 * len(BUCKETS) else ""
