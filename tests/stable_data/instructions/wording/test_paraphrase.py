"""The same request in other words."""

import numpy as np

from stable_data.instructions.deriving import KINDS
from stable_data.instructions.wording.paraphrase import SYNONYMS, is_clause, request, reword


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_choices_are_made_from_lists_and_from_synonyms() -> None:
    assert {reword("[a|b] {x}", rng(k)) for k in range(20)} == {"a {x}", "b {x}"}
    assert {reword("[put] it", rng(k)) for k in range(40)} == {f"{w} it" for w in SYNONYMS["put"]}
    assert {reword("[Put] it", rng(k)) for k in range(40)} == {f"{w.capitalize()} it" for w in SYNONYMS["put"]}


def test_every_choice_of_every_text_is_known() -> None:
    for kind in KINDS:
        for text in kind.texts:
            assert "[" not in reword(text, rng()), text


def test_clauses_are_framed_and_sentences_are_not() -> None:
    assert is_clause("put the mug on the book")
    assert not is_clause("The mug is here. Take it.")
    framed = {request("put the mug on the book", "", rng(k)) for k in range(80)}
    assert len(framed) > 10
    assert all("put the mug on the book" in text.lower() for text in framed)
    assert all(text[0].isupper() and text[-1] in ".?" for text in framed)
    assert {request("the mug is here. Take it.", "", rng(k)) for k in range(20)} == {"The mug is here. Take it."}


def test_reasons_fit_the_theme() -> None:
    texts = {request("put the mug on the book", "tidy", rng(k)) for k in range(60)}
    assert any(text.startswith("I am tidying up.") for text in texts)
    assert not any("eat" in text for text in texts)


def test_paraphrases_leave_the_names_of_objects_alone() -> None:
    for kind in KINDS:
        for text in kind.texts:
            roles = sorted(reword(text, rng(1)).split("{")[1:])
            assert sorted(p.split("}")[0] for p in roles) == sorted(p.split("}")[0] for p in text.split("{")[1:])
