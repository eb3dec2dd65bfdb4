"""Scenes certified so that they stay at rest: what the engine moves may lean as it came to lie, else it is put where it stays.

The corrector itself changes positions and yaws alone. A pencil in a cup has no place that suits the angle at which it was
drawn; at the angle at which it leans in the end it is at rest. This is for scenes that are made, whose tilts are nobody's but
ours, and whose background need not hold a thing that nothing keeps still.
"""

from dataclasses import replace

import numpy as np

from models.physics_corrector.certify import CertificationResult, CorrectionStatus, DroppedObject
from models.physics_corrector.corrector import Correction, Fixed, InputScene, PhysicsCorrector, named, told
from models.physics_corrector.stabilization.drop_simulation import leaning_in
from models.physics_corrector.stabilization.recorrection import gone_on, put_elsewhere
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.metrics.audit import audit_scene
from stable_data.scene import RelationKind, Scene, Stage
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.scene_geometry import at_rest
from stable_data.simulation.settling import PhysicsOptions, SettleResult, settle

_LEANS = 2  # how often what moves may take another tilt
_LEFT_OUT = 3  # how often things are left out, where others move without them
_NEEDED = 4  # at how many times as many places things are tried where one is of the task, which cannot be left out
_STRAYED, _TOPPLED = 0.05, 60.0  # what went farther, metres, or turned more, degrees, has fallen and leans on nothing


def steadied(corrector: PhysicsCorrector, done: Correction, came: InputScene, fixed: Fixed, store: AssetStore) -> Correction:
    """A correction of which the engine is asked; what it moves leans, or is put elsewhere, or at last left out.

    Args:
        corrector: Certifies.
        done: The correction, of which the engine was not asked.
        came: The scene as it came.
        fixed: Instances that must stay.
        store: Geometry of the assets.

    Returns:
        The correction, with the engine's verdict where it could be asked; its figures of movement and relations are from the
        start. Task objects are not left out: a scene whose own do not stay is unsteady.
    """
    if done.certified is None or done.status is CorrectionStatus.UNKNOWN:
        return done
    fixed = fixed | corrector.options.fixed
    quick = replace(corrector, options=replace(corrector.options, places=0))
    scene, shapes, _ = store.resolved(done.certified)
    try:
        rest = settle(bodies_of(scene, shapes, store), scene.table, PhysicsOptions(hurries=True))
    except MeshError:
        return done
    done = replace(done, rest=rest if rest.stable is not None else None)
    for _ in range(_LEANS):
        leaning = _leaning(done, store, fixed)
        better = None if leaning is None else _again(quick, done, came, leaning, fixed, store)
        if better is None:
            break
        done = better
    for cup, names in _restless_cups(done, fixed):
        assert done.certified is not None
        anew = leaning_in(done.certified, cup, names, fixed, store)
        done = (None if anew is None else _again(quick, done, came, anew, fixed, store)) or done
    if done.certified is not None and done.rest is not None and done.rest.unsteady:
        is_needed = any(o.stage is Stage.TASK for o in done.certified.objects if o.instance in done.rest.unsteady)
        places = (_NEEDED if is_needed else 1) * corrector.options.places
        patient = replace(corrector, options=replace(corrector.options, places=places))
        done = put_elsewhere(patient, _watched(done, store), came, fixed, store)
    if done.certified is not None and done.rest is not None and done.rest.unsteady:
        done = _left_out(quick, done, came, fixed, store) or _watched(done, store)
    return done


def _restless_cups(done: Correction, fixed: Fixed) -> list[tuple[str, set[str]]]:
    """What is to be in something and does not stay there, by what it is in."""
    if done.certified is None or done.rest is None:
        return []
    there, unsteady = {o.instance for o in done.certified.objects}, set(done.rest.unsteady) - fixed
    inside = [r for r in done.certified.relations if r.kind is RelationKind.IN and r.subject in unsteady and r.target in there]
    return [(cup, {r.subject for r in inside if r.target == cup}) for cup in dict.fromkeys(r.target for r in inside)]


def _left_out(
    corrector: PhysicsCorrector, done: Correction, came: InputScene, fixed: Fixed, store: AssetStore
) -> Correction | None:
    """The correction without what does not stay; None where the rest does not either, or is the task's or must be there."""
    assert done.certified is not None
    assert done.rest is not None
    scene, rest, dropped = done.certified, done.rest, list(done.dropped)
    for _ in range(_LEFT_OUT):
        names = set(rest.unsteady) | scene.resting_on(set(rest.unsteady))
        gone = [o for o in scene.objects if o.instance in names]
        if any(o.stage is Stage.TASK or o.instance in fixed for o in gone):
            return None
        dropped += [DroppedObject(o.instance, f"it, or what carries it, would not stay: {rest.reason}") for o in gone]
        scene, shapes, _ = store.resolved(replace(scene, objects=tuple(o for o in scene.objects if o not in gone)))
        if not scene.objects:
            return None
        audit, rest = audit_scene(scene, shapes), settle(bodies_of(scene, shapes, store), scene.table)
        if rest.stable and audit.card().clean:  # nothing had moved: what was clean is clean without it
            reason = "; ".join(f"{d.instance} dropped: {d.reason}" for d in dropped)
            left = CertificationResult(scene, CorrectionStatus.DROPPED, reason, tuple(dropped), audit, rest)
            return told(came, left, named(scene, shapes), raw=done.raw, card_raw=done.card_raw)
        if not rest.unsteady:
            return None
    return None


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
    corrector: PhysicsCorrector, done: Correction, came: InputScene, scene: Scene, fixed: Fixed, store: AssetStore
) -> Correction | None:
    """The correction gone on with from a scene; None where no more of it stays then."""
    again = gone_on(corrector, done, came, scene, fixed, store)
    return None if again is None or _num_restless(again.rest) >= _num_restless(done.rest) else again


def _num_restless(rest: SettleResult | None) -> float:
    return np.inf if rest is None or rest.stable is None else rest.num_restless
