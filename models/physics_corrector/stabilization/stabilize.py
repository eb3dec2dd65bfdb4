"""Stabilises a certified scene in MuJoCo if tilts may change: unstable objects take their settled tilt, move, or are dropped.

Without changes of tilt only :mod:`~models.physics_corrector.stabilization.settle_repair` applies. A pencil in a cup may have no
place that suits its proposed tilt; at the tilt at which it settles it is at rest. This is for generated scenes: their tilts may
change, and unstable background objects may be dropped.
"""

from dataclasses import dataclass, replace

import numpy as np

from models.physics_corrector.certify import CertificationResult, Certifier, CertifyOptions, CorrectionStatus, DroppedObject
from models.physics_corrector.certify.correction import (
    Correction,
    Fixed,
    InputScene,
    build_correction,
    replace_result,
    shapes_by_instance,
)
from models.physics_corrector.stabilization.drop_simulation import drop_into_container
from models.physics_corrector.stabilization.limits import LEANS
from models.physics_corrector.stabilization.settle_repair import repair_settling
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.metrics.audit import audit_scene
from stable_data.scene import RelationKind, Scene, Stage
from stable_data.scene_graph.support_tree import SupportTree
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.scene_geometry import object_at_rest
from stable_data.simulation.settling import PhysicsOptions, SettleResult, settle

# Numbers of attempts. Tuned on: not recorded.
_TILT_ROUNDS = 2  # times that unstable objects may take their settled tilt
_DROP_ROUNDS = 3  # times that objects are dropped, because others may move without them
_TASK_PLACES_FACTOR = 4  # factor of the number of places for a task object, because it cannot be dropped


def stabilize(done: Correction, start: InputScene, options: CertifyOptions, store: AssetStore) -> Correction:
    """Simulates a correction in MuJoCo; unstable objects get another tilt or place, or are finally dropped.

    Args:
        done: The correction, without a verdict of MuJoCo.
        start: The scene before the correction.
        options: Settings of `certify`.
        store: Geometry of the assets.

    Returns:
        The correction, with MuJoCo's verdict if the simulation is possible; movement and relations are measured from ``start``.
        Task objects are not dropped: a scene in which they do not stay is unstable.
    """
    if done.certified is None or done.status is CorrectionStatus.UNKNOWN:
        return done
    scene, shapes, _ = store.resolved(done.certified)
    try:
        rest = settle(bodies_of(scene, shapes, store), scene.table, PhysicsOptions(stops_early=True))
    except MeshError as error:
        return replace(done, engine_fault=str(error))
    done = replace(done, rest=rest if rest.stable is not None else None)
    attempt = _Stabilization(start, options, store)
    for _ in range(_TILT_ROUNDS):
        settled = attempt.with_settled_tilts(done)
        better = None if settled is None else attempt.recertified_if_steadier(done, settled)
        if better is None:
            break
        done = better
    for container, names in _unstable_contents(done, options.fixed):
        assert done.certified is not None
        dropped = drop_into_container(done.certified, container, names, options.fixed, store)
        done = (None if dropped is None else attempt.recertified_if_steadier(done, dropped)) or done
    if done.certified is not None and done.rest is not None and done.rest.unsteady:
        has_task = any(o.stage is Stage.TASK for o in done.certified.objects if o.instance in done.rest.unsteady)
        places = (_TASK_PLACES_FACTOR if has_task else 1) * options.places
        done = relocate_unstable(_with_full_verdict(done, store), start, replace(options, places=places), store)
    if done.certified is not None and done.rest is not None and done.rest.unsteady:
        done = attempt.without_unstable(done) or _with_full_verdict(done, store)
    return done


def relocate_unstable(done: Correction, start: InputScene, options: CertifyOptions, store: AssetStore) -> Correction:
    """Moves objects that do not stay in MuJoCo to places where they do, if such places are found.

    Args:
        done: The correction, with MuJoCo's verdict.
        start: The scene before the correction.
        options: Settings of `certify`; ``places`` is the number of places for each object.
        store: Geometry of the assets.
    """
    assert done.certified is not None
    scene, shapes, _ = store.resolved(done.certified)
    certifier = Certifier(scene, shapes, options)
    clean = CertificationResult(scene, CorrectionStatus.CERTIFIED, audit=done.audit, rest=done.rest)
    result = repair_settling(certifier, clean, bodies_of(scene, shapes, store))
    return replace_result(done, build_correction(start, result, shapes_by_instance(scene, shapes)))


@dataclass(frozen=True, slots=True, eq=False)
class _Stabilization:
    """The attempts to stabilise one scene."""

    start: InputScene
    options: CertifyOptions
    store: AssetStore

    def with_settled_tilts(self, done: Correction) -> Scene | None:
        """Returns the certified scene with unstable objects at their settled tilts; None if all stay, or all unstable ones fell."""
        rest, scene, fixed = done.rest, done.certified, self.options.fixed
        if rest is None or scene is None or not rest.unsteady:
            return None
        number = {name: k for k, name in enumerate(rest.names)}
        moved = SupportTree.of(scene.objects).with_descendants(set(rest.unsteady)) - fixed
        near = {n for n in moved if rest.moves[number[n]] < LEANS.move and rest.turns[number[n]] < LEANS.turn}
        if not near or not np.isfinite(rest.positions).all():
            return None
        poses = {n: (tuple(rest.positions[k].tolist()), tuple(rest.quats_xyzw[k].tolist())) for n, k in number.items()}
        objects = (
            object_at_rest(o, self.store.mesh_of(o), poses[o.instance]) if o.instance in near else o for o in scene.objects
        )
        return replace(scene, objects=tuple(objects))

    def recertified_if_steadier(self, done: Correction, scene: Scene) -> Correction | None:
        """Certifies and simulates a changed version of a certified scene; tilts may differ.

        Returns:
            The correction with the new result; None if that drops objects or has as many unstable ones.
        """
        scene, shapes, _ = self.store.resolved(scene)
        try:
            bodies = bodies_of(scene, shapes, self.store)
        except MeshError:
            return None
        certifier = Certifier(scene, shapes, replace(self.options, places=0))
        result = repair_settling(certifier, certifier.certify(), bodies)
        if result.scene is None or result.audit is None or result.dropped:
            return None
        if _num_unstable(result.rest) >= _num_unstable(done.rest):
            return None
        return replace_result(done, build_correction(self.start, result, shapes_by_instance(scene, shapes)))

    def without_unstable(self, done: Correction) -> Correction | None:
        """Returns the correction without its unstable objects; None if others do not stay either.

        Task objects and fixed ones stay: they may move only because a falling object pushes them.
        """
        assert done.certified is not None
        assert done.rest is not None
        scene, rest, dropped = done.certified, done.rest, list(done.dropped)
        for _ in range(_DROP_ROUNDS):
            supports = SupportTree.of(scene.objects)
            kept = {o.instance for o in scene.objects if o.stage is Stage.TASK} | self.options.fixed
            trees = [supports.with_descendants({name}) for name in rest.unsteady]
            names = set[str]().union(*(tree for tree in trees if kept.isdisjoint(tree)))
            gone = [o for o in scene.objects if o.instance in names]
            if not gone:
                return None
            dropped += [DroppedObject(o.instance, f"it or its carrier would not stay at rest: {rest.reason}") for o in gone]
            left = tuple(o for o in scene.objects if o not in gone)
            scene, shapes, _ = self.store.resolved(replace(scene, objects=left))
            if not scene.objects:
                return None
            audit, rest = audit_scene(scene, shapes), settle(bodies_of(scene, shapes, self.store), scene.table)
            if rest.stable and audit.card().clean:  # no other pose changed
                reason = "; ".join(f"{d.instance} dropped: {d.reason}" for d in dropped)
                result = CertificationResult(scene, CorrectionStatus.DROPPED, reason, tuple(dropped), audit, rest)
                shape_of = shapes_by_instance(scene, shapes)
                return build_correction(self.start, result, shape_of, raw=done.raw, card_raw=done.card_raw)
            if not rest.unsteady:
                return None
        return None


def _unstable_contents(done: Correction, fixed: Fixed) -> list[tuple[str, set[str]]]:
    """Returns containers with their unstable contents, by the scene's relations."""
    if done.certified is None or done.rest is None:
        return []
    there, unsteady = {o.instance for o in done.certified.objects}, set(done.rest.unsteady) - fixed
    inside = [r for r in done.certified.relations if r.kind is RelationKind.IN and r.subject in unsteady and r.target in there]
    return [(cup, {r.subject for r in inside if r.target == cup}) for cup in dict.fromkeys(r.target for r in inside)]


def _with_full_verdict(done: Correction, store: AssetStore) -> Correction:
    """Returns the correction with MuJoCo's full verdict; a simulation in which an object moves may have ended early."""
    if done.certified is None or done.rest is None or done.rest.drift_mm is not None:
        return done
    scene, shapes, _ = store.resolved(done.certified)
    return replace(done, rest=settle(bodies_of(scene, shapes, store), scene.table))


def _num_unstable(rest: SettleResult | None) -> float:
    return np.inf if rest is None or rest.stable is None else rest.num_restless
