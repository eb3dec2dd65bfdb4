import gc
import json
import math
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import ref

import pytest
import torch
from numpy.random import default_rng
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast, Qwen3ForCausalLM

from models.semantic_reasoner.engines.batched_decoding import ATTENTION, Decoder
from models.semantic_reasoner.engines.local_engine import LocalEngine, _Sequence
from models.semantic_reasoner.engines.protocol import Completion, Request, Sampling
from models.semantic_reasoner.engines.qwen3_step import Qwen3Step
from models.semantic_reasoner.engines.vllm_engine import VllmEngine
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.text.prompt import ReasonerQuestion, messages, user_message
from models.semantic_reasoner.text.reply_json import LayoutObject, parse_reply, render_objects
from models.semantic_reasoner.text.tokenizer import train_tokenizer
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.settings import LanguageModelSettings
from stable_data.errors import ConfigError
from stable_data.metrics.matching import RequiredObject, unmatched
from stable_data.scene import Stage, Tabletop
from tests.torch_threads import torch_threads

TINY = LanguageModelSettings(hidden=32, layers=2, heads=4, key_value_heads=2, head=8, intermediate=64, vocabulary=300)
TABLE = Tabletop("office_table", (1.12, 0.593))
FORM = ReplyGrammar.of_table(TABLE, at_most=2)
SHORT = Sampling(max_tokens=400)
MUG = LayoutObject("mug_0", "a red mug", (9.0, 8.4, 10.0), (20.0, 30.5, 5.0), -15)


@pytest.fixture(scope="module")
def tokenizer() -> PreTrainedTokenizerFast:
    ask = ReasonerQuestion("Put the red mug on the table.", TABLE, Stage.TASK)
    return train_tokenizer([user_message(ask), render_objects([MUG])] * 4, 300)


@pytest.fixture
def network(tokenizer: PreTrainedTokenizerFast) -> Qwen3ForCausalLM:
    return new_network(TINY, tokenizer, 1024, seed=3).eval()


def request(seed: int, words: str = "Put the red mug on the table.", form: ReplyGrammar = FORM) -> Request:
    return Request(tuple(messages(ReasonerQuestion(words, TABLE, Stage.TASK))), form, seed)


@torch.no_grad()
def test_slots_give_the_logits_of_whole_sequences(network: Qwen3ForCausalLM) -> None:
    """Sequences that come, go and change slots, against one forward pass over each."""
    draw = torch.Generator().manual_seed(0)
    told = [torch.randint(5, 300, (size,), generator=draw).tolist() for size in (5, 9, 3, 300)]
    more = [torch.randint(5, 300, (6,), generator=draw).tolist() for _ in told]
    whole = [network(torch.tensor([a + b])).logits[0] for a, b in zip(told, more, strict=True)]
    network.set_attn_implementation(ATTENTION)
    decoder, slots, at = Decoder(network, 3, pad=0), [0, 1], [0, 0, 0, 0]
    decoder.admit(told[0])
    decoder.admit(told[1])
    for turn in range(6):
        for slot, k in enumerate(slots):
            torch.testing.assert_close(decoder.logits[slot], whole[k][len(told[k]) - 1 + at[k]], atol=2e-5, rtol=1e-4)
        if turn in (1, 2):  # one ends, another begins: one as long as a growth of the cache asks for
            decoder.release(0)
            slots[0] = slots[-1]
            slots[-1:] = [turn + 1]
            decoder.admit(told[turn + 1])
        tokens = [more[k][at[k]] for k in slots]
        for k in slots:
            at[k] += 1
        decoder.step(tokens)


@pytest.mark.slow
def test_prompts_of_many_lengths_leave_no_kernels() -> None:
    code = """if True:
        import os, torch
        from benchmarks.faults.processes import usage_of
        from models.semantic_reasoner.engines.batched_decoding import ATTENTION, Decoder
        from transformers import Qwen3Config, Qwen3ForCausalLM

        sizes = dict(hidden_size=64, intermediate_size=128, num_hidden_layers=2, num_attention_heads=2, num_key_value_heads=1)
        config = Qwen3Config(vocab_size=64, head_dim=32, attn_implementation=ATTENTION, **sizes)
        network = Qwen3ForCausalLM(config).to(torch.bfloat16).eval()
        for length in range(16, 300):
            Decoder(network, 4, pad=0).admit([1] * length)
            if length in (100, 299):
                print(usage_of([os.getpid()]).memory_mb)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(float, done.stdout.split())
    assert after - before < 50  # it was 480


def test_the_cache_of_a_batch_is_freed_when_the_batch_ends(network: Qwen3ForCausalLM) -> None:
    decoder = Decoder(network, 3, pad=0)
    decoder.admit([1, 2, 3])
    decoder.step([4])
    keys = ref(decoder._cache.layers[0].keys)
    assert keys() is not None
    gc.disable()  # which would find a cycle, but seldom
    try:
        del decoder
        assert keys() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("num_threads", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_logits_do_not_depend_on_the_batch_to_the_last_bit(
    network: Qwen3ForCausalLM, num_threads: int, precision: torch.dtype
) -> None:
    """A sequence alone, and one among others that come, go, are longer and push it to another slot."""
    network.to(dtype=precision)
    draw = torch.Generator().manual_seed(1)
    told, more = (torch.randint(5, 300, (size,), generator=draw).tolist() for size in (70, 30))
    others = [torch.randint(5, 300, (size,), generator=draw).tolist() for size in range(3, 400, 20)]
    network.set_attn_implementation(ATTENTION)
    with torch_threads(num_threads):
        for is_plain in (True, False):  # whether the network's own modules are left out
            alone, among = Decoder(network, 64, pad=0), Decoder(network, 64, pad=0)
            if not is_plain:
                alone._step = among._step = None
            for prompt in others[:9]:
                among.admit(prompt)
            alone.admit(told)
            among.admit(told)
            slot = 9
            for turn, token in enumerate(more):
                assert torch.equal(alone.logits[0], among.logits[slot])
                if turn < 9:
                    among.admit(others[9 + turn])
                elif turn < 18:  # the last one, which may be ours, moves to the place of the first
                    slot = 0 if among.release(0) == slot else slot
                alone.step([token])
                tokens = [7 + k for k in range(len(among.lengths))]
                tokens[slot] = token
                among.step(tokens)


def test_only_a_plain_qwen3_is_stepped_without_its_modules(network: Qwen3ForCausalLM) -> None:
    """What has a bias, another layer or another class is left to its own modules, and so is right whatever it does."""
    assert Qwen3Step.knows(network)
    network.model.layers[1].mlp.up_proj = torch.nn.Sequential(network.model.layers[1].mlp.up_proj)
    assert not Qwen3Step.knows(network)
    network.model.layers[1].mlp.up_proj = network.model.layers[1].mlp.up_proj[0]
    network.config.attention_bias = True
    assert not Qwen3Step.knows(network)
    llama = LlamaConfig(vocab_size=64, hidden_size=32, intermediate_size=64, num_hidden_layers=1, num_attention_heads=2)
    assert not Qwen3Step.knows(LlamaForCausalLM(llama))


@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_steps_without_modules_are_those_of_the_modules(network: Qwen3ForCausalLM, dtype: torch.dtype) -> None:
    for parameter in network.parameters():  # norms of ones would hide that they are left out
        parameter.mul_(1 + 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(parameter.numel())))
    network.to(dtype).set_attn_implementation(ATTENTION)
    ours, theirs = Decoder(network, 3, pad=0), Decoder(network, 3, pad=0)
    theirs._step = None
    told = [[7, 8, 9, 200], [30], [11, 12]]
    for decoder in (ours, theirs):
        for prompt in told:
            decoder.admit(prompt)
    for step in range(5):
        tokens = [20 + step, 30 + step, 40 + step]
        ours.step(tokens)
        theirs.step(tokens)
        found, wanted = ours.logits[:3], theirs.logits[:3]
        torch.testing.assert_close(found, wanted, atol=1e-5 if dtype == torch.float32 else 0.05, rtol=1e-4)
        assert wanted.std() > 0.1


def test_an_untrained_model_says_only_what_the_form_allows(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast
) -> None:
    engine = LocalEngine(network, tokenizer, "tiny", SHORT, num_slots=4)
    replies = engine.complete([request(seed) for seed in range(12)])
    said = [c for c in replies if not c.code]
    assert {c.code for c in replies} <= {"", "reply_cut"}
    assert said
    for completion in said:
        for o in parse_reply(completion.text).objects:
            assert 0 <= o.position_cm[0] <= 112.0
            assert 0 <= o.position_cm[1] <= 59.3
        assert render_objects(parse_reply(completion.text).objects) == completion.text
        assert completion.reply_tokens
        assert completion.prompt_tokens


def test_a_reply_depends_on_its_seed_and_not_on_its_neighbours(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast
) -> None:
    asked = [request(seed, f"Put the {'red ' * (seed % 3)}mug on the table.") for seed in range(9)]
    together = LocalEngine(network, tokenizer, "tiny", SHORT, num_slots=4).complete(asked)
    assert LocalEngine(network, tokenizer, "tiny", SHORT, num_slots=9).complete(asked[::-1])[::-1] == together
    assert [LocalEngine(network, tokenizer, "tiny", SHORT).complete([r])[0] for r in asked[:3]] == together[:3]
    assert len({c.text for c in LocalEngine(network, tokenizer, "tiny", SHORT).complete([request(s) for s in range(6)])}) > 1


@pytest.mark.slow
def test_threads_share_a_running_batch_and_get_what_each_would_get_alone(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast
) -> None:
    asked = [request(seed) for seed in range(12)]
    alone = LocalEngine(network, tokenizer, "tiny", SHORT)
    one_by_one = [alone.complete([r])[0] for r in asked]
    assert alone.num_tokens == alone.num_steps
    engine = LocalEngine(network, tokenizer, "tiny", SHORT, num_slots=8)
    with ThreadPoolExecutor(12) as pool:
        assert list(pool.map(lambda r: engine.complete([r])[0], asked)) == one_by_one
    assert 2 < engine.num_tokens / engine.num_steps <= 8


def test_an_error_of_a_shared_batch_reaches_every_thread_and_the_engine_goes_on(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = LocalEngine(network, tokenizer, "tiny", SHORT)

    def fails(*_: object) -> None:
        raise MemoryError("full")

    with monkeypatch.context() as patch, ThreadPoolExecutor(2) as pool:
        patch.setattr(engine, "_draw", fails)
        for future in [pool.submit(engine.complete, [request(seed)]) for seed in range(2)]:
            with pytest.raises(MemoryError, match="full"):
                future.result()
    assert engine.complete([request(0)])[0].reply_tokens


ASKS = (*(RequiredObject(k, ("mug", "teacup")) for k in "ab"), RequiredObject("c", ("pen",)))


def test_a_reply_does_not_end_without_what_its_form_asks_for(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast
) -> None:
    class Brief(LocalEngine):
        """A model that knows nothing, but that descriptions are short."""

        def _draw(self, logits: torch.Tensor, active: list[_Sequence]) -> list[int]:
            logits = logits.clone()
            logits[:, tokenizer.convert_tokens_to_ids('","size":[')] += 9
            return super()._draw(logits, active)

    form = ReplyGrammar.of_table(TABLE, at_most=5, asks=ASKS)
    engine = Brief(network, tokenizer, "tiny", replace(SHORT, max_tokens=900), num_slots=4)
    said = [c for c in engine.complete([request(seed, form=form) for seed in range(12)]) if not c.code]
    assert len(said) > 3
    for completion in said:
        objects = parse_reply(completion.text).objects
        assert len(objects) <= 5
        assert len(objects) == 5 or not unmatched(ASKS, [o.category for o in objects])
        assert render_objects(objects) == completion.text
    free = [c for c in engine.complete([request(seed, form=replace(form, asks=())) for seed in range(12)]) if not c.code]
    assert all(unmatched(ASKS[-1:], [o.category for o in parse_reply(c.text).objects]) for c in free)


def test_a_reply_ends_without_what_it_has_no_room_for(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    engine = LocalEngine(network, tokenizer, "tiny")
    form = ReplyGrammar.of_table(TABLE, asks=ASKS)
    reply = tokenizer(render_objects([MUG] * 2), add_special_tokens=False)["input_ids"]
    pens = [render_objects([*[MUG] * 2, *[replace(MUG, instance="pen_0")] * n]) for n in (1, 2)]

    def then(room: int) -> list[bool] | None:
        """Whether one and two more objects may follow; None if the reply ends."""
        sequence = _Sequence(0, [1], request(0, form=form), engine._matcher(form.grammar()), default_rng(0), [*reply])
        if not engine._reopen(sequence, room):
            return None
        assert sequence.matcher is not None
        kept = engine._text(sequence.reply)
        more = [tokenizer(text.removeprefix(kept), add_special_tokens=False)["input_ids"] for text in pens]
        return [sequence.matcher.validate_tokens(tokens) == len(tokens) for tokens in more]

    size = len(reply)
    assert then(size + size // 2 - 1) is None
    assert then(2 * size - 4) == [True, False]  # only what is missing
    assert then(3 * size) == [True, True]


@pytest.mark.parametrize("is_general", [False, True])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_an_end_is_taken_back_by_whole_tokens(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast, is_general: bool, count: int
) -> None:
    """With a tokenizer whose last token is the end of an object and of the list, and with one of single letters."""
    words = letters_tokenizer() if is_general else tokenizer
    engine = LocalEngine(network, words, "tiny")
    whole = render_objects([MUG] * count)
    reply = words(whole, add_special_tokens=False)["input_ids"]
    asked = request(0, form=ReplyGrammar.of_table(TABLE, asks=ASKS))
    sequence = _Sequence(0, [1], asked, engine._matcher(FORM.grammar()), default_rng(0), [*reply])
    assert engine._reopen(sequence, 4096)
    kept = engine._text(sequence.reply)
    assert whole.removesuffix("]}").startswith(kept)
    assert len(sequence.reply) == len(reply) - (2 if is_general else 1)
    assert sequence.matcher is not None
    ok = render_objects([*[MUG] * count, replace(MUG, instance="pen_0"), MUG]).removeprefix(kept)
    assert sequence.matcher.validate_tokens(words(ok, add_special_tokens=False)["input_ids"]) == len(
        words(ok, add_special_tokens=False)["input_ids"]
    )


def letters_tokenizer() -> PreTrainedTokenizerFast:
    plain = Tokenizer(models.BPE())
    plain.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    plain.decoder = decoders.ByteLevel()
    plain.train_from_iterator(
        ["a"], trainers.BpeTrainer(special_tokens=["<end>"], initial_alphabet=pre_tokenizers.ByteLevel.alphabet())
    )
    return PreTrainedTokenizerFast(tokenizer_object=plain, eos_token="<end>", chat_template="x")  # noqa: S106


def test_lists_end_at_the_model_s_own_odds(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    """A temperature under 1 and ``top_p`` would cut an end of 6 % away."""
    engine = LocalEngine(network, tokenizer, "tiny", Sampling(temperature=0.5, top_p=0.9))
    form = ReplyGrammar.of_table(TABLE)
    end, more = (tokenizer.convert_tokens_to_ids(word) for word in ("}]}", '},{"instance":"'))
    logits = torch.full((1, engine._vocabulary), -9.0)
    logits[0, end], logits[0, more] = math.log(0.06), math.log(0.94)
    tokens = tokenizer(render_objects([MUG]), add_special_tokens=False)["input_ids"][:-1]
    matcher = engine._matcher(form.grammar())
    assert matcher.consume_tokens(tokens)
    sequence = _Sequence(0, [1], request(0, form=form), matcher, default_rng(0), tokens)
    drawn = [engine._draw(logits, [sequence])[0] for _ in range(3000)]
    assert set(drawn) == {end, more}
    assert drawn.count(end) / len(drawn) == pytest.approx(0.06, abs=0.015)
    sure = LocalEngine(network, tokenizer, "tiny", Sampling(temperature=0))
    assert sure._draw(logits, [sequence]) == [more]


def test_the_likeliest_reply_is_that_of_generate(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    """Greedy and unbound, against the library's own loop."""
    chat = tokenizer.apply_chat_template(
        messages(ReasonerQuestion("Put it.", TABLE, Stage.TASK)), tokenize=False, add_generation_prompt=True
    )
    ids = torch.tensor([tokenizer(chat)["input_ids"]])
    told = network.generate(ids, max_new_tokens=40, do_sample=False, attention_mask=torch.ones_like(ids))[0, ids.shape[1] :]
    engine = LocalEngine(network, tokenizer, "tiny", Sampling(temperature=0, max_tokens=40), is_constrained=False)
    written: list[int] = []

    def kept(sequence: Any, ended: bool) -> Completion:
        written.extend(sequence.reply)
        return Completion("")

    engine._completion = kept  # type: ignore[method-assign]  # text alone would hide which tokens it was
    engine.complete([request(0, "Put it.")])
    assert written == told.tolist()[: len(written)]
    assert len(written) in (40, len(told) - 1)


def test_what_cannot_be_answered_does_not_touch_the_others(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast
) -> None:
    network.config.max_position_embeddings = 200
    engine = LocalEngine(network, tokenizer, "tiny", Sampling(max_tokens=30))
    long, fine = engine.complete([request(0, "mug " * 400), request(1)])
    assert long.code == "prompt_too_long"
    assert "shorten" in long.failure
    assert fine.code in ("", "reply_cut")
    assert fine.reply_tokens
    assert engine.complete([]) == []


def test_an_engine_is_a_folder(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast, tmp_path: Path) -> None:
    network.save_pretrained(tmp_path)
    tokenizer.save_pretrained(tmp_path)
    loaded = LocalEngine.load(tmp_path, sampling=SHORT)
    direct = LocalEngine(network.to(dtype=loaded._model.dtype), tokenizer, "tiny", SHORT)
    asked = [request(seed) for seed in range(3)]
    assert loaded.complete(asked) == direct.complete(asked)
    assert loaded.name == f"transformers:{tmp_path.name}"


@pytest.mark.parametrize("what", ["nothing", "text", "no weights", "half the weights", "no template"])
def test_a_folder_that_is_no_model_is_refused(
    network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast, tmp_path: Path, what: str
) -> None:
    if what == "text":
        (tmp_path / "config.json").write_text("no model")
    if what in ("no weights", "half the weights", "no template"):
        network.save_pretrained(tmp_path)
        tokenizer.save_pretrained(tmp_path)
    if what == "no weights":
        (tmp_path / "model.safetensors").unlink()
    if what == "half the weights":
        from safetensors.torch import load_file, save_file

        kept = {k: v for k, v in load_file(tmp_path / "model.safetensors").items() if "layers.1" not in k}
        save_file(kept, tmp_path / "model.safetensors", {"format": "pt"})
    if what == "no template":
        for file in tmp_path.glob("chat_template*"):
            file.unlink()
        config = json.loads((tmp_path / "tokenizer_config.json").read_text())
        config.pop("chat_template", None)
        (tmp_path / "tokenizer_config.json").write_text(json.dumps(config))
    with pytest.raises(ConfigError) as caught:
        LocalEngine.load(tmp_path)
    assert caught.value.code == "model_invalid"
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_vllm_says_what_it_needs() -> None:
    try:
        import vllm  # noqa: F401
    except ImportError:
        with pytest.raises(ConfigError, match="separate environment") as caught:
            VllmEngine("/nowhere")
        assert caught.value.code == "extra_missing"
    else:
        pytest.skip("vllm is installed here")
