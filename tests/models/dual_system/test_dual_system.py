"""Algorithm 1: stages build on what was corrected, and what cannot be used is asked for again, left out or said."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from models.baselines.placement.problem import Placement
from models.dual_system.algorithm1 import Corrects, LoopSettings, dual_system
from models.dual_system.batching import run_batched
from models.dual_system.generation_state import StageCandidate
from models.dual_system.requests import (
    CorrectionRequest,
    ExchangedAssets,
    ExchangeRequest,
    GenerationResult,
    LanguageAnswer,
    LanguageRequest,
    PlacementRequest,
    ProposalRequest,
    Request,
    RetrievalRequest,
)
from models.physics_corrector.certify import CertifyOptions, CorrectionStatus
from models.physics_corrector.certify.correction import Correction, CorrectionOptions
from models.physics_corrector.corrector import PhysicsCorrector
from models.semantic_reasoner.engines.incremental_batches import Conversation, batch_conversation
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.replies.refused_reply import RefusedReply
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import Wanted
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.assets.assignment import AssignedLayout
from stable_data.assets.retrieval import UnmatchedQuery
from stable_data.errors import ConfigError
from stable_data.scene import Scene, Stage, SupportFrame, Tabletop
from stable_data.simulation.settling import SettleResult
from tests.models.physics_corrector.geometry.shapes import SHAPES, store, thing

TABLE = Tabletop("office_table", (1.0, 0.8))
TASK = LayoutTask("scene", "Lift the cube.", TABLE)

Said = dict[Wanted, Sequence[LayoutObject]]


def said(name: str, x: float, y: float, z: float = 5.0) -> LayoutObject:
    """A thing of 10 cm as a reply names it."""
    return LayoutObject(name, f"a {name.split('_')[0]}", (10.0, 10.0, 10.0), (x, y, z), 0)


@dataclass
class Answers:
    """Answers with what is written down for each stage, the shapes of the same name, and a corrector that certifies."""

    stages: Said | Callable[[ProposalRequest], Proposal]
    corrector: PhysicsCorrector = field(default_factory=PhysicsCorrector)
    asked: list[Request] = field(default_factory=list)
    batches: list[int] = field(default_factory=list)  # of corrections

    def propose(self, questions: Sequence[LanguageRequest]) -> Conversation[LanguageAnswer, LanguageRequest]:
        return batch_conversation(self.proposed, questions)

    def proposed(self, questions: Sequence[LanguageRequest]) -> list[LanguageAnswer]:
        self.asked += questions
        return [self._proposed(q) for q in questions]

    def _proposed(self, q: LanguageRequest) -> Proposal:
        assert isinstance(q, ProposalRequest), "Algorithm 1 does not chat"
        if callable(self.stages):
            return self.stages(q)
        return Proposal(LayoutReply(tuple(self.stages[q.question.wanted])), tries=1)

    def place(self, questions: Sequence[PlacementRequest]) -> list[Placement]:
        raise AssertionError("Algorithm 1 searches for no places")

    def retrieve(self, questions: Sequence[RetrievalRequest]) -> list[AssignedLayout]:
        self.asked += questions
        return [self.furnished(q.scene) for q in questions]

    def exchange(self, questions: Sequence[ExchangeRequest]) -> list[ExchangedAssets]:
        raise AssertionError("Algorithm 1 exchanges no assets")

    def correct(self, questions: Sequence[CorrectionRequest]) -> list[Correction]:
        self.asked += questions
        self.batches.append(len(questions))
        options = [CorrectionOptions(q.fixed) for q in questions]
        return self.corrector.correct([q.scene for q in questions], store(), options)

    def furnished(self, scene: Scene) -> AssignedLayout:
        lost = {o.instance: UnmatchedQuery(f"nothing is like {o.category}") for o in scene.objects if o.category not in SHAPES}
        objects = tuple(
            replace(thing(o.instance, (*o.position, o.yaw), support=o.support), stage=o.stage)
            for o in scene.objects
            if o.instance not in lost
        )
        return AssignedLayout(replace(scene, objects=objects), lost)

    def of(self, kind: type[Request]) -> list[Request]:
        return [r for r in self.asked if isinstance(r, kind)]


def driven(answers: Answers, settings: LoopSettings | None = None, task: LayoutTask = TASK) -> GenerationResult:
    (made,) = run_batched([dual_system(task, 7, settings or LoopSettings())], answers)
    return made


def staged(first: Sequence[LayoutObject], second: Sequence[LayoutObject], third: Sequence[LayoutObject]) -> Said:
    return dict(zip(Stage, (first, second, third), strict=True))


class Restless(Answers):
    """As if the engine left nothing still in the last correction while a thing of an earlier stage is there."""

    def correct(self, questions: Sequence[CorrectionRequest]) -> list[Correction]:
        return [self._told(q, done) for q, done in zip(questions, super().correct(questions), strict=True)]

    def _told(self, q: CorrectionRequest, done: Correction) -> Correction:
        assert done.certified is not None
        if not q.is_last:
            return done
        if "cube_1" in q.fixed:
            nothing = np.zeros((1, 7))
            far = np.full(1, 9.0)
            rest = SettleResult(("cube_1",), nothing[:, :3], nothing[:, 3:], far, far, 0.0, 9e3, 9.0, 0.0, 0.0, stable=False)
            return replace(done, rest=rest)
        left = tuple(o for o in done.certified.objects if o.instance != "cube_1")
        return replace(done, certified=replace(done.certified, objects=left), status=CorrectionStatus.DROPPED)


CROWDED = staged([said("cube_0", 50, 40)], [said("cube_1", 55, 40)], [said("ball_0", 45, 40)])
"""Each stage puts its thing into one that stands there."""


def test_what_nothing_keeps_still_is_left_out_though_it_stood_there_before() -> None:
    answers = Restless(CROWDED)
    made = driven(answers)
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0", "ball_0"]
    assert made.correction is not None
    assert made.correction.rest is None
    assert [len(turn.corrections) for turn in made.turns] == [1, 1, 2]
    assert [bool(r.fixed) for r in answers.of(CorrectionRequest)] == [False, False, False, True]  # type: ignore[union-attr]


def test_the_name_of_a_dropped_object_may_be_used_again() -> None:
    class Drops(Answers):
        """Drops the second cube of the second stage, which was proposed on the first one."""

        def correct(self, questions: Sequence[CorrectionRequest]) -> list[Correction]:
            (done,), (q,) = super().correct(questions), questions
            if q.new != {"cube_1"} or done.certified is None or len(done.certified.objects) != 2:
                return [done]
            left = tuple(o for o in done.certified.objects if o.instance != "cube_1")
            return [replace(done, certified=replace(done.certified, objects=left), status=CorrectionStatus.DROPPED)]

    answers = Drops(
        staged([said("cube_0", 50, 40)], [said("cube_1", 50, 40, 15)], [said("cube_1", 20, 20), said("ball_0", 80, 40)])
    )
    made = driven(answers)
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0", "cube_1", "ball_0"]
    assert made.start.poses()[:, :2].tolist() == [[0.5, 0.4], [0.2, 0.2], [0.8, 0.4]]
    assert not answers.of(CorrectionRequest)[-1].scene.relations  # type: ignore[union-attr]  # the new cube is on the table


def test_each_stage_is_told_what_the_corrector_made_of_those_before() -> None:
    answers = Answers(CROWDED)
    made = driven(answers)
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0", "cube_1", "ball_0"]
    assert [o.stage for o in made.scene.objects] == list(Stage)
    assert made.scene.task is not None
    assert made.scene.task.task_objects == ("cube_0",)
    assert all(turn.corrections[-1].card_after.clean for turn in made.turns)  # type: ignore[union-attr]
    second, third = (r.question.layout for r in answers.of(ProposalRequest)[1:])  # type: ignore[union-attr]
    corrected = made.turns[1].corrections[-1].certified
    assert corrected is not None
    assert len(second) == 1
    told = [o.position_cm for o in third]
    assert told == [tuple(pytest.approx(100 * v, abs=0.051) for v in o.position) for o in corrected.objects]
    assert told != [o.position_cm for o in (*CROWDED[Stage.TASK], *CROWDED[Stage.IMPORTANT])]
    assert [r.is_last for r in answers.of(CorrectionRequest)] == [False, False, True]  # type: ignore[union-attr]
    assert [set(r.new) for r in answers.of(CorrectionRequest)] == [{"cube_0"}, {"cube_1"}, {"ball_0"}]  # type: ignore[union-attr]
    assert made.start.poses()[:, :2].tolist() == [[0.5, 0.4], [0.55, 0.4], [0.45, 0.4]]


@pytest.mark.parametrize("limit", [0.0, 0.001])
def test_earlier_stages_move_only_as_far_as_they_may(limit: float) -> None:
    made = driven(Answers(CROWDED), LoopSettings(earlier_move=limit))
    assert made.scene is not None
    before: dict[str, tuple[float, ...]] = {}
    for turn in made.turns:
        now = turn.corrections[-1].certified
        assert now is not None
        for o in now.objects:
            if o.instance in before:
                assert o.position == pytest.approx(before[o.instance], abs=limit)
            before[o.instance] = o.position
    assert [len(turn.corrections) for turn in made.turns] == ([1, 1, 1] if limit == 0 else [1, 2, 2])


@pytest.mark.parametrize(("limit", "held"), [(0.0, {"cube_0", "cube_1"}), (float("inf"), set[str]())])
def test_a_closing_correction_moves_what_is_there_only_as_far_as_it_may(limit: float, held: set[str]) -> None:
    """The last stage has no answer, so what is there is corrected once more, for the engine to be asked of it."""

    def stages(request: ProposalRequest) -> Proposal:
        if request.question.wanted is Stage.SECONDARY:
            return Proposal(None, failure="no reply can be used", code="reply_unusable")
        return Proposal(LayoutReply(tuple(CROWDED[request.question.wanted])), tries=1)

    answers = Answers(stages)
    made = driven(answers, LoopSettings(earlier_move=limit))
    assert made.scene is not None
    last = answers.of(CorrectionRequest)[-1]
    assert isinstance(last, CorrectionRequest)
    assert last.is_last
    assert last.fixed == held


@pytest.mark.parametrize("corrects", ["each", "end"])
def test_what_was_left_out_is_told_whenever_it_was(corrects: Corrects) -> None:
    small = LayoutTask("scene", "Lift the cube.", Tabletop("nightstand", (0.11, 0.11)))
    stages = staged([said("cube_0", 5.5, 5.5)], [said("cube_1", 5.5, 5.5)], [])
    made = driven(Answers(stages), LoopSettings(corrects=corrects, tries=1), small)
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0"]
    assert [d.instance for d in made.dropped] == ["cube_1"]


def test_what_finds_no_place_is_asked_for_again_and_then_left_out() -> None:
    small = LayoutTask("scene", "Lift the cube.", Tabletop("nightstand", (0.11, 0.11)))
    stages = staged([said("cube_0", 5.5, 5.5)], [said("cube_1", 5.5, 5.5)], [])
    answers = Answers(stages, PhysicsCorrector(options=CertifyOptions(when_full="infeasible")))
    made = driven(answers, LoopSettings(tries=2), small)
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0"]
    assert [(str(t.wanted), t.code) for t in made.turns] == [
        ("task", ""),
        ("important", "infeasible"),
        ("important", "infeasible"),
        ("secondary", ""),
    ]
    assert [n.code for n in made.warnings] == ["stage_left_out"]


@pytest.mark.parametrize(("bad", "used"), [(1, 1), (2, 2), (9, 2)], ids=["once", "twice", "always"])
def test_a_start_in_which_nothing_is_left_to_do_is_proposed_again(bad: int, used: int) -> None:
    """The goal holds where the first ``bad`` proposals put the cube."""

    def stages(request: ProposalRequest) -> Proposal:
        things = {
            Stage.TASK: [said("cube_0", 20 + 20 * len(seen), 40)],
            Stage.IMPORTANT: [said("ball_0", 50, 20)],
            Stage.SECONDARY: [],
        }
        return Proposal(LayoutReply(tuple(things[request.question.wanted])), tries=1)  # type: ignore[index]

    def is_done(scene: Scene) -> bool:
        seen.append(scene)
        return len(seen) <= bad

    seen: list[Scene] = []
    (made,) = run_batched([dual_system(TASK, 7, LoopSettings(tries=3), is_done=is_done)], Answers(stages))
    assert made.scene is not None
    assert made.scene["cube_0"].position[0] == pytest.approx(0.2 + 0.2 * used)
    assert [len(scene.objects) for scene in seen] == [1] * (used + 1)  # later stages are not looked at
    codes = [turn.code for turn in made.turns if turn.wanted is Stage.TASK]
    assert codes == ["goal_true_at_start"] * used + [""]
    assert [n.code for n in made.warnings] == (["goal_true_at_start"] if bad > 3 else [])


def test_a_relation_that_is_missing_counts_more_than_a_goal_that_holds() -> None:
    scene = Scene("scene", TABLE, ())
    done, missing = (StageCandidate(scene, (), {}, (), num, is_done=is_done) for num, is_done in ((0, True), (1, False)))
    assert done.num_faults < missing.num_faults
    assert StageCandidate(scene, (), {}, (), 0).num_faults < done.num_faults


def test_a_task_object_without_an_asset_is_a_failure_that_says_so() -> None:
    answers = Answers(staged([said("cube_0", 50, 40), said("elephant_0", 20, 20)], [], []))
    made = driven(answers, LoopSettings(tries=2))
    assert made.scene is None
    assert made.failure is not None
    assert made.failure.code == "asset_unmatched"
    assert "elephant_0; nothing is like elephant" in made.failure.message
    seeds = [r.seed for r in answers.of(ProposalRequest)]  # type: ignore[union-attr]
    assert len(set(seeds)) == len(seeds) == 2


def test_a_whole_layout_without_one_of_its_assets_is_used_if_no_try_is_better() -> None:
    lacking = [said("cube_0", 50, 40), said("elephant_0", 20, 20)]
    answers = Answers({"whole": lacking})
    task = LayoutTask("scene", "Tidy up.", TABLE)  # names nothing: all objects are task objects
    made = driven(answers, LoopSettings(("whole",), corrects="never", tries=2), task)
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0"]
    assert [turn.code for turn in made.turns] == ["asset_unmatched", ""]  # the last one is used
    assert made.turns[-1].assigned is not None
    assert set(made.turns[-1].assigned.unmatched) == {"elephant_0"}
    assert len(answers.of(ProposalRequest)) == 2


def test_a_stage_that_has_no_answer_costs_no_more_than_itself() -> None:
    def stages(request: ProposalRequest) -> Proposal:
        if request.question.wanted is Stage.IMPORTANT:
            return Proposal(None, failure="the endpoint is down", code="endpoint_down")
        name = "cube_0" if request.question.wanted is Stage.TASK else "ball_0"
        return Proposal(LayoutReply((said(name, 20 if name == "cube_0" else 70, 40),)))

    made = driven(Answers(stages))
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["cube_0", "ball_0"]
    assert [n.code for n in made.warnings] == ["stage_left_out"]
    nothing = driven(Answers(lambda request: Proposal(None, failure="the endpoint is down", code="endpoint_down")))
    assert nothing.failure is not None
    assert nothing.failure.code == "endpoint_down"
    assert len(nothing.turns) == 1


@pytest.mark.parametrize(("corrects", "count"), [("each", 3), ("end", 1), ("never", 0)])
def test_the_corrector_is_asked_when_the_settings_say(corrects: str, count: int) -> None:
    answers = Answers(CROWDED)
    made = driven(answers, LoopSettings(corrects=corrects))  # type: ignore[arg-type]
    assert len(answers.of(CorrectionRequest)) == count
    assert made.scene is not None
    assert len(made.scene.objects) == 3
    assert (made.scene.poses() == made.start.poses()).all() == (corrects == "never")


def test_a_full_table_ends_the_schedule() -> None:
    answers = Answers(CROWDED)
    made = driven(answers, LoopSettings(full=0.02))
    assert made.scene is not None
    assert len(made.scene.objects) == 2
    assert [n.code for n in made.warnings] == ["table_full"]
    assert [r.is_last for r in answers.of(CorrectionRequest)] == [False, True]  # type: ignore[union-attr]


def test_one_shot_is_one_stage() -> None:
    answers = Answers({"whole": [said("cube_0", 50, 40), said("ball_0", 52, 40)]})
    made = driven(answers, LoopSettings(schedule=("whole",)))
    assert made.scene is not None
    assert [o.stage for o in made.scene.objects] == [Stage.TASK, Stage.IMPORTANT]
    assert [r.is_last for r in answers.of(CorrectionRequest)] == [True]  # type: ignore[union-attr]
    assert [set(r.new) for r in answers.of(CorrectionRequest)] == [{o.instance for o in made.start.objects}]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "wrong", [{"schedule": ()}, {"schedule": (Stage.IMPORTANT,)}, {"schedule": ("edit",)}, {"tries": 0}, {"full": 0.0}]
)
def test_settings_that_no_loop_can_follow_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        LoopSettings(**wrong)  # type: ignore[arg-type]


def test_scenes_side_by_side_are_what_they_are_alone() -> None:
    tasks = [replace(TASK, scene_id=f"scene_{k}") for k in range(3)]
    settings = [LoopSettings(), LoopSettings(earlier_move=0.001), LoopSettings(corrects="end")]
    loops = [dual_system(task, k, own) for k, (task, own) in enumerate(zip(tasks, settings, strict=True))]
    answers = Answers(CROWDED)
    side_by_side = run_batched(loops, answers)
    assert answers.batches == [2, 2, 1, 3, 1]  # the one that corrects at the end meets the last stage of the others
    for k, (task, own) in enumerate(zip(tasks, settings, strict=True)):
        assert side_by_side[k].scene == driven(Answers(CROWDED), own, task).scene


def holding(name: str, instruction: str) -> GenerationResult:
    """A scene whose instruction takes a thing out of a bowl."""
    inside = replace(said(name, 50, 40, 9.0), size_cm=(10.0, 10.0, 10.0))
    bowl = LayoutObject("bowl_0", "a bowl", (16.0, 16.0, 8.0), (50.0, 40.0, 4.0), 0)
    answers = Answers(staged([bowl, inside], [], []))
    task = LayoutTask("scene", instruction, TABLE)
    interpret = InstructionInterpreter(CategoryStatistics.of_names(["ball", "bowl", "plate"]))
    (made,) = run_batched([dual_system(task, 7, LoopSettings(tries=3), interpret)], answers)
    assert made.scene is not None
    assert [str(r.kind) for r in made.scene.task.relations] == ["in"]  # type: ignore[union-attr]
    return made


def test_what_the_instruction_says_is_held_on_to() -> None:
    made = holding("ball_0", "Take the ball out of the bowl.")
    assert [turn.code for turn in made.turns if turn.wanted is Stage.TASK] == [""]
    assert made.correction is not None
    assert made.correction.kept is not None
    assert made.correction.kept.asked_missing == ()


def test_what_cannot_be_where_the_instruction_says_is_asked_for_again_and_at_last_taken() -> None:
    made = holding("plate_0", "Take the plate out of the bowl.")
    assert [turn.code for turn in made.turns if turn.wanted is Stage.TASK] == ["relation_lost", "relation_lost", ""]
    assert made.correction is not None
    assert made.correction.kept is not None
    assert [r.subject for r in made.correction.kept.asked_missing] == ["plate_0"]


IN_THE_BOWL = (
    LayoutObject("bowl_0", "a bowl", (16.0, 16.0, 8.0), (50.0, 40.0, 4.0), 0),
    replace(said("plate_0", 50, 40, 9.0), size_cm=(10.0, 10.0, 10.0)),  # has no room in it
)


@pytest.mark.parametrize(
    "last",
    [
        Proposal(None, failure="4 answers could not be used", code="reply_unusable", refused=(RefusedReply("x", ()),)),
        Proposal(None, failure="the question timed out", code="timeout"),
        Proposal(LayoutReply((said("elephant_0", 20, 20),)), tries=1),
    ],
    ids=["reply_unusable", "timeout", "asset_unmatched"],
)
def test_an_earlier_try_counts_where_the_last_one_fails(last: Proposal) -> None:
    replies = iter([Proposal(LayoutReply(IN_THE_BOWL), tries=1), last])

    def stages(question: ProposalRequest) -> Proposal:
        return next(replies) if question.question.wanted is Stage.TASK else Proposal(LayoutReply(()), tries=1)

    task = LayoutTask("scene", "Take the plate out of the bowl.", TABLE)
    loop = dual_system(
        task,
        7,
        LoopSettings(tries=2),
        InstructionInterpreter(CategoryStatistics.of_names(["ball", "bowl", "plate", "elephant"])),
    )
    (made,) = run_batched([loop], Answers(stages))
    assert made.failure is None
    assert made.scene is not None
    assert [o.instance for o in made.scene.objects] == ["bowl_0", "plate_0"]
    assert [o.instance for o in made.start.objects] == ["bowl_0", "plate_0"]
    assert [bool(turn.rejected) for turn in made.turns[:2]] == [False, True]
    assert made.correction is not None
    assert made.correction.card_after is not None
    assert made.correction.card_after.clean


def test_of_tries_that_lack_something_the_one_counts_that_lacks_least() -> None:
    corner = tuple(replace(o, position_cm=(20.0, 15.0, o.position_cm[2])) for o in IN_THE_BOWL)
    replies = iter([Proposal(LayoutReply(corner), tries=1), Proposal(LayoutReply(IN_THE_BOWL), tries=1)])

    def stages(question: ProposalRequest) -> Proposal:
        return next(replies) if question.question.wanted is Stage.TASK else Proposal(LayoutReply(()), tries=1)

    task = LayoutTask("scene", "Take the plate out of the bowl that is in the front left corner.", TABLE)
    loop = dual_system(
        task, 7, LoopSettings(tries=2), InstructionInterpreter(CategoryStatistics.of_names(["ball", "bowl", "plate"]))
    )
    (made,) = run_batched([loop], Answers(stages))
    assert made.scene is not None
    assert [turn.code for turn in made.turns[:2]] == ["", "relation_lost"]
    assert made.scene["bowl_0"].position[0] < 0.3


def test_what_is_pushed_out_of_its_corner_is_asked_for_again() -> None:
    pushing = staged([said("cube_0", 33, 20)], [said("ball_0", 28, 20)], [])
    task = LayoutTask("scene", "Lift the cube that is in the front left corner.", TABLE)
    loop = dual_system(task, 7, LoopSettings(tries=2), InstructionInterpreter(CategoryStatistics.of_names(["ball", "cube"])))
    (made,) = run_batched([loop], Answers(pushing))
    assert [(str(turn.wanted), turn.code) for turn in made.turns] == [
        ("task", ""),
        ("important", "relation_lost"),
        ("important", ""),
        ("secondary", ""),
    ]


def test_an_open_schedule_adds_background_until_the_density() -> None:
    """Each background stage of each round puts one more cube of 10 cm on a table of 1 m × 0.8 m."""
    places = iter(range(100))

    def more(q: ProposalRequest) -> Proposal:
        n = next(places)
        return Proposal(LayoutReply((said(f"cube_{n}", 10 + 12 * (n % 7), 10 + 12 * (n // 7)),)), tries=1)

    made = driven(Answers(more), LoopSettings(density=0.1))
    assert made.scene is not None
    assert len(made.scene.objects) == 8  # the first with a share of at least 0.1
    assert [turn.wanted for turn in made.turns] == [*Stage, *[Stage.IMPORTANT, Stage.SECONDARY] * 2, Stage.IMPORTANT]
    assert made.correction is not None


def test_rounds_of_an_open_schedule_have_other_seeds() -> None:
    names = iter(range(100))

    def one(q: ProposalRequest) -> Proposal:
        n = next(names)
        objects = (said(f"cube_{n}", 10 + 12 * n, 40),) if n < 6 else ()
        return Proposal(LayoutReply(objects), tries=1)

    answers = Answers(one)
    driven(answers, LoopSettings(density=0.9))
    seeds = [r.seed for r in answers.asked if isinstance(r, ProposalRequest) and r.question.wanted is Stage.IMPORTANT]
    assert len(seeds) > 1
    assert len(set(seeds)) == len(seeds)


def test_an_open_schedule_ends_when_a_round_adds_nothing() -> None:
    answers = Answers(staged([said("cube_0", 50, 40)], [], []))
    made = driven(answers, LoopSettings(density=0.9))
    assert made.scene is not None
    assert [turn.wanted for turn in made.turns] == [*Stage, Stage.IMPORTANT, Stage.SECONDARY]


@pytest.mark.parametrize("density", [-0.1, 1.1])
def test_an_impossible_density_is_refused(density: float) -> None:
    with pytest.raises(ConfigError, match="density"):
        LoopSettings(density=density)
    with pytest.raises(ConfigError, match="density"):
        LoopSettings((Stage.TASK,), density=0.5)


def test_the_surroundings_are_obstacles_that_nobody_names_or_moves() -> None:
    wall = replace(thing("cube_9", (0.5, 0.4, 0.05, 0.0)), instance="fixed_wall_0", category="wall", stage=None)
    frame = SupportFrame("shelf_0", "top", (0.0, 0.0, 1.0), 0.2, "shelf")
    task = replace(TASK, surroundings=(wall,), frame=frame)
    answers = Answers(CROWDED)
    made = driven(answers, task=task)
    assert made.scene is not None
    assert made.scene.fixed == frozenset({"fixed_wall_0"})
    assert made.scene.frame == frame
    assert made.scene["fixed_wall_0"] == wall
    assert {o.instance for o in made.scene.movable} == {"cube_0", "cube_1", "ball_0"}
    # They were proposed where the wall is, and had to leave.
    assert made.correction is not None
    assert made.correction.audit is not None
    assert made.correction.audit.card().clean is True
    for request in answers.asked:
        if isinstance(request, ProposalRequest):
            assert "fixed_wall_0" not in {o.instance for o in request.question.layout}
            assert request.question.table.restricted_zone == pytest.approx((0.45, 0.55, 0.35, 0.45))
        elif isinstance(request, RetrievalRequest):
            assert "fixed_wall_0" not in {o.instance for o in request.scene.objects}
    assert not [r for r in made.scene.relations if "fixed_wall_0" in (r.subject, r.target)]


def test_a_task_whose_first_stage_fails_has_no_scene_of_surroundings_alone() -> None:
    wall = replace(thing("cube_9", (0.5, 0.4, 0.05, 0.0)), instance="fixed_wall_0")
    made = driven(Answers(staged([], [], [])), task=replace(TASK, surroundings=(wall,)))
    assert made.scene is None
    assert made.failure is not None
    assert made.failure.code == "layout_empty"
