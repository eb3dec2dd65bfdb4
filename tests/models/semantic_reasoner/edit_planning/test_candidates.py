"""Which objects a noun may mean; without a reader."""

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reading import MentionedObject
from models.semantic_reasoner.edit_planning.candidates import Candidates, adjectives_of
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.text_encoder import load_default
from stable_data.scene import SceneObject
from tests.models.semantic_reasoner.language.known_categories import STATISTICS

LEXICON = Lexicon.of(read_nouns(), read_nouns().nouns)


def box(instance: str, words: str) -> SceneObject:
    return SceneObject(instance, instance.rpartition("_")[0], (0.5, 0.3, 0.05), 0.0, (0.1, 0.1, 0.1), description=words)


LAYOUT = (
    box("mug_0", "a red mug"),
    box("nesting_cup_0", "nesting cup, size h"),
    box("toy_block_0", "oak cube with the letter h"),
    box("puzzle_cube_0", "a mixed puzzle cube"),
    box("racquetball_0", "racquetball"),
    box("hourglass_0", "an hourglass with sand in a frame"),
)


def meant(words: str, *categories: str) -> set[str]:
    return set(Candidates(LAYOUT, LEXICON).of(MentionedObject(words, categories)))


def test_a_category_that_is_said_comes_before_its_synonyms() -> None:
    assert meant("mug", "mug") == {"mug_0"}


def test_a_category_of_an_unknown_library_is_named_by_its_last_words() -> None:
    assert meant("cup", "mug", "teacup") == {"mug_0", "nesting_cup_0"}


def test_the_usual_name_of_a_category_fits_best() -> None:
    cube = MentionedObject("cube", ("puzzle_cube", "toy_block"))
    found = Candidates(LAYOUT, LEXICON)
    assert found.best(cube, found.of(cube)) == ["puzzle_cube_0"]


def test_an_unknown_noun_is_found_in_descriptions_and_in_compounds() -> None:
    assert meant("plain balls") == {"racquetball_0"}
    assert meant("h letter") == {"toy_block_0"}


def test_an_unknown_noun_is_found_by_its_meaning_only_if_one_object_is_clearly_meant() -> None:
    most_similar = InstructionInterpreter(STATISTICS, load_default()).most_similar
    found = Candidates(LAYOUT, LEXICON, most_similar)
    assert found.of(MentionedObject("sand clock", ())) == ["hourglass_0"]
    assert found.of(MentionedObject("trophy", ())) == []


def test_the_words_of_a_category_are_no_adjectives() -> None:
    assert adjectives_of(MentionedObject("pink lotion bottle", ("lotion_bottle",))) == ["pink"]
