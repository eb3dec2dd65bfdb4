"""A correction gone on with from a scene that was made of its result, and told as one with it."""

from dataclasses import replace

from models.physics_corrector.certify import CertificationResult, Certifier, CorrectionStatus
from models.physics_corrector.corrector import Correction, Fixed, InputScene, PhysicsCorrector, certified_from, named, told
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.scene import Scene
from stable_data.simulation.collision_bodies import bodies_of


def gone_on(
    corrector: PhysicsCorrector, done: Correction, came: InputScene, scene: Scene, fixed: Fixed, store: AssetStore
) -> Correction | None:
    """Certifies a scene that was made of a result, and asks the physics engine of it.

    Args:
        corrector: Certifies.
        done: The correction so far.
        came: The scene as it came.
        scene: What was made of its result; tilts may be others.
        fixed: Instances that must stay.
        store: Geometry of the assets.

    Returns:
        The same correction with the new result; None where there is none without leaving out more.
    """
    scene, shapes, _ = store.resolved(scene)
    try:
        bodies = bodies_of(scene, shapes, store)
    except MeshError:
        return None
    again = certified_from(scene, None, shapes, replace(corrector.options, fixed=corrector.options.fixed | fixed), bodies)
    if again.scene is None or again.audit is None or again.dropped:
        return None
    return _with(done, told(came, again, named(scene, shapes)))


def put_elsewhere(
    corrector: PhysicsCorrector, done: Correction, came: InputScene, fixed: Fixed, store: AssetStore
) -> Correction:
    """Puts what the physics engine moves where it stays, as far as such places are found.

    Args:
        corrector: Its options say at how many places things are tried.
        done: The correction, with the engine's verdict.
        came: The scene as it came.
        fixed: Instances that must stay.
        store: Geometry of the assets.
    """
    assert done.certified is not None
    scene, shapes, _ = store.resolved(done.certified)
    certifier = Certifier(scene, shapes, replace(corrector.options, fixed=corrector.options.fixed | fixed))
    clean = CertificationResult(scene, CorrectionStatus.CERTIFIED, audit=done.audit, rest=done.rest)
    return _with(done, told(came, certifier.rested(clean, bodies_of(scene, shapes, store)), named(scene, shapes)))


def _with(done: Correction, again: Correction) -> Correction:
    """A correction with the result of another."""
    return replace(
        done, certified=again.certified, card_after=again.card_after, audit=again.audit, kept=again.kept, rest=again.rest
    )
