import contextlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import AutoModelForCausalLM, AutoTokenizer

from models.semantic_reasoner.training.batch_sampler import TokenBatch, batch_of
from models.semantic_reasoner.training.hf_folder import read_model, read_tokenizer, write_model
from models.semantic_reasoner.training.loss import ReplyLoss
from models.semantic_reasoner.training.network import TrainableNetwork, new_network, trainable_parameters
from models.semantic_reasoner.training.settings import (
    LanguageModelSettings,
    LoraSettings,
    ReasonerTrainingSettings,
    training_preset,
)
from models.semantic_reasoner.training.sharding import place_network
from models.semantic_reasoner.training.token_dataset import TokenDataset
from models.semantic_reasoner.training.trainer import CheckpointIdentity, ReasonerTrainer, train
from models.training.distributed import CPU, ProcessContext
from stable_data.errors import ConfigError
from tests.models.semantic_reasoner.training.reasoner_examples import PACKED, TINY, examples, token_set, tokenizer

DATA = token_set(12)


def training(settings: ReasonerTrainingSettings = TINY, data: TokenDataset = DATA) -> ReasonerTrainer:
    return ReasonerTrainer(data, settings, tokenizer())


def advanced(settings: ReasonerTrainingSettings, steps: int) -> ReasonerTrainer:
    made = training(settings)
    for _ in range(steps):
        made.advance()
    return made


def checkpoint_of(folder: Path) -> dict[str, list[float]]:
    """The tensors of the checkpoint in a folder."""
    (found,) = folder.glob("*/*.safetensors")
    return {name: value.flatten().tolist() for name, value in load_file(found).items()}


def same(a: ReasonerTrainer, b: ReasonerTrainer) -> bool:
    there = b.values()
    return all(torch.equal(value, there[name]) for name, value in a.values().items())


def sharp(settings: ReasonerTrainingSettings = TINY) -> ReplyLoss:
    """A network with weights so large that what it reads matters much."""
    network = new_network(TINY.network, tokenizer(), 512, seed=1)
    with torch.no_grad():
        for p in network.parameters():
            p.mul_(20.0 if p.dim() > 1 else 1.0)
    return ReplyLoss(network, settings)


def loss_of(settings: ReasonerTrainingSettings, rows: list[list[int]], pad: int = 0) -> torch.Tensor:
    return sharp(settings).of_batch(batch_of(DATA, rows, pad), CPU)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model of random weights, as it would be downloaded."""
    folder = tmp_path_factory.mktemp("base") / "qwen"
    network = new_network(TINY.network, tokenizer(), 512, seed=5).to(torch.bfloat16)
    write_model(folder, network, tokenizer(), {})
    return folder


# --- the loss -----------------------------------------------------------------------------------------------------------------


def test_packed_rows_have_the_loss_of_separate_ones() -> None:
    apart = [loss_of(TINY, [[k]]) for k in range(6)]
    packed = loss_of(PACKED, [[0, 1, 2], [3, 4, 5]])
    assert packed.item() == pytest.approx(sum(v.item() for v in apart), rel=1e-5)
    # A model that saw the examples before it would have another loss: so it has with positions that go on.
    assert loss_of(TINY, [[0, 1, 2], [3, 4, 5]]).item() != pytest.approx(packed.item(), rel=1e-3)


def test_packed_rows_have_the_gradients_of_separate_ones() -> None:
    packed, apart = sharp(PACKED), sharp(TINY)
    packed.of_batch(batch_of(DATA, [[0, 1], [2, 3]], 0), CPU).backward()  # type: ignore[no-untyped-call]
    for k in range(4):
        apart.of_batch(batch_of(DATA, [[k]], 0), CPU).backward()  # type: ignore[no-untyped-call]
    for a, b in zip(packed.parameters(), apart.parameters(), strict=True):
        assert a.grad is not None
        assert b.grad is not None
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("settings", "rows"), [(TINY, [[0], [3]]), (PACKED, [[0, 1], [2, 3]])])
def test_where_it_is_trained_the_loss_and_its_gradient_are_those_of_transformers(
    settings: ReasonerTrainingSettings, rows: list[list[int]]
) -> None:
    plain, placed = sharp(settings), sharp(settings)
    place_network(placed, CPU)
    losses = [loss.of_batch(batch_of(DATA, rows, 0), CPU) for loss in (plain, placed)]
    torch.testing.assert_close(*losses)
    for loss in losses:
        loss.backward()  # type: ignore[no-untyped-call]
    for a, b in zip(plain.parameters(), placed.parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-3, atol=1e-4)


def test_padding_changes_nothing() -> None:
    apart = sum(loss_of(TINY, [[k]]).item() for k in (0, 2, 5))
    for pad in (0, 7):
        assert loss_of(TINY, [[0], [2], [5]], pad).item() == pytest.approx(apart, rel=1e-5)


def test_the_loss_is_on_the_reply_alone() -> None:
    batch = batch_of(DATA, [[4]], 0)
    words, num_prompt = DATA.of(4)
    network: Any = sharp().network
    logits = network(torch.from_numpy(batch.tokens)).logits[0, num_prompt - 1 : len(words) - 1]
    expected = torch.nn.functional.cross_entropy(logits, torch.from_numpy(words[num_prompt:]).long(), reduction="sum")
    assert loss_of(TINY, [[4]]).item() == pytest.approx(expected.item(), rel=1e-5)


def test_prompt_positions_send_no_gradient_through_the_head() -> None:
    loss = ReplyLoss(new_network(TINY.network, tokenizer(), 512, 0), TINY)
    seen: list[torch.Tensor] = []
    loss.network.lm_head.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    loss.of_batch(batch_of(DATA, [[4], [5]], 0), CPU)
    assert [len(hidden) for hidden in seen] == [int(DATA.reply_length[[4, 5]].sum())]


def test_another_target_in_the_prompt_is_no_other_loss() -> None:
    batch = batch_of(DATA, [[4]], 0)
    _, num_prompt = DATA.of(4)
    tokens = batch.tokens.copy()
    loss = sharp()
    tokens[0, -1] = 7  # it only is a target, the last one, and targets are given apart
    assert torch.equal(loss.of_batch(TokenBatch(tokens, batch.position, batch.target), CPU), loss.of_batch(batch, CPU))
    tokens[0, num_prompt - 1] = 7  # what the reply is an answer to does count
    assert not torch.equal(loss.of_batch(TokenBatch(tokens, batch.position, batch.target), CPU), loss.of_batch(batch, CPU))


@pytest.mark.parametrize("settings", [TINY, PACKED])
def test_what_is_computed_again_is_the_same(settings: ReasonerTrainingSettings) -> None:
    kept, again = training(settings), training(replace(settings, recomputes=True))
    for _ in range(3):
        assert kept.advance().loss == pytest.approx(again.advance().loss, rel=1e-6)
    for a, b in zip(kept.loss.parameters(), again.loss.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_compiling_without_a_compiler_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(ConfigError, match="no C"):
        training(replace(TINY, compiles=True))


@pytest.mark.slow  # a minute of compiling
@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # PyTorch's compiler calls what PyTorch gives up
@pytest.mark.filterwarnings("ignore:The .grad attribute:UserWarning")  # and looks at what it was given
@pytest.mark.parametrize("settings", [TINY, PACKED])
def test_a_compiled_network_learns_the_same(settings: ReasonerTrainingSettings) -> None:
    plain, compiled = training(settings), training(replace(settings, compiles=True))
    for _ in range(3):
        assert plain.advance().loss == pytest.approx(compiled.advance().loss, rel=1e-4)
    assert plain.validate(DATA, 4) == pytest.approx(compiled.validate(DATA, 4), rel=1e-4)
    assert plain.values().keys() == compiled.values().keys()


def test_a_step_of_several_batches_is_that_of_one_large_one() -> None:
    rows = [[[k] for k in range(6)], [[k] for k in range(6, 12)]]
    one, two = training(replace(TINY, clip=1e9)), training(replace(TINY, clip=1e9, accumulate=2))
    one._batches = iter([[*rows[0], *rows[1]]])
    two._batches = iter(rows)
    a, b = one.advance(), two.advance()
    assert a.loss == pytest.approx(b.loss, rel=1e-5)
    assert a.norm == pytest.approx(b.norm, rel=1e-4)
    assert one.tokens == two.tokens == int(DATA.reply_length.sum())


# --- learning -----------------------------------------------------------------------------------------------------------------


def test_a_network_learns_four_examples_by_heart() -> None:
    settings = replace(TINY, steps=110, tokens_per_batch=2000, learning_rate=1e-2, cool_down=0.3, precision="bfloat16")
    made = training(settings, token_set(4))
    assert train(made, wants_stop=lambda: False, wants_save=lambda: False, after=lambda *_: None)
    network: Any = made.loss.network
    network.eval()
    for example in examples(4):
        asked: Any = tokenizer().apply_chat_template(example.prompt, add_generation_prompt=True, return_tensors="pt")
        found = network.generate(**asked, max_new_tokens=200, do_sample=False)[0, asked["input_ids"].shape[1] :]
        assert tokenizer().decode(found, skip_special_tokens=True) == example.answer
    assert max(made.validate(token_set(4), 4).values()) < 0.05


def test_validation_is_the_mean_over_a_kinds_tokens() -> None:
    made = training()
    found = made.validate(DATA, most=3)
    members = np.flatnonzero(DATA.kind == 1)[:3]
    total = sum(made.loss.of_batch(batch_of(DATA, [[int(k)]], 0), CPU).item() for k in members)
    assert found["important"] == pytest.approx(total / DATA.reply_length[members].sum(), rel=1e-5)
    assert set(found) == {"task", "important", "secondary"}


def test_a_loss_that_is_not_finite_ends_the_run() -> None:
    made = training()
    with torch.no_grad():
        next(made.loss.parameters()).fill_(torch.inf)
    with pytest.raises(ConfigError, match="not finite"):
        train(made, wants_stop=lambda: False, wants_save=lambda: False, after=lambda *_: None)


# --- going on -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings", [TINY, replace(PACKED, accumulate=2, precision="bfloat16"), replace(TINY, optimizer="muon")]
)
def test_a_run_that_was_killed_and_resumed_is_the_run_that_was_not(settings: ReasonerTrainingSettings, tmp_path: Path) -> None:
    clean = advanced(settings, 12)  # several passes
    first = advanced(settings, 5)
    first.save(tmp_path / "kept")
    first.advance()  # lost: it was killed before it was kept
    second = training(settings)
    assert second.resume(tmp_path / "kept")
    assert (second.step, second.tokens < clean.tokens) == (5, True)
    for _ in range(7):
        second.advance()
    assert same(second, clean)
    assert second.tokens == clean.tokens
    second.save(tmp_path / "second")
    clean.save(tmp_path / "clean")
    a, b = (checkpoint_of(tmp_path / name) for name in ("second", "clean"))
    assert a == b
    muons = {"momentum_buffer"} if settings.optimizer == "muon" else set()
    assert {name.partition(".")[0] for name in a} == {"weights", "exp_avg", "exp_avg_sq"} | muons


def test_a_run_may_be_kept_before_its_first_step(tmp_path: Path) -> None:
    training().save(tmp_path)
    again = training()
    assert again.resume(tmp_path)
    assert again.advance() == training().advance()


def test_a_run_may_become_longer_until_it_cools_down(tmp_path: Path) -> None:
    short, long = (replace(TINY, steps=steps, warm_up=2, cool_down=0.5) for steps in (8, 16))
    path = tmp_path / "kept"
    advanced(short, 4).save(path)
    longer = training(long)
    assert longer.resume(path)
    for _ in range(12):
        longer.advance()
    assert same(longer, advanced(long, 16))
    advanced(short, 6).save(path)
    with pytest.raises(ConfigError, match="other learning rates"):
        training(long).resume(path)


def test_a_checkpoint_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    assert not training().resume(path)
    training().save(path)
    with pytest.raises(ConfigError, match=r"settings.learning_rate: 0.01 -> 0.5") as caught:
        training(replace(TINY, learning_rate=0.5)).resume(path)
    assert caught.value.code == "config_changed"
    with pytest.raises(ConfigError, match=r"identity.data:  -> other"):
        ReasonerTrainer(DATA, TINY, tokenizer(), CPU, CheckpointIdentity("other")).resume(path)


def cut(folder: Path) -> None:
    (file,) = folder.glob("*.safetensors")
    file.write_bytes(file.read_bytes()[:-4])


def cut_and_said(folder: Path) -> None:
    """As if it had been written so."""
    cut(folder)
    notes = json.loads((folder / "training.json").read_text("utf-8"))
    notes["files"] = {name: (folder / name).stat().st_size for name in notes["files"]}
    (folder / "training.json").write_text(json.dumps(notes), "utf-8")


def without_a_value(folder: Path) -> None:
    notes = json.loads((folder / "training.json").read_text("utf-8"))
    del notes["values"]["tokens"]
    (folder / "training.json").write_text(json.dumps(notes), "utf-8")


def without_a_tensor(folder: Path) -> None:
    (file,) = folder.glob("*.safetensors")
    names = {name: value for name, value in load_file(file).items() if "embed" not in name}
    size = file.stat().st_size
    save_file(names, file)
    notes = (folder / "training.json").read_text("utf-8")
    (folder / "training.json").write_text(notes.replace(str(size), str(file.stat().st_size)), "utf-8")


BROKEN: dict[str, Callable[[Path], object]] = {
    "a file is cut": cut,
    "a file was cut before": cut_and_said,
    "a file is away": lambda folder: next(folder.glob("*.safetensors")).unlink(),
    "the values are away": lambda folder: (folder / "training.json").unlink(),
    "the values are no JSON": lambda folder: (folder / "training.json").write_text("{", "utf-8"),
    "the values are a list": lambda folder: (folder / "training.json").write_text("[]", "utf-8"),
    "a value is missing": without_a_value,
    "a tensor is missing": without_a_tensor,
    "there is something else": lambda folder: (folder.parent / "state.pt").write_bytes(b"of an earlier version"),
}


@pytest.mark.parametrize("way", BROKEN)
def test_an_unreadable_checkpoint_is_one_clear_line(way: str, tmp_path: Path) -> None:
    advanced(TINY, 1).save(tmp_path / "kept")
    BROKEN[way](tmp_path / "kept/000001")
    with pytest.raises(ConfigError, match="cannot be read as a checkpoint") as caught:
        training().resume(tmp_path / "kept")
    assert caught.value.code == "checkpoint_invalid"
    assert "\n" not in str(caught.value)


def test_a_file_where_the_checkpoint_should_be_is_said(tmp_path: Path) -> None:
    (tmp_path / "kept").write_bytes(b"PK nothing")
    with pytest.raises(ConfigError, match="cannot be read as a checkpoint"):
        training().resume(tmp_path / "kept")
    with pytest.raises(ConfigError, match="could not be written") as caught:
        training().save(tmp_path / "kept")
    assert caught.value.code == "checkpoint_unwritten"


class KilledError(BaseException):
    """In place of the end of the process."""


def killed_after(calls: int, patch: pytest.MonkeyPatch) -> list[int]:
    """Makes the calls that change files raise after some of them; returns a list with the number of calls that are left."""
    left = [calls]

    def limited(call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **more: Any) -> Any:
            if left[0] == 0:
                raise KilledError
            left[0] -= 1
            return call(*args, **more)

        return counted

    for owner, name in ((os, "fsync"), (os, "unlink"), (os, "rmdir"), (os, "mkdir"), (Path, "replace"), (Path, "open")):
        patch.setattr(owner, name, limited(getattr(owner, name)))
    return left


def test_wherever_it_is_killed_the_old_or_the_new_checkpoint_is_there(tmp_path: Path) -> None:
    made = advanced(TINY, 2)
    made.save(tmp_path / "before")
    made.advance()
    found = []
    for calls in range(100):
        folder = Path(shutil.copytree(tmp_path / "before", tmp_path / "kept"))
        with pytest.MonkeyPatch.context() as patch:
            left = killed_after(calls, patch)
            with contextlib.suppress(KilledError, ConfigError):  # torch wraps what ends its writing
                made.save(folder)
        again = training()
        assert again.resume(folder)
        found.append(again.step)
        assert again.step == 2 or same(again, made)
        again.save(folder)  # what was left over is in nobody's way
        assert len(list(folder.iterdir())) == 1
        assert training().resume(folder)
        shutil.rmtree(folder)
        if left[0]:
            break
    assert found == sorted(found)
    assert len(found) > 10
    assert set(found) == {2, 3}


def test_processes_that_cannot_share_a_step_are_refused() -> None:
    with pytest.raises(ConfigError, match="accumulate is 1, expected a multiple of the 2 processes"):
        ReasonerTrainer(DATA, TINY, tokenizer(), ProcessContext(world_size=2))


@torch.no_grad()
def test_a_new_network_can_hand_a_number_on() -> None:
    settings = LanguageModelSettings(hidden=64, layers=2, heads=4, key_value_heads=2, head=16, vocabulary=300)
    network, words = new_network(settings, tokenizer(), 512, seed=3), tokenizer()
    embeddings = network.get_input_embeddings().weight
    attention = network.model.layers[1].self_attn
    numbers = torch.tensor([words.convert_tokens_to_ids(str(n)) for n in range(-60, 120)])
    value = torch.zeros(len(numbers), 64)
    value[:, :16] = attention.v_proj(embeddings[numbers])[:, :16]  # what the first query head takes of each, looked at alone
    said = attention.o_proj(value) @ embeddings[numbers].T
    off = (said.argmax(1) - torch.arange(len(numbers))).abs()
    assert off.double().mean() < 1  # the number, or the one beside it; at random it would be 60


# --- models -------------------------------------------------------------------------------------------------------------------


def test_what_is_kept_loads_without_our_code(tmp_path: Path) -> None:
    made = advanced(TINY, 3)
    for storage in ("float32", "bfloat16"):
        settings = replace(TINY, storage=storage)
        model = TrainableNetwork(settings, tokenizer()).with_values(made.values()).to_save(settings)
        write_model(tmp_path / storage, model, tokenizer(), {"steps": 3})
    tokens = torch.from_numpy(batch_of(DATA, [[4]], 0).tokens)
    here: Any = made.loss.network
    for storage, tolerance in (("float32", 1e-5), ("bfloat16", 0.2)):
        loaded: Any = AutoModelForCausalLM.from_pretrained(tmp_path / storage)
        assert loaded.dtype == getattr(torch, storage)
        torch.testing.assert_close(loaded(tokens).logits.float(), here(tokens).logits, rtol=tolerance, atol=tolerance)
    read: Any = AutoTokenizer.from_pretrained(tmp_path / "float32")
    for example in examples(4):
        found, expected = (
            t.apply_chat_template(example.prompt, add_generation_prompt=True, tokenize=False) for t in (read, tokenizer())
        )
        assert found == expected
        assert read(example.answer)["input_ids"] == tokenizer()(example.answer)["input_ids"]
    assert (read.eos_token, read.pad_token) == (tokenizer().eos_token, tokenizer().pad_token)


def test_a_base_is_trained_whole_from_its_weights(base: Path) -> None:
    settings = replace(TINY, base=str(base))
    made = training(settings)
    fresh = dict(read_model(base, 512).named_parameters())
    assert set(made.values()) == set(fresh)
    for name, value in made.values().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, fresh[name].float())
    made.advance()
    assert not any(torch.equal(value, fresh[name].float()) for name, value in made.values().items() if value.dim() > 1)


@pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing.:FutureWarning")  # of peft about transformers
@pytest.mark.parametrize("merges", [True, False])
def test_lora_trains_its_matrices_alone(base: Path, tmp_path: Path, merges: bool) -> None:
    settings = replace(TINY, base=str(base), lora=LoraSettings(4, 8, merges))
    made = training(settings)
    before = {name: p.detach().clone() for name, p in made.loss.network.named_parameters()}
    losses = [made.advance().loss for _ in range(4)]
    changed = {name for name, p in made.loss.network.named_parameters() if not torch.equal(p, before[name])}
    assert changed == set(trainable_parameters(made.loss.network))
    assert all("lora_" in name for name in changed)
    assert losses[-1] < losses[0]
    model = TrainableNetwork(settings, tokenizer()).with_values(made.values()).to_save(settings)
    write_model(tmp_path / "weights", model, tokenizer(), {})
    assert (tmp_path / "weights" / "adapter_config.json").is_file() is not merges
    loaded: Any = AutoModelForCausalLM.from_pretrained(tmp_path / "weights", dtype=torch.float32)
    tokens = torch.from_numpy(batch_of(DATA, [[4]], 0).tokens)
    here: Any = made.loss.network
    torch.testing.assert_close(loaded(tokens).logits, here(tokens).logits, rtol=1e-3, atol=1e-3)
    again = training(settings)
    made.save(tmp_path / "kept")
    assert again.resume(tmp_path / "kept")
    assert made.advance() == again.advance()


def test_a_base_that_is_no_model_is_one_clear_line(base: Path, tmp_path: Path) -> None:
    for make in (lambda: read_model(tmp_path / "nowhere", 512), lambda: read_tokenizer(tmp_path / "nowhere")):
        with pytest.raises(ConfigError, match=r"nowhere: has no readable (model|tokenizer)") as caught:
            make()  # type: ignore[no-untyped-call]
        assert "\n" not in str(caught.value)
    (tmp_path / "config.json").write_text("{}", "utf-8")
    with pytest.raises(ConfigError, match="has no readable model"):
        read_model(tmp_path, 512)
    with pytest.raises(ConfigError, match="reads 512 tokens, expected max_tokens 9999 or more"):
        read_model(base, 9999)


def test_presets_are_the_papers_and_ours() -> None:
    paper = training_preset("paper")
    assert (paper.learning_rate, paper.max_tokens, paper.rows_per_batch, paper.passes) == (1e-5, 5000, 4, 1.0)
    assert paper.tokens_per_batch >= paper.rows_per_batch * paper.max_tokens
    assert {paper.learning_rate_at(step) for step in (0, 10, 10_000)} == {1e-5}
    embedded = training_preset("embedded").resolved(1000)
    assert embedded.learning_rate_at(embedded.steps - 1) < embedded.learning_rate / 100
    with pytest.raises(ConfigError, match="preset 'tiny' is not known"):
        training_preset("tiny")


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_tokens": 0},
        {"learning_rate": -1.0},
        {"steps": -1},
        {"passes": 0.0},
        {"cool_down": 1.5},
        {"lora": LoraSettings(4)},
        {"seed": -1},
    ],
)
def test_settings_that_cannot_run_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        ReasonerTrainingSettings(**wrong)
