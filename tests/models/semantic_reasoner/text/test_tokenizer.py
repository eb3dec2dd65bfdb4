from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from transformers import AutoTokenizer, PreTrainedTokenizerFast

from models.semantic_reasoner.text.prompt import FIXED, ReasonerQuestion, messages, user_message
from models.semantic_reasoner.text.reply_json import LayoutObject, render_objects
from models.semantic_reasoner.text.tokenizer import scaffolding, train_tokenizer
from stable_data.scene import Stage, Tabletop

MUG = LayoutObject("mug_0", "a red mug", (9.0, 8.4, 10.0), (20.0, 130.5, 5.0), -15)
ASK = ReasonerQuestion("Put the red mug on the table.", Tabletop("office_table", (1.2, 0.6)), Stage.IMPORTANT, (MUG,))


@pytest.fixture(scope="module")
def tokenizer() -> PreTrainedTokenizerFast:
    return train_tokenizer([user_message(ASK), render_objects([MUG])] * 4, 400)


def test_fixed_parts_and_scaffolding_are_one_token_each(tokenizer: PreTrainedTokenizerFast) -> None:
    for text in {*FIXED, *scaffolding()}:
        assert len(tokenizer(text)["input_ids"]) == 1, text


def test_an_object_takes_as_many_tokens_as_it_says_things(tokenizer: PreTrainedTokenizerFast) -> None:
    one, two = (len(tokenizer(render_objects([MUG] * n))["input_ids"]) for n in (1, 2))
    # instance, number, three words, the size's opening, six tokens of the size, six of the position, angle, separator
    assert two - one == 1 + 1 + 3 + 1 + 6 + 6 + 1 + 1


@given(text=st.text(max_size=80))
def test_any_text_survives(tokenizer: PreTrainedTokenizerFast, text: str) -> None:
    ids = tokenizer(text, add_special_tokens=False)["input_ids"]
    if not any(mark in text for mark in tokenizer.all_special_tokens):
        assert tokenizer.decode(ids) == text


def test_a_chat_keeps_its_roles(tokenizer: PreTrainedTokenizerFast, tmp_path: Path) -> None:
    tokenizer.save_pretrained(tmp_path)
    again = AutoTokenizer.from_pretrained(tmp_path)
    chat = messages(ASK)
    text = again.apply_chat_template([*chat, {"role": "assistant", "content": "{}"}], tokenize=False)
    assert text == f"<|system|>{chat[0]['content']}<|user|>{chat[1]['content']}<|assistant|>{{}}<|end|>"
    asked = again.apply_chat_template(chat, tokenize=False, add_generation_prompt=True)
    assert text.startswith(asked)
    assert asked.endswith("<|assistant|>")
    assert again(asked)["input_ids"] == tokenizer(asked)["input_ids"]
