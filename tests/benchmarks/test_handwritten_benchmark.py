"""The benchmark of handwritten instructions: what it calls right, missing, said and nonsense."""

from dataclasses import replace

from benchmarks.handwritten import summary_of, verdict_of
from models.semantic_reasoner.reasoner import Proposal
from models.semantic_reasoner.replies.checks import ReplyFault
from models.semantic_reasoner.staged_layout import LayoutTask, StagedLayout
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.errors import Notice
from stable_data.metrics.alignment import AlignmentReference
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import Relation, RelationKind, SceneObject, Stage, Tabletop
from tests.models.semantic_reasoner.handwritten import Handwritten, read_handwritten

TABLE = Tabletop("office_table", (1.2, 0.6))
CASE = Handwritten(
    "Take the mug left of the laptop.",
    TABLE,
    AlignmentReference(
        "one", (RequiredObject("0", ("mug",)), RequiredObject("1", ("laptop",))), (Relation("0", RelationKind.LEFT_OF, "1"),)
    ),
    (),
)


def thing(category: str, x: float) -> SceneObject:
    return SceneObject(f"{category}_0", category, (x, 0.3, 0.05), 0.0, (0.1, 0.1, 0.1), stage=Stage.TASK, support="table")


def layout(*objects: SceneObject, proposal: Proposal | None = None) -> StagedLayout:
    reply = LayoutReply((LayoutObject("mug_0", "a mug", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), 0),))
    found = StagedLayout(LayoutTask("one", CASE.instruction, TABLE), objects)
    found.proposals.append((Stage.TASK, proposal or Proposal(reply)))
    return found


def test_right_is_all_there_and_all_held() -> None:
    right, wrong = (verdict_of(CASE, layout(thing("mug", x), thing("laptop", 0.6))) for x in (0.3, 0.9))
    assert right.is_right
    assert not wrong.is_right
    assert not wrong.is_nonsense  # nothing is missing
    assert "broken" in str(wrong)
    assert summary_of([right, wrong])["relations_held"] == 1


def test_what_is_missing_is_nonsense_unless_something_is_said() -> None:
    silent = verdict_of(CASE, layout(thing("mug", 0.3)))
    assert silent.is_nonsense
    assert str(silent).endswith("NONSENSE")
    reply = layout().proposals[0][1].reply
    for code, is_nonsense in (("required_missing", False), ("size_unusual", True)):
        proposal = Proposal(reply, (ReplyFault(code, "look at it", is_hard=False),))
        assert verdict_of(CASE, layout(thing("mug", 0.3), proposal=proposal)).is_nonsense == is_nonsense
    failed = verdict_of(CASE, layout(proposal=Proposal(None, failure="no answer", code="reply_unusable")))
    assert (failed.is_right, failed.is_nonsense) == (False, False)
    assert "no answer" in str(failed)


def test_an_unknown_thing_is_to_be_reported() -> None:
    case = replace(CASE, unknown=("dragon",))
    there = (thing("mug", 0.3), thing("laptop", 0.6))
    silent = verdict_of(case, layout(*there))
    assert silent.is_nonsense
    assert "not reported: dragon" in str(silent)
    told = Proposal(
        layout().proposals[0][1].reply,
        notices=(Notice("instruction", "understand", "word_read_as", "instruction: 'dragon' is unknown, read as figurine"),),
    )
    said = verdict_of(case, layout(*there, proposal=told))
    assert (said.reported, said.falls_back, said.is_nonsense) == (("dragon",), True, False)


def test_the_figures_count_every_case() -> None:
    verdicts = [verdict_of(case, layout()) for case in read_handwritten()]
    found = summary_of(verdicts)
    assert (found["cases"], found["right"], found["objects_there"]) == (40, 0, 0)
    assert found["nonsense"] == 40
    assert found["unknown_things"] == sum(len(case.unknown) for case in read_handwritten())
