"""One process answers: what is to be in a cup leans in it, wherever the flow puts the cup, and stays there."""

from dataclasses import replace

import pytest

from models.physics_corrector.certify import CertifyOptions
from models.physics_corrector.certify.correction import CertificationRequest, Correction, CorrectionOptions
from models.physics_corrector.corrector import PhysicsCorrector
from pipelines.generate.answers import LocalCertifier
from stable_data.metrics.audit import audit_scene
from stable_data.rotations import rotation_matrix
from stable_data.scene import Relation, RelationKind, Scene
from tests.models.physics_corrector.geometry.shapes import scene, store, thing

pytestmark = pytest.mark.sim

STICKS = frozenset({"cube_0", "cube_1"})
FLAT = (0.0, 0.5**0.5, 0.0, 0.5**0.5)


def pencils() -> Scene:
    """A cup, and two pencils that are to be in it and were proposed lying across its rim."""
    cup = thing("cup", (0.5, 0.4, 0.05, 0.0))
    sticks = [
        thing(f"cube_{k}", (0.5, 0.38 + 0.03 * k, 0.1, 0.0), scale=(0.1, 0.1, 1.5), tilt=FLAT, support="cup") for k in range(2)
    ]
    built = store().resolved(scene(cup, *sticks))[0]
    return replace(built, relations=tuple(Relation(o.instance, RelationKind.IN, "cup") for o in sticks))


def corrected(built: Scene, *, new: frozenset[str] = STICKS, raw: Scene | None = None, settles: bool = False) -> Correction:
    certifier = LocalCertifier(PhysicsCorrector(options=CertifyOptions(twice=False)), store())
    return certifier(CertificationRequest(built, raw, CorrectionOptions(new=new, may_tilt=True, asks_engine=settles)))


def height_of(done: Correction, name: str) -> float:
    """Sine of the slope of a pencil."""
    assert done.certified is not None
    return float(abs(rotation_matrix(done.certified[name].tilt_quat_xyzw)[2, 2]))


@pytest.mark.parametrize("settles", [False, True])
def test_pencils_lean_in_their_cup(settles: bool) -> None:
    built = pencils()
    done = corrected(built, settles=settles)
    assert done.start == built
    assert done.kept is not None
    assert done.kept.asked_missing == ()
    assert all(height_of(done, name) > 0.7 for name in STICKS)
    assert done.certified is not None
    resolved, shapes, _ = store().resolved(done.certified)
    assert audit_scene(resolved, shapes).card().clean
    assert (done.rest is not None and bool(done.rest.stable)) == settles


def test_what_was_there_before_is_not_let_go_again() -> None:
    done = corrected(pencils(), new=frozenset())
    assert all(height_of(done, name) < 0.1 for name in STICKS)
    assert done.kept is not None
    assert {r.subject for r in done.kept.asked_missing} == STICKS


def test_pencils_stay_in_a_cup_that_the_flow_moves_away() -> None:
    built = pencils()
    poses = built.poses()
    poses[0, :2] += (0.2, -0.1)  # the flow moves the cup alone
    done = corrected(built, raw=built.with_poses(poses))
    assert done.kept is not None
    assert done.kept.asked_missing == ()
    assert all(height_of(done, name) > 0.7 for name in STICKS)
