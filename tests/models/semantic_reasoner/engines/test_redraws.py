"""The place of a refused object is drawn again while the rest of the reply is kept."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from transformers import PreTrainedTokenizerFast, Qwen3ForCausalLM

from models.semantic_reasoner.engines.local_engine import LocalEngine
from models.semantic_reasoner.engines.protocol import Request, Sampling
from models.semantic_reasoner.engines.token_sampling import TokenSampler
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.prompt import ReasonerQuestion, messages, user_message
from models.semantic_reasoner.text.reply_json import LayoutObject, parse_beginning, parse_reply, render_objects
from models.semantic_reasoner.text.tokenizer import train_tokenizer
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.settings import LanguageModelSettings
from stable_data.scene import Stage, Tabletop

TINY = LanguageModelSettings(hidden=32, layers=2, heads=4, key_value_heads=2, head=8, intermediate=64, vocabulary=300)
TABLE = Tabletop("office_table", (1.12, 0.593))
MUG = LayoutObject("mug_0", "a red mug", (9.0, 8.4, 10.0), (20.0, 30.5, 5.0), -15)
ASK = ReasonerQuestion("Put the red mug on the table.", TABLE, Stage.TASK)


@pytest.fixture(scope="module")
def tokenizer() -> PreTrainedTokenizerFast:
    return train_tokenizer([user_message(ASK), render_objects([MUG, MUG])] * 4, 300)


@pytest.fixture(scope="module")
def network(tokenizer: PreTrainedTokenizerFast) -> Qwen3ForCausalLM:
    return new_network(TINY, tokenizer, 1024, seed=3).eval()


class Brief(LocalEngine):
    """A model that knows nothing, but that descriptions are short."""

    def _draw(self, logits: torch.Tensor, active: list) -> list[int]:  # type: ignore[type-arg]
        logits = logits.clone()
        logits[:, self._tokenizer.convert_tokens_to_ids('","size":[')] += 9
        return super()._draw(logits, active)


def replies(engine: LocalEngine, refuses: object, count: int = 12) -> list[tuple[LayoutObject, ...]]:
    form = ReplyGrammar.of_table(TABLE, at_least=2, at_most=3)
    asked = [Request(tuple(messages(ASK)), form, seed, refuses) for seed in range(count)]  # type: ignore[arg-type]
    return [parse_reply(c.text).objects if not c.code else () for c in engine.complete(asked)]


def is_left(objects: Sequence[LayoutObject]) -> bool:
    return objects[-1].position_cm[0] < 40


@pytest.mark.parametrize("temperature", [0.7, 0.0])
def test_a_refused_place_becomes_another_one(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast, temperature: float
) -> None:
    sampling = Sampling(temperature, max_tokens=500, redraws=40)
    engine = Brief(network, tokenizer, "tiny", sampling)
    free = replies(engine, None)
    limit = 1 + float(np.median([o.position_cm[0] for objects in free for o in objects]))
    bound = replies(engine, lambda objects: objects[-1].position_cm[0] < limit)
    assert any(bound)
    assert all(o.position_cm[0] >= limit for objects in bound for o in objects)
    for one, other in zip(free, bound, strict=True):
        if one and other:  # until the first refusal all is the same, then all but the place
            assert (one[0].instance, one[0].description, one[0].size_cm) == (
                other[0].instance,
                other[0].description,
                other[0].size_cm,
            )


def test_replies_do_not_depend_on_their_batch(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    sampling = Sampling(max_tokens=500)
    alone, among = (replies(Brief(network, tokenizer, "tiny", sampling, num_slots=n), is_left) for n in (1, 5))
    assert alone == among


def test_what_is_always_refused_is_kept_in_the_end(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    judged: list[int] = []

    def always(objects: Sequence[LayoutObject]) -> bool:
        judged.append(len(objects))
        return True

    (found,) = replies(Brief(network, tokenizer, "tiny", Sampling(max_tokens=900, redraws=3)), always, 1)
    assert judged == [number for number in range(1, len(found) + 1) for _ in range(3)]
    assert len(found) >= 2
    none = replies(Brief(network, tokenizer, "tiny", Sampling(max_tokens=500, redraws=0)), always)
    assert none == replies(Brief(network, tokenizer, "tiny", Sampling(max_tokens=500)), None)


def test_the_beginning_of_a_reply_has_its_complete_objects() -> None:
    pair = [MUG, replace(MUG, instance="mug_1")]
    whole = render_objects(pair)
    found = [len(parse_beginning(whole[:n])) for n in range(len(whole) + 1)]
    first = whole.index("},") + 1
    assert found == [0] * first + [1] * (len(whole) - 2 - first) + [2] * 3
    assert parse_beginning(whole) == tuple(pair)
    assert parse_beginning(whole.replace("a red mug", "a } mug")[:50]) == ()
    assert parse_beginning("") == ()


def test_each_redraw_is_hotter() -> None:
    sampler = TokenSampler(Sampling(), np.zeros(4, bool))
    logits = torch.tensor([[5.0, 3.0, 1.0, 0.0]])
    draw = np.random.default_rng(0)
    shares = [
        np.bincount(
            [
                token
                for _ in range(400)
                for token in sampler.draw(logits, None, draw.random(1), np.full(1, np.nan), np.full(1, number))
            ],
            minlength=4,
        )
        for number in (0, 1, 8)
    ]
    assert shares[0][0] == 400  # top_p leaves the likeliest one
    assert shares[0][0] > shares[1][0] > shares[2][0]
    assert shares[2][3] > 40
