"""What does not stay as it was tilted leans as it came to lie; the scene is clean and stays all the same."""

import math
from dataclasses import replace

import pytest

from models.physics_corrector.certify import CertifyOptions, CorrectionStatus
from models.physics_corrector.certify.correction import Correction, CorrectionOptions, InputScene
from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.stabilization import stabilize
from models.physics_corrector.stabilization.stabilize import relocate_unstable
from stable_data.assets.store import AssetStore
from stable_data.metrics.audit import audit_scene
from stable_data.scene import QuatXyzw, Scene, Stage
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import settle
from tests.models.physics_corrector.geometry.shapes import scene, store, thing


def tilted(degrees: float) -> QuatXyzw:
    """About the x axis."""
    return (math.sin(math.radians(degrees) / 2), 0.0, 0.0, math.cos(math.radians(degrees) / 2))


def steady(given: Scene, fixed: frozenset[str] = frozenset(), *, places: int = 100) -> Correction:
    corrector = PhysicsCorrector(options=CertifyOptions(places=places))
    (done,) = corrector.correct([given], store(), CorrectionOptions(fixed, may_tilt=True, asks_engine=True))
    return done


STICK = (0.1, 0.1, 1.4)  # of a cube of 10 cm

IN_A_BOWL = scene(
    thing("bowl", (0.5, 0.4, 0.04, 0.0)),
    thing("cube", (0.5, 0.4, 0.09, 0.0), scale=STICK, tilt=tilted(35), support="bowl"),
)


def test_a_stick_in_a_bowl_leans_as_it_comes_to_lie() -> None:
    done = steady(IN_A_BOWL)
    assert done.certified is not None
    assert done.rest is not None
    assert done.rest.stable
    stick = done.certified["cube"]
    assert stick.tilt_quat_xyzw != IN_A_BOWL["cube"].tilt_quat_xyzw
    resolved, shapes, _ = store().resolved(done.certified)
    assert resolved["cube"].size == pytest.approx(stick.size)
    assert audit_scene(resolved, shapes).card().clean
    verdict = settle(bodies_of(resolved, shapes, store()), resolved.table)
    assert verdict.stable
    assert verdict.settle_move_max_mm == done.rest.settle_move_max_mm
    assert done.card_after is not None
    start = store().resolved(IN_A_BOWL)[0]
    moves = [1e3 * math.dist(o.position, start[o.instance].position) for o in done.certified.objects]
    assert done.card_after.move_max_mm == pytest.approx(max(moves))


def test_without_it_the_stick_does_not_stay() -> None:
    quick = PhysicsCorrector(options=CertifyOptions(places=0))
    (done,) = quick.correct([IN_A_BOWL], store(), CorrectionOptions(asks_engine=True))
    assert done.rest is not None
    assert "cube" in done.rest.unsteady


def test_what_stays_is_left_as_it_was() -> None:
    given = scene(thing("cube", (0.5, 0.4, 0.05, 0.3)), thing("bowl", (0.2, 0.2, 0.04, 0.0)))
    done = steady(given)
    assert done.certified == store().resolved(given)[0]


def test_what_must_stay_keeps_its_tilt() -> None:
    done = steady(IN_A_BOWL, frozenset({"bowl", "cube"}))
    if done.certified is not None:
        assert done.certified["cube"].tilt_quat_xyzw == IN_A_BOWL["cube"].tilt_quat_xyzw


def test_what_topples_is_put_elsewhere_and_not_laid_down() -> None:
    """A pole on its edge falls flat, which is no way to lean."""
    given = scene(thing("cube", (0.5, 0.4, 0.2, 0.0), scale=(0.3, 0.3, 4.0), tilt=tilted(8)))
    done = steady(given)
    assert done.certified is None or done.certified["cube"].tilt_quat_xyzw == given["cube"].tilt_quat_xyzw


POLE = thing("cube", (0.5, 0.4, 0.2, 0.0), scale=(0.3, 0.3, 4.0), tilt=tilted(8))  # on its edge, and no wall near
PLATE = thing("plate", (0.2, 0.2, 0.005, 0.0))


@pytest.mark.parametrize("stage", [Stage.IMPORTANT, Stage.SECONDARY])
def test_background_that_nothing_keeps_still_is_left_out(stage: Stage) -> None:
    done = steady(scene(PLATE, replace(POLE, stage=stage)))
    assert done.certified is not None
    assert [o.instance for o in done.certified.objects] == ["plate"]
    assert (done.status, [d.instance for d in done.dropped]) == (CorrectionStatus.DROPPED, ["cube"])
    assert "cube" in done.reason
    assert done.rest is not None
    assert done.rest.stable
    assert done.rest.drift_mm is not None


def test_a_task_object_that_nothing_keeps_still_is_told_and_stays() -> None:
    done = steady(scene(PLATE, replace(POLE, stage=Stage.TASK)))
    assert done.certified is not None
    assert not done.dropped
    assert done.rest is not None
    assert done.rest.unsteady == ("cube",)
    assert done.rest.drift_mm is not None  # it was watched to its end
    assert done.rest.settle_turn_max_deg is not None
    assert done.rest.settle_turn_max_deg > 60


def test_a_task_object_that_a_falling_one_pushes_stays() -> None:
    """The pole falls onto a cup of the task, and is left out."""
    cup = replace(thing("cup", (0.5, 0.33, 0.05, 0.0)), stage=Stage.TASK)
    given = store().resolved(scene(cup, replace(POLE, stage=Stage.SECONDARY)))[0]
    assert settle(bodies_of(given, store().shapes(given)[0], store()), given.table).unsteady == ("cup", "cube")
    done = steady(given, places=0)
    assert done.certified is not None
    assert [o.instance for o in done.certified.objects] == ["cup"]
    assert done.rest is not None
    assert done.rest.stable


@pytest.mark.parametrize(("stage", "places"), [(Stage.TASK, 20), (Stage.SECONDARY, 5)])
def test_more_places_are_tried_for_what_must_not_be_left_out(
    stage: Stage, places: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def noted(done: Correction, start: InputScene, options: CertifyOptions, assets: AssetStore) -> Correction:
        tried.append(options.places)
        return relocate_unstable(done, start, options, assets)

    monkeypatch.setattr(stabilize, "relocate_unstable", noted)
    steady(scene(PLATE, replace(POLE, stage=stage)), places=5)
    assert tried == [places]


def test_all_that_nothing_keeps_still_is_left_out_at_once() -> None:
    """Two poles on their edges are background, and the plate stays."""
    upper = thing("cube_1", (0.5, 0.4, 0.5, 0.0), scale=(0.3, 0.3, 4.0), tilt=tilted(8))
    poles = (replace(POLE, stage=Stage.SECONDARY), replace(upper, position=(0.8, 0.4, 0.2), stage=Stage.IMPORTANT))
    done = steady(scene(replace(PLATE, stage=Stage.TASK), *poles), places=0)
    assert done.certified is not None
    assert [o.instance for o in done.certified.objects] == ["plate"]
    assert sorted(d.instance for d in done.dropped) == ["cube", "cube_1"]
    assert done.audit is not None
    assert done.audit.card().clean
    assert done.card_after is not None
    assert done.kept is not None
