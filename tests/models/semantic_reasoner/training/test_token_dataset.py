from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.training.batch_sampler import (
    IGNORED,
    batch_of,
    batches_in_order,
    batches_of_pass,
    padding_of,
    rows_of,
)
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings, StageShares
from models.semantic_reasoner.training.token_dataset import KINDS, TokenDataset, read_tokens, tokenize_examples, write_tokens
from stable_data.scene import Stage
from tests.models.semantic_reasoner.training.reasoner_examples import PACKED, TABLE, TINY, examples, token_set, tokenizer

DATA = token_set(24)


def flat(batches: list[list[list[int]]]) -> list[int]:
    return [k for rows in batches for row in rows for k in row]


def test_the_tokens_are_the_chat_and_the_reply_that_ends_it() -> None:
    for k, example in enumerate(examples(24)):
        words, num_prompt = DATA.of(k)
        chat = [*example.prompt, {"role": "assistant", "content": example.answer}]
        words_of: Any = tokenizer()
        asked = words_of.apply_chat_template(example.prompt, add_generation_prompt=True, return_dict=True)["input_ids"]
        whole = words_of.apply_chat_template(chat, return_dict=True)["input_ids"]
        assert words.tolist() == whole
        assert words[:num_prompt].tolist() == asked
        assert tokenizer().decode(words[num_prompt:]) == example.answer + str(tokenizer().eos_token)
        assert KINDS[DATA.kind[k]] is example.question.wanted


def test_what_is_too_long_or_cannot_be_asked_is_left_out_and_counted() -> None:
    longest = int(DATA.length.max())
    asked = [replace(e, question=replace(e.question, instruction="")) if n == 0 else e for n, e in enumerate(examples(24))]
    found = tokenize_examples(asked, tokenizer(), longest - 1)
    assert int(found.too_long.sum()) == int((DATA.length == longest).sum()) > 0
    assert found.unasked.tolist() == [1, 0, 0, 0, 0]
    assert len(found) + int(found.too_long.sum()) + 1 == 24
    assert int(found.length.max()) < longest


def test_what_was_kept_is_what_was_made(tmp_path: Path) -> None:
    kept = write_tokens(tmp_path / "set", examples(24), tokenizer(), TINY.max_tokens)
    again = read_tokens(tmp_path / "set")
    assert again is not None
    for found in (kept, again):
        assert isinstance(found.tokens, np.memmap)
        for name in ("tokens", "start", "reply", "kind", "too_long", "unasked"):
            assert np.array_equal(getattr(found, name), getattr(DATA, name)), name
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_part_of_a_set_is_none(tmp_path: Path) -> None:
    assert read_tokens(tmp_path / "set") is None
    write_tokens(tmp_path / "set", examples(4), tokenizer(), TINY.max_tokens)
    tokens = (tmp_path / "set" / "tokens.bin").read_bytes()
    (tmp_path / "set" / "tokens.bin").write_bytes(tokens[:-4])
    assert read_tokens(tmp_path / "set") is None
    (tmp_path / "set" / "index.npz").write_bytes(b"PK")
    assert read_tokens(tmp_path / "set") is None
    assert len(write_tokens(tmp_path / "set", examples(4), tokenizer(), TINY.max_tokens)) == 4


def test_there_may_be_no_example(tmp_path: Path) -> None:
    found = write_tokens(tmp_path / "set", [], tokenizer(), TINY.max_tokens)
    assert len(found) == len(found.tokens) == 0
    assert batches_of_pass(found, TINY, 0) == []
    assert padding_of(found, []) == 0.0


def test_targets_are_the_reply_shifted_by_one_and_nothing_else() -> None:
    batch = batch_of(DATA, [[0, 3], [1]], pad=0)
    at = 0
    for example in (0, 3):
        words, num_prompt = DATA.of(example)
        row = batch.target[0, at : at + len(words)]
        assert row[num_prompt - 1 : -1].tolist() == words[num_prompt:].tolist()
        assert (row[: num_prompt - 1] == IGNORED).all()
        assert row[-1] == IGNORED
        assert batch.position[0, at : at + len(words)].tolist() == list(range(len(words)))
        at += len(words)
    assert (batch.target >= 0).sum() == DATA.reply_length[[0, 1, 3]].sum()


@pytest.mark.parametrize("settings", [TINY, PACKED, replace(TINY, rows_per_batch=2)])
def test_a_pass_has_every_example_once_within_the_bounds(settings: ReasonerTrainingSettings) -> None:
    batches = batches_of_pass(DATA, settings, 0)
    assert sorted(flat(batches)) == list(range(24))
    for rows in batches:
        widths = [int(DATA.length[row].sum()) for row in rows]
        assert max(widths) <= settings.max_tokens
        assert len(rows) == 1 or len(rows) * max(widths) <= settings.tokens_per_batch
        assert not settings.rows_per_batch or len(rows) <= settings.rows_per_batch
    assert flat(batches) != flat(batches_of_pass(DATA, settings, 1))
    assert batches == batches_of_pass(DATA, settings, 0)


def test_shares_leave_out_so_many_of_a_kind_and_others_each_time() -> None:
    settings = replace(TINY, shares=StageShares(task=0.5, secondary=0.0))
    passes = [flat(batches_of_pass(DATA, settings, number)) for number in range(6)]
    for one in passes:
        kinds = np.bincount(DATA.kind[one], minlength=len(KINDS))
        assert kinds.tolist() == [4, 8, 0, 0, 0]
    assert len({k for one in passes for k in one if KINDS[DATA.kind[k]] is Stage.TASK}) > 4


@given(st.lists(st.integers(1, 100), max_size=60))
def test_packed_rows_hold_all_and_waste_little(lengths: list[int]) -> None:
    array = np.array(lengths, np.int64)
    rows = rows_of(array, 100, packs=True)
    assert sorted(k for row in rows for k in row) == list(range(len(lengths)))
    assert all(array[row].sum() <= 100 for row in rows)
    filled = [int(array[row].sum()) for row in rows]
    assert len(rows) <= 1 or sum(filled) > 50 * (len(rows) - 1)  # two rows that are half empty would have been one


def test_for_evaluation_each_example_has_a_row() -> None:
    batches = batches_in_order(DATA, np.arange(2, 9), PACKED)
    assert sorted(flat(batches)) == list(range(2, 9))
    assert all(len(row) == 1 for rows in batches for row in rows)


def test_padding_is_counted() -> None:
    data = TokenDataset(np.zeros(6, np.int32), *(np.array(v) for v in ([0, 2, 6], [1, 3], [0, 0], [0], [0])))
    assert padding_of(data, [[[0], [1]]]) == pytest.approx(2 / 8)
    assert padding_of(data, [[[0, 1]]]) == 0.0


def test_an_ask_that_is_a_novel_is_not_asked() -> None:
    example = replace(examples(1)[0], question=ReasonerQuestion("word " * 1000, TABLE, Stage.TASK))
    assert tokenize_examples([example], tokenizer(), TINY.max_tokens).unasked.sum() == 1
