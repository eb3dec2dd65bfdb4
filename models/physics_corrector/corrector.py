"""The Physics Corrector: coarse layouts in, scenes that are exactly clean out.

The learned flow moves all objects at once; ``certify`` proves the result or mends what is left. Both are always told apart: a
:class:`Correction` holds the raw result of the flow and the certified one, with the cards of all three.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from models.physics_corrector.certify import CertificationResult, Certifier, CertifyOptions, CorrectionStatus, DroppedObject
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.relations_kept import DIRECTIONAL, RelationsKept, relations_kept
from stable_data.scene import FloatArray, IntArray, Scene
from stable_data.scene_graph.relations import scene_graph

if TYPE_CHECKING:  # the engine takes long to import
    from stable_data.simulation.settling import RigidBody, SettleResult

Fixed: TypeAlias = frozenset[str]
"""Instances of a scene that must stay where they are."""

Flow: TypeAlias = Callable[[Sequence[Scene], Sequence[Sequence[Shape]], Sequence[Fixed]], list[Scene]]
"""Moves the objects of scenes: scenes, the shapes of their objects, what must stay in each -> the scenes after."""

_STILL, _STILL_TURN = 5e-3, float(np.radians(5))  # about what the flow is accurate to, metres and radians
_DEFAULT = CertifyOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What became of one scene.

    Attributes:
        status: Whether it is clean, and at what price.
        reason: Why nothing better was possible; empty where certified.
        start: The scene as it came.
        raw: After the flow, before it was certified; None without a flow.
        certified: The clean scene; None where infeasible.
        dropped: Objects that found no place.
        card_before: Figures of the start; None where it could not be judged at all.
        card_raw: Figures of the raw flow; None without one, or where they were not asked for.
        card_after: Figures of the clean scene, with its movement and the relations that it kept; None where infeasible.
        audit: Every verdict on the clean scene; None where infeasible.
        kept: Relations of the start that still hold, counted; None where infeasible.
        rest: The physics engine's verdict on ``certified``; None where it was not asked or could not be.
    """

    status: CorrectionStatus
    reason: str
    start: Scene
    raw: Scene | None
    certified: Scene | None
    dropped: tuple[DroppedObject, ...]
    card_before: MetricCard | None
    card_raw: MetricCard | None
    card_after: MetricCard | None
    audit: Audit | None
    kept: RelationsKept | None
    rest: "SettleResult | None"


@dataclass(frozen=True, slots=True)
class PhysicsCorrector:
    """Corrects scenes.

    Attributes:
        flow: The learned part, such as :class:`~models.physics_corrector.learned_flow.LearnedFlow`; None certifies alone.
        options: What `certify` may do.
        judges_raw: Whether the raw result of the flow is audited too, which costs as much as any audit.
    """

    flow: Flow | None = None
    options: CertifyOptions = field(default_factory=CertifyOptions)
    judges_raw: bool = True

    def correct(
        self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed] | None = None
    ) -> list[Correction]:
        """Corrects scenes; each comes out as it would alone, but for the rounding of the flow's batch.

        Args:
            scenes: Positions at the centres of the boxes (``AssetStore.resolved``); with stages where task objects are known.
            shapes: The geometry of their objects, in their order.
            fixed: What must stay in each, besides what ``options`` names.

        Returns:
            One correction a scene, in order.
        """
        fixed = fixed or [frozenset()] * len(scenes)
        raws = self.raw(scenes, shapes, fixed)
        audits = [audit_scene(scene, own) for scene, own in zip(scenes, shapes, strict=True)]
        return [self.certified(*each) for each in zip(scenes, shapes, audits, raws, fixed, strict=True)]

    def raw(self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]) -> Sequence[Scene | None]:
        """What the flow alone makes of scenes; None for each without a flow."""
        if self.flow is None:
            return [None] * len(scenes)
        return self.flow(scenes, shapes, [self.options.fixed | own for own in fixed])

    def certified(
        self,
        scene: Scene,
        shapes: Sequence[Shape],
        audit: Audit,
        raw: Scene | None,
        fixed: Fixed = frozenset(),
        bodies: Sequence["RigidBody"] | None = None,
    ) -> Correction:
        """One scene after the flow, proven or mended.

        Args:
            scene: As it came.
            shapes: The geometry of its objects, in order.
            audit: The verdicts on it.
            raw: What the flow made of it.
            fixed: What must stay.
            bodies: The objects as the physics engine sees them (``stable_data.simulation.collision_bodies.bodies_of``): with
                them it is asked what stays at rest, and what does not is put where it does, if that is found.
        """
        options = replace(self.options, fixed=self.options.fixed | fixed)
        done = certified_from(scene, raw, shapes, options, bodies)
        card_raw = audit_scene(raw, shapes).card() if raw is not None and self.judges_raw else None
        return told(InputScene(scene, shapes, audit), done, named(scene, shapes), raw=raw, card_raw=card_raw)


@dataclass(frozen=True, slots=True, eq=False)
class InputScene:
    """A scene as it came to the corrector: what movement and relations are measured from.

    Attributes:
        scene: The scene, resolved.
        shapes: The geometry of its objects, in order.
        audit: The verdicts on it.
    """

    scene: Scene
    shapes: Sequence[Shape]
    audit: Audit


def named(scene: Scene, shapes: Sequence[Shape]) -> dict[str, Shape]:
    """The geometry of a scene's objects by instance."""
    return {o.instance: shape for o, shape in zip(scene.objects, shapes, strict=True)}


def told(
    came: InputScene,
    done: CertificationResult,
    shapes: Mapping[str, Shape],
    *,
    raw: Scene | None = None,
    card_raw: MetricCard | None = None,
) -> Correction:
    """What became of a scene, with the figures of its movement and of the relations that it kept.

    Args:
        came: The scene as it came.
        done: What `certify` made of it.
        shapes: The geometry that was certified, by instance; tilts may be others than they came with.
        raw: What the flow made of it.
        card_raw: Figures of that.
    """
    card_after, kept = None, None
    if done.scene is not None and done.audit is not None:
        after = [shapes[o.instance] for o in done.scene.objects]
        kept = relations_kept(came.scene, done.scene, came.shapes, after, audits=(came.audit, done.audit))
        card_after = with_movement(done.audit.card(), came.scene, done.scene, kept)
    return Correction(
        status=done.status,
        reason=done.reason,
        start=came.scene,
        raw=raw,
        certified=done.scene,
        dropped=done.dropped,
        card_before=came.audit.card(),
        card_raw=card_raw,
        card_after=card_after,
        audit=done.audit,
        kept=kept,
        rest=done.rest,
    )


def certified_from(
    scene: Scene,
    raw: Scene | None,
    shapes: Sequence[Shape],
    options: CertifyOptions = _DEFAULT,
    bodies: Sequence["RigidBody"] | None = None,
) -> CertificationResult:
    """Certifies a scene from where the flow put it; where that leaves out or breaks anything, once more from the scene itself.

    Of what only breaks relations ``options.twice`` decides.

    Args:
        scene: As it came, with the supports of its objects where they are known.
        raw: What the flow made of it; None without one.
        shapes: The geometry of its objects, in order.
        options: What `certify` may do.
        bodies: The objects as the physics engine sees them, where it is to be asked.

    Returns:
        The better of both: the one that leaves out less, of those the one that breaks less, of those the one that moves less.
    """
    start = starting_point(scene, raw)
    certifier = Certifier(start, shapes, options, scene)
    done = certifier.certified()
    if start is not scene and (done.scene is None or done.dropped or (options.twice and done.num_broken)):
        other = Certifier(scene, shapes, options)

        def badness(each: tuple[CertificationResult, Certifier]) -> tuple[bool, int, int, float]:
            done = each[0]
            move = np.inf if done.scene is None else movement(scene, done.scene)[0]
            return done.scene is None, len(done.dropped), done.num_broken, move

        done, certifier = min(((done, certifier), (other.certified(), other)), key=badness)
    # The engine takes far longer than certifying: it is asked of the better one alone.
    return done if bodies is None else certifier.rested(done, bodies)


def starting_point(scene: Scene, raw: Scene | None) -> Scene:
    """Where `certify` begins: what the flow made of a scene, without what would do harm.

    The flow says which way a crowd parts; millimetres and heights are the exact part's to find. A layout in which it would move
    nothing farther along the table than its own error is so good that its error is all that it could add: it stays as it came.
    What would break a directional relation goes back with all that it carries, the farthest first: `certify` could hardly mend
    it, as whatever stands between two things keeps them apart.

    Args:
        scene: As it came, with the supports of its objects where they are known.
        raw: What the flow made of it; None without one.
    """
    if raw is None:
        return scene
    start, poses = scene.poses(), raw.poses()
    steps = poses - start
    turns = np.arctan2(np.sin(steps[:, 3]), np.cos(steps[:, 3]))
    if ((np.linalg.norm(steps[:, :2], axis=1) < _STILL) & (np.abs(turns) < _STILL_TURN)).all():
        return scene
    one, other, axis = _side_by_side(scene, start)
    sign = np.sign(start[one, axis] - start[other, axis])
    for _ in scene.objects:
        apart = poses[one, :2] - poses[other, :2]
        each = np.arange(len(one))
        broken = sign * apart[each, axis] <= np.abs(apart[each, 1 - axis])
        ends = np.concatenate([one[broken], other[broken]])
        lengths = np.linalg.norm(poses[ends, :2] - start[ends, :2], axis=1)
        if not lengths.any():
            break
        gone_back = scene.resting_on({scene.objects[int(ends[lengths.argmax()])].instance})
        back = [k for k, o in enumerate(scene.objects) if o.instance in gone_back]
        poses[back] = start[back]
    return scene.with_poses(poses)


def _side_by_side(scene: Scene, poses: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs (E,) that directional relations link, each once, and the axis along which they are apart, 0 or 1."""
    number = {o.instance: k for k, o in enumerate(scene.objects)}
    edges = scene_graph(scene, {}).edges(keys=True)
    pairs = {tuple(sorted((number[s], number[t]))) for s, t, kind in edges if kind in DIRECTIONAL}
    one, other = np.array(sorted(pairs), np.int64).reshape(-1, 2).T
    apart = np.abs(poses[one, :2] - poses[other, :2])
    return one, other, (apart[:, 1] >= apart[:, 0]).astype(np.int64)


def movement(before: Scene, after: Scene) -> tuple[float, float, float]:
    """How far objects moved.

    Args:
        before: A scene.
        after: The same later; objects that are gone do not count.

    Returns:
        Mean and largest displacement, millimetres; largest turn, degrees.
    """
    was = {o.instance: (*o.position, o.yaw) for o in before.objects}
    steps = np.array([np.subtract((*o.position, o.yaw), was[o.instance]) for o in after.objects]).reshape(-1, 4)
    if not len(steps):
        return 0.0, 0.0, 0.0
    lengths = 1e3 * np.linalg.norm(steps[:, :3], axis=1)
    turns = np.degrees(np.abs(np.arctan2(np.sin(steps[:, 3]), np.cos(steps[:, 3]))))
    return float(lengths.mean()), float(lengths.max()), float(turns.max())


def with_movement(card: MetricCard, before: Scene, after: Scene, kept: RelationsKept) -> MetricCard:
    """A card with how far objects moved, millimetres and degrees, and what of their relations was kept.

    Args:
        card: Figures of ``after``.
        before: A scene.
        after: The same later.
        kept: Their relations, compared.
    """
    mean, farthest, turn = movement(before, after)
    return replace(
        card,
        relations_kept_on_in=kept.on_in_share,
        relations_kept_directional=kept.directional_share,
        move_mean_mm=mean,
        move_max_mm=farthest,
        turn_max_deg=turn,
    )
