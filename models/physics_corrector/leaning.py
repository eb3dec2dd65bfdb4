"""Scenes certified so that they stay at rest: what the engine moves may lean as it came to lie, else it is put where it stays.

The corrector itself changes positions and yaws alone. A pencil in a cup has no place that suits the angle at which it was drawn; at the
angle at which it leans in the end it is at rest. This is for scenes that are made, whose tilts are nobody's but ours, and whose
background need not hold a thing that nothing keeps still.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from models.physics_corrector.certify import Dropped, Status
from models.physics_corrector.corrector import Correction, Fixed, PhysicsCorrector, certified_from, movement
from stable_data.assets import AssetStore
from stable_data.colliders import bodies_of
from stable_data.errors import MeshError
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.metrics.kept import relations_kept
from stable_data.physics import SettleResult, settle
from stable_data.scene import Scene, Stage
from stable_data.shape import Shape
from stable_data.solid_scene import at_rest

_LEANS = 2  # how often what moves may take another tilt
_STRAYED, _TOPPLED = 0.05, 60.0  # what went farther, metres, or turned more, degrees, has fallen and leans on nothing


def steadied(
    corrector: PhysicsCorrector, scene: Scene, shapes: Sequence[Shape], raw: Scene | None, fixed: Fixed, store: AssetStore
) -> Correction:
    """One scene certified, of which the engine was asked; what it moves leans, or is put elsewhere, or at last left out.

    Args:
        corrector: Certifies.
        scene: As it came, resolved.
        shapes: The geometry of its objects, in order.
        raw: What the flow made of it; None without one.
        fixed: Instances that must stay.
        store: Geometry of the assets.

    Returns:
        The correction, with the engine's verdict where it could be asked; its figures of movement and relations are from the start.
        Task objects are not left out: a scene whose own do not stay is unsteady.
    """
    try:
        bodies = bodies_of(scene, shapes, store)
    except MeshError:
        return corrector.certified(scene, shapes, audit_scene(scene, shapes), raw, fixed)
    quick = replace(corrector, options=replace(corrector.options, places=0))
    audit = audit_scene(scene, shapes)
    done = quick.certified(scene, shapes, audit, raw, fixed, bodies)
    for _ in range(_LEANS):
        leaning = _leaning(done, store, fixed)
        better = None if leaning is None else _again(quick, done, audit, leaning, fixed, store)
        if better is None:
            break
        done = better
    if done.certified is not None and done.rest is not None and done.rest.unsteady:
        done = _again(corrector, done, audit, done.certified, fixed, store) or done
    if done.certified is not None and done.rest is not None and done.rest.unsteady:
        done = _left_out(quick, done, audit, fixed, store) or _watched(done, store)
    return done


def _left_out(
    corrector: PhysicsCorrector, done: Correction, before: Audit, fixed: Fixed, store: AssetStore
) -> Correction | None:
    """The correction without what does not stay; None where the rest does not either, or is the task's or must be there."""
    assert done.certified is not None
    assert done.rest is not None
    scene = done.certified
    names = set(done.rest.unsteady) | scene.resting_on(set(done.rest.unsteady))
    gone = [o for o in scene.objects if o.instance in names]
    if any(o.stage is Stage.TASK or o.instance in fixed | corrector.options.fixed for o in gone) or len(gone) == len(
        scene.objects
    ):
        return None
    rest = replace(scene, objects=tuple(o for o in scene.objects if o not in gone))
    again = _again(corrector, done, before, rest, fixed, store)
    if again is None or again.rest is None or not again.rest.stable:
        return None
    dropped = tuple(Dropped(o.instance, f"it, or what carries it, would not stay: {done.rest.reason}") for o in gone)
    reason = "; ".join(f"{d.instance} dropped: {d.reason}" for d in (*done.dropped, *dropped))
    return replace(again, status=Status.DROPPED, reason=reason, dropped=(*done.dropped, *dropped))


def _watched(done: Correction, store: AssetStore) -> Correction:
    """The correction with the whole verdict on it: what moves may not have been watched to its end."""
    if done.certified is None or done.rest is None or done.rest.drift_mm is not None:
        return done
    scene, shapes, _ = store.resolved(done.certified)
    return replace(done, rest=settle(bodies_of(scene, shapes, store), scene.table))


def _leaning(done: Correction, store: AssetStore, fixed: Fixed) -> Scene | None:
    """The corrected scene with what did not stay where it came to lie; None where all stayed, or what did not has fallen."""
    rest, scene = done.rest, done.certified
    if rest is None or scene is None or not rest.unsteady:
        return None
    number = {name: k for k, name in enumerate(rest.names)}
    moved = (scene.resting_on(set(rest.unsteady)) | set(rest.unsteady)) - fixed
    near = {n for n in moved if rest.moves[number[n]] < _STRAYED and rest.turns[number[n]] < _TOPPLED}
    if not near or not np.isfinite(rest.positions).all():
        return None
    poses = {n: (tuple(rest.positions[k].tolist()), tuple(rest.quats_xyzw[k].tolist())) for n, k in number.items()}
    return replace(
        scene,
        objects=tuple(at_rest(o, store.mesh_of(o), poses[o.instance]) if o.instance in near else o for o in scene.objects),
    )


def _again(
    corrector: PhysicsCorrector, done: Correction, before: Audit, scene: Scene, fixed: Fixed, store: AssetStore
) -> Correction | None:
    """The correction gone on with from a scene, told as one with it; None where no more of it stays then."""
    scene, shapes, _ = store.resolved(scene)
    try:
        bodies = bodies_of(scene, shapes, store)
    except MeshError:
        return None
    again = certified_from(scene, None, shapes, replace(corrector.options, fixed=corrector.options.fixed | fixed), bodies)
    if again.scene is None or again.audit is None or again.dropped:
        return None
    if _num_unsteady(again.rest) >= _num_unsteady(done.rest):
        return None
    _, shapes_before, _ = store.resolved(done.start)
    kept = relations_kept(done.start, again.scene, shapes_before, shapes, audits=(before, again.audit))
    mean, farthest, turn = movement(done.start, again.scene)
    card = replace(
        again.audit.card(),
        relations_kept_on_in=kept.on_in_share,
        relations_kept_directional=kept.directional_share,
        move_mean_mm=mean,
        move_max_mm=farthest,
        turn_max_deg=turn,
    )
    return replace(done, certified=again.scene, card_after=card, audit=again.audit, kept=kept, rest=again.rest)


def _num_unsteady(rest: SettleResult | None) -> float:
    return np.inf if rest is None or rest.stable is None else len(rest.unsteady)
