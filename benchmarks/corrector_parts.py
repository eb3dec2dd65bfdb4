"""The parts of the corrector, alone and together, with the interface of the baselines: flow, refinement, certification."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from benchmarks.layouts import audit_layout
from models.baselines.outcome import Baseline, BaselineResult
from models.physics_corrector.certify import CertifyOptions, CorrectionStatus
from models.physics_corrector.certify.correction import CorrectionOptions, Fixed
from models.physics_corrector.corrector import PhysicsCorrector, Polish, Purpose
from models.physics_corrector.flow.expected_error import UNKNOWN_ERROR, ExpectedError
from models.physics_corrector.learned_flow import AUTO, NONE, load_flow
from models.physics_corrector.learned_mover import LearnedMover
from models.physics_corrector.refinement.refiner import Refiner
from pipelines.sources.scenes import contact_grid_cache
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.related_scene import relate_scene
from stable_data.scene import Scene
from stable_data.simulation.collision_bodies import bodies_of


@dataclass(frozen=True, slots=True)
class CorrectorTerms:
    """What the corrector is told, the same for all of its parts.

    Attributes:
        weights: Weights of the flow.
        steps: Solver steps; 0 uses those of the weights.
        is_told: Whether it knows the scene graph of the layout; else it infers the relations from the poses.
        settles: Whether MuJoCo tests what stays at rest.
        purpose: Whether layouts are meant as they are.
        error: Expected errors of the layouts.
        keeps_all: Whether a layout in which not all objects fit is infeasible; else some are dropped.
    """

    weights: str = AUTO
    steps: int = 0
    is_told: bool = False
    settles: bool = False
    purpose: Purpose = "repair"
    error: ExpectedError = UNKNOWN_ERROR
    keeps_all: bool = False


class SharedMover:
    """A mover that several methods share: of the same layout, it is asked once, and every method is charged for its time.

    Args:
        mover: The mover; it gives the same result whenever it gets the same scenes.
    """

    def __init__(self, mover: LearnedMover) -> None:
        self._mover = mover
        self._asked: tuple[Sequence[Scene], Sequence[Fixed]] | None = None
        self._moved: list[Scene | None] = []
        self._seconds = 0.0
        self.seconds_saved = 0.0
        """Seconds of a core that the mover was not asked again, in all."""

    def prepare(self, scene: Scene, shapes: Sequence[Shape]) -> None:
        """See :meth:`LearnedMover.prepare`."""
        self._mover.prepare(scene, shapes)

    def __call__(
        self, scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Fixed]
    ) -> list[Scene | None]:
        """Moves the objects of scenes, see :meth:`LearnedMover.__call__`; gives the last result again for the same scenes."""
        if self._asked == (scenes, fixed):
            self.seconds_saved += self._seconds
            return self._moved
        begin = time.process_time()
        self._moved = self._mover(scenes, shapes, fixed)
        self._asked, self._seconds = (scenes, fixed), time.process_time() - begin
        return self._moved


@dataclass(frozen=True, slots=True)
class CorrectorParts:
    """Some parts of the corrector as one method.

    Attributes:
        terms: What it is told.
        flows: Whether the flow moves objects.
        refines: Whether layouts are refined.
        certifies: Whether what is not solved is certified.
        mover: What moves objects in place of the flow; None is the flow.
    """

    terms: CorrectorTerms
    flows: bool = True
    refines: bool = True
    certifies: bool = True
    mover: SharedMover | None = None

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Corrects the layout; returns it unchanged if it is infeasible."""
        terms = self.terms
        flow = self.mover or _flow(terms.weights if self.flows else NONE, terms.steps, terms.error)
        polish: Polish = "certify" if self.certifies else "verify" if self.refines else "off"
        refiner = _refiner(store) if self.refines or not self.certifies else None
        limits = CertifyOptions(when_full="infeasible" if terms.keeps_all else "drop")
        corrector = PhysicsCorrector(flow, limits, judges_raw=False, refiner=refiner, polish=polish, purpose=terms.purpose)
        options = CorrectionOptions(asks_engine=terms.settles and self.certifies)
        self._prepare(flow, corrector, scene, shapes, store)
        audit = audit_layout(scene, shapes)  # a correction needs it only for its figures
        told = scene if terms.is_told else replace(scene, relations=())
        begin = self._now()
        known = scene
        if (flow is not None or self.refines) and not terms.is_told:  # they get the supports of the layout as it is
            posed = PosedScene(scene, shapes)
            known = relate_scene(posed, audit_posed_scene(posed), {}).scene
        requests = corrector.move([replace(known, relations=told.relations)], store, options, [audit])
        if not self.certifies and not self.refines:
            raw = requests[0].raw
            reason = "" if raw is not None else "the new poses are not finite"
            return BaselineResult(raw or scene, raw is not None, self._now() - begin, reason)
        (request,) = corrector.prepare(requests, store)
        done = corrector.certify(request, store)
        seconds = self._now() - begin
        is_clean = done.status in (CorrectionStatus.CERTIFIED, CorrectionStatus.DROPPED)
        prepared = request.prepared
        if not self.certifies and prepared is not None and prepared.refined is not None:
            is_clean = is_clean and prepared.is_solved  # also steady, on its carriers, and in the same order
        return BaselineResult(done.certified or scene, is_clean, seconds, done.reason)

    def _now(self) -> float:
        """Seconds of a core, with those that a shared mover saved."""
        return time.process_time() + (0.0 if self.mover is None else self.mover.seconds_saved)

    def _prepare(
        self,
        flow: SharedMover | LearnedMover | None,
        corrector: PhysicsCorrector,
        scene: Scene,
        shapes: Sequence[Shape],
        store: AssetStore,
    ) -> None:
        """Makes what is made once for each asset: features, grids, convex parts."""
        if flow is not None:
            flow.prepare(scene, shapes)
        if corrector.refiner is not None:
            _refiner(store).has_shapes(scene, shapes)
        if self.terms.settles:
            bodies_of(scene, shapes, store)


@lru_cache(maxsize=2)
def _flow(weights: str, steps: int, error: ExpectedError) -> LearnedMover | None:
    return load_flow(weights, steps, error)


@lru_cache(maxsize=1)
def _refiner(store: AssetStore) -> Refiner:
    return Refiner(store, ContactGrids(contact_grid_cache()))


def corrector_parts(terms: CorrectorTerms = CorrectorTerms()) -> dict[str, Baseline]:
    """Returns the parts of the corrector and their combinations, by name."""
    found: dict[str, Baseline] = {}
    for certifies in (False, True):
        for refines in (False, True):
            for flows in (False, True):
                parts = {"flow": flows, "refine": refines, "certify": certifies}
                if name := " + ".join(part for part, is_used in parts.items() if is_used):
                    found[name] = CorrectorParts(terms, flows, refines, certifies)
    return found
