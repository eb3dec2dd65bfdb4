"""The validation card: figures of raw samples of a network on held-out scenes, and of their coarse layouts.

Each row is a kind of perturbation at a fixed seed; ``jitter_fixed`` is ``jitter`` with the objects of earlier stages fixed, and
``proposed`` are proposals of a reasoner, with the errors told as in generation. The
figures from grids are fast; those of the exact audit (docs/audit.md) and of the scene graph are slow and use fewer scenes.
Verdicts that are unknown are left out and counted, never treated as a pass.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import Mover
from models.physics_corrector.flow.pose_coordinates import wrap_angle
from models.physics_corrector.geometry.closest_point import ClosestPointQueries, closest_sample
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeTensors
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.losses import colliding_pairs
from models.physics_corrector.training.perturbation import KINDS, Kind, PerturbationSettings, perturb, reassign_targets
from models.physics_corrector.training.stage_prefixes import drop_empty_slots, prefix
from stable_data.assets.store import AssetStore
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.relations_kept import DIRECTIONAL
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.verdicts import TOLERANCE
from stable_data.rotations import YAW_ARM
from stable_data.scene import FloatArray, Relation, RelationKind, Scene
from stable_data.scene_graph.relations import relations_of, scene_graph

Figures: TypeAlias = dict[str, float | None]
"""Figure -> mean over the scenes; None if it is unknown in all of them."""

Card: TypeAlias = dict[str, dict[str, Figures]]
"""Row -> ``coarse`` and ``raw`` -> figures."""

ROWS = (*KINDS, "jitter_fixed")
PROPOSED = "proposed"
"""The row of proposals; the scenes must be proposals."""

_SUPPORTED = (RelationKind.ON, RelationKind.IN)
_CARD_FIGURES = (
    "oc",
    "oc_sdf",
    "oc_1mm",
    "oc_10mm",
    "max_penetration_mm",
    "table_penetration_mm",
    "float_rate",
    "float_gap",
    "out_of_bounds_rate",
    "max_gap_mm",
)


@dataclass(frozen=True, slots=True)
class ValidationScenes:
    """Scenes of a validation card.

    Attributes:
        data: The training set that contains them.
        places: Their indices in it, (S,) int64.
        scenes: The first of them as scenes, for the exact figures.
        store: Their meshes.
    """

    data: TrainingSet
    places: Tensor
    scenes: Sequence[Scene] = ()
    store: AssetStore | None = None


def validation_card(
    move: Mover,
    held_out: ValidationScenes,
    settings: PerturbationSettings,
    seed: int,
    rows: Sequence[str] = ROWS,
) -> Card:
    """Evaluates a network that moves objects.

    Args:
        move: Moves the objects of coarse layouts.
        held_out: The scenes.
        settings: Settings of the perturbations.
        seed: Seed of the perturbations: the same scenes and seed give the same coarse layouts.
        rows: Some of ROWS and PROPOSED.
    """
    shapes = [] if held_out.store is None else [held_out.store.shapes(scene)[0] for scene in held_out.scenes]
    return {row: _row(row, move, held_out, shapes, settings, seed) for row in rows}


@torch.no_grad()
def _row(
    row: str,
    move: Mover,
    held_out: ValidationScenes,
    shapes: Sequence[Sequence[Shape]],
    settings: PerturbationSettings,
    seed: int,
) -> dict[str, Figures]:
    data, places = held_out.data, held_out.places
    device = data.batch.poses.device
    generator = torch.Generator(device).manual_seed(seed + (*ROWS, PROPOSED).index(row))
    batch = data.take(places.to(device))
    if row.endswith("_fixed"):
        last = torch.full((len(batch),), 2, device=device)
        batch = prefix(batch, data.stage[places.to(device)], last, torch.ones_like(batch.has_zone))
    batch = drop_empty_slots(batch)  # whole scenes: the order of their objects does not change
    kind: Kind | None = next((k for k in KINDS if row.removesuffix("_fixed") == k), None)
    drawn = perturb(batch, settings, generator, kind)
    coarse = drawn.poses
    condition = Condition.of(replace(batch, poses=coarse, error=drawn.error if row == PROPOSED else None))
    raw = move(condition, generator)
    figures = {name: grid_figures(poses, coarse, batch, data.geometry) for name, poses in (("coarse", coarse), ("raw", raw))}
    for name, poses in (("coarse", coarse), ("raw", raw)):
        figures[name] |= _exact(held_out.scenes, shapes, poses.cpu().numpy(), coarse.cpu().numpy())
    return figures


def grid_figures(poses: Tensor, coarse: Tensor, batch: LayoutBatch, geometry: ShapeTensors) -> Figures:
    """Computes figures from grids and poses: per scene, then the mean over scenes.

    ``grid_oc`` and ``grid_oc_10mm`` are the shares of pairs whose sampled penetration is deeper than 0.5 and 10 mm. Moves are
    from the coarse layout; distances are to the nearest assignment of the target.

    Args:
        poses: (B, N, 4), metres and radians.
        coarse: The coarse poses, in the same form.
        batch: The scenes with their clean poses.
        geometry: Their shapes.
    """
    pairs = colliding_pairs(poses, batch, geometry)
    ways = pairs.both_ways()
    queries = ClosestPointQueries(ways.scene, ways.first, ways.second)
    limit = poses.new_zeros(len(queries))
    _, distance = closest_sample(poses, batch, geometry, queries, geometry.surface, limit)
    depth = torch.where(distance.isinf(), 0.0, -distance).reshape(2, -1).amax(0) if len(pairs) else poses.new_zeros(0)
    count = batch.mask.sum(1)
    num_pairs = (count * (count - 1) / 2).clamp_min(1)

    def share(tolerance: float) -> float:
        deeper = torch.zeros_like(num_pairs).index_add(0, pairs.scene, (depth > tolerance).to(num_pairs.dtype))
        return float((deeper / num_pairs).mean())

    movable = batch.is_movable
    moved = torch.linalg.vector_norm(poses[..., :3] - coarse[..., :3], dim=-1)
    offset = poses - reassign_targets(poses, batch)
    turned = wrap_angle(offset[..., 3]).abs()
    length = torch.linalg.vector_norm(offset[..., :3], dim=-1)
    return {
        "grid_oc": share(TOLERANCE),
        "grid_oc_10mm": share(0.01),
        "move_mean_mm": 1e3 * _mean(moved, movable),
        "target_distance_mm": 1e3 * _mean((length.square() + (YAW_ARM * turned).square()).sqrt(), movable),
        "target_move_mm": 1e3 * _mean(length, movable),
        "target_yaw_deg": float(np.degrees(_mean(turned, movable))),
    }


def _mean(values: Tensor, mask: Tensor) -> float:
    """The mean over scenes of the mean over a scene's objects."""
    of_scene = torch.where(mask, values, 0).sum(1) / mask.sum(1).clamp_min(1)
    return float(of_scene.mean())


def _exact(scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], poses: FloatArray, coarse: FloatArray) -> Figures:
    """Computes the figures of the exact audit and the scene graph, means over scenes; none without scenes."""
    found: dict[str, list[float | None]] = {}
    for n, (scene, own) in enumerate(zip(scenes, shapes, strict=True)):
        posed = _posed(scene, poses[n])
        figures, relations = _card_figures(posed, own), _relations(posed, own)
        of_coarse, of_target = _relations(_posed(scene, coarse[n]), own), _relations(scene, own)
        for name, kinds in (("on_in", _SUPPORTED), ("directional", DIRECTIONAL)):
            figures[f"relations_kept_{name}"] = _share_kept(of_coarse, relations, kinds)
            figures[f"relations_of_target_{name}"] = _share_kept(of_target, relations, kinds)
        for name, value in figures.items():
            found.setdefault(name, []).append(value)
    means: Figures = {}
    for name, values in found.items():
        known = [value for value in values if value is not None]
        means[name] = float(np.mean(known)) if known else None
        if name == "oc":
            means["num_judged"] = float(len(known))
    return means


def _posed(scene: Scene, poses: FloatArray) -> Scene:
    objects = tuple(
        o.moved((float(x), float(y), float(z)), float(yaw)) for o, (x, y, z, yaw) in zip(scene.objects, poses, strict=False)
    )
    return replace(scene, objects=objects)


def _relations(scene: Scene, shapes: Sequence[Shape]) -> frozenset[Relation]:
    """The relations of a layout, from boxes and outlines.

    Contacts are not exact here: with their tolerance of 3 mm, a cup that floats 4 mm above its saucer would lose its relation.
    """
    footprints = {
        o.instance: shape.posed_footprint(pose) for o, shape, pose in zip(scene.objects, shapes, scene.poses(), strict=True)
    }
    return frozenset(relations_of(scene_graph(scene, {}, footprints)))


def _card_figures(scene: Scene, shapes: Sequence[Shape]) -> dict[str, float | None]:
    audit = audit_posed_scene(PosedScene(scene, shapes))
    card = add_sampled_collisions(audit.card(), scene, shapes, audit)
    figures: dict[str, float | None] = {name: getattr(card, name) for name in _CARD_FIGURES}
    figures["clean"] = None if card.clean is None else float(card.clean)
    return figures


def _share_kept(before: frozenset[Relation], after: frozenset[Relation], kinds: Collection[RelationKind]) -> float | None:
    """The share of the relations of some kinds that still hold; None if there were none."""
    of_kinds = {relation for relation in before if relation.kind in kinds}
    return len(of_kinds & after) / len(of_kinds) if of_kinds else None


def scalar_figures(card: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> dict[str, float]:
    """Flattens a card to ``row/figure/coarse`` -> number, for logs, without unknown figures."""
    return {
        f"{row}/{figure}/{of}": value
        for row, sides in card.items()
        for of, figures in sides.items()
        for figure, value in figures.items()
        if value is not None
    }
