"""A post-hoc optimiser in the place of the corrector: the audit judges it, and what it says of itself stands beside that."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest

from models.baselines.methods import METHODS
from models.baselines.outcome import BaselineResult
from models.baselines.post_processing import PostProcessor
from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.certify.correction import Correction, CorrectionOptions, KnownShapes, SolvedBy
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene, SceneObject
from tests.models.baselines.test_methods import two_cubes
from tests.models.physics_corrector.geometry.shapes import SIDE, scene, store, thing

ANYTHING = CorrectionOptions()
FIXED_CAPABLE = ("steerable", "steerable_parts", "mesatask")


def corrected(given: Scene, name: str = "steerable", options: CorrectionOptions = ANYTHING) -> Correction:
    processor = PostProcessor.named(name)
    (request,) = processor.prepare(processor.move([given], store(), [options]), store())
    return processor.certify(request, store())


@pytest.mark.parametrize("name", FIXED_CAPABLE)
def test_a_layout_is_separated_audited_and_measured(name: str) -> None:
    done = corrected(two_cubes(), name)
    assert (done.status, done.reason, done.unsolved) == (CorrectionStatus.CERTIFIED, "", "")
    assert done.solved_by is SolvedBy.POST_PROCESSING
    assert done.card_before is not None
    assert done.card_after is not None
    assert (done.card_before.num_collisions, done.card_after.num_collisions, done.card_after.clean) == (1, 0, True)
    assert done.card_after.move_max_mm is not None
    assert done.card_after.move_max_mm > 1
    assert (done.raw, done.dropped) == (None, ())


def test_a_result_that_is_solved_by_its_own_measure_can_be_refused_by_the_audit() -> None:
    """The projection knows no edge of the table: it pushes a cube over it and is content."""
    z = SIDE / 2 + 1e-4
    done = corrected(scene(thing("cube_0", (0.052, 0.4, z, 0.0)), thing("cube_1", (0.122, 0.4, z, 0.0))))
    assert done.unsolved == ""
    assert done.status is CorrectionStatus.UNCLEAN
    assert "cube_0 is off its area" in done.reason
    assert done.solved_by is None
    assert done.certified is not None


@dataclass(frozen=True)
class Idle:
    """An optimiser that does nothing and says so, or not."""

    reason: str

    def correct(self, given: Scene, shapes: Sequence[Shape], assets: AssetStore) -> BaselineResult:
        return BaselineResult(given, not self.reason, 0.0, self.reason)


def test_a_result_that_is_unsolved_by_its_own_measure_can_be_clean() -> None:
    cube = scene(thing("cube_0", (0.4, 0.4, SIDE / 2 + 1e-4, 0.0)))
    processor = PostProcessor(Idle("still moving after 3 iterations"))
    done = processor.certify(processor.move([cube], store(), [CorrectionOptions()])[0], store())
    assert (done.status, done.solved_by) == (CorrectionStatus.CERTIFIED, SolvedBy.START)
    assert done.unsolved == "still moving after 3 iterations"


def test_a_missing_mesh_makes_the_verdict_unknown() -> None:
    gone = SceneObject("gone_0", "gone", (0.8, 0.6, SIDE / 2), 0.0, (SIDE, SIDE, SIDE), "nowhere", (1.0, 1.0, 1.0))
    done = corrected(scene(*two_cubes().objects, gone))
    assert done.status is CorrectionStatus.UNKNOWN
    assert done.solved_by is None


@pytest.mark.parametrize("name", FIXED_CAPABLE)
@pytest.mark.parametrize("as_option", [True, False])
def test_what_is_fixed_stays_and_the_others_make_room(name: str, as_option: bool) -> None:
    start = two_cubes()
    held = frozenset({"cube_0"})
    given = start if as_option else replace(start, fixed=held)
    done = corrected(given, name, CorrectionOptions(fixed=held if as_option else frozenset()))
    assert done.certified is not None
    assert done.certified["cube_0"].position == start["cube_0"].position
    assert done.certified["cube_1"].position != start["cube_1"].position
    assert done.certified.fixed == given.fixed
    assert done.audit is not None
    assert done.audit.card().num_collisions == 0


def test_it_needs_the_meshes() -> None:
    given, shapes, _ = store().resolved(two_cubes())
    known = KnownShapes({o.instance: shape for o, shape in zip(given.objects, shapes, strict=True)})
    processor = PostProcessor.named("mesatask")
    with pytest.raises(ConfigError, match="AssetStore"):
        processor.certify(processor.move([given], known, [CorrectionOptions()])[0], known)


def test_every_corrector_name_is_a_method() -> None:
    from typing import get_args

    from models.baselines.systems import CorrectorName

    assert set(get_args(CorrectorName)) - {"stable"} <= set(METHODS)
