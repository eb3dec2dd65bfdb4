"""Trainings in several real processes on the CPU, of a Qwen3 as small as a test needs, and what each process reports."""

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from safetensors.torch import save_file
from torch import Tensor
from torch.distributed.tensor import DTensor
from torch.multiprocessing.spawn import spawn
from transformers import Qwen3Config, Qwen3ForCausalLM

from models.semantic_reasoner.training.batch_sampler import batch_of
from models.semantic_reasoner.training.hf_folder import write_model
from models.semantic_reasoner.training.loss import ReplyLoss
from models.semantic_reasoner.training.settings import LoraSettings, ReasonerTrainingSettings
from models.semantic_reasoner.training.sharding import gather_tensor
from models.semantic_reasoner.training.trainer import CheckpointIdentity, ReasonerTrainer
from models.training.distributed import ProcessContext
from stable_data.errors import ConfigError
from tests.models.semantic_reasoner.training.reasoner_examples import TINY, token_set, tokenizer

DATA = token_set(24)
RECOMPUTES = replace(TINY, recomputes=True, accumulate=4, tokens_per_batch=300, learning_rate=1e-3)
LORA = LoraSettings(rank=2, alpha=8)  # of four processes, two have no row of a matrix with two rows


def write_base(folder: Path) -> Path:
    """Writes a Qwen3 like the one of 8 billion weights: grouped queries, normalised queries and keys, a head of its own."""
    words = tokenizer()
    config = Qwen3Config(
        vocab_size=-(-len(words) // 64) * 64,
        hidden_size=64,
        num_hidden_layers=3,
        num_attention_heads=4,
        num_key_value_heads=2,
        head_dim=16,
        intermediate_size=96,
        max_position_embeddings=512,
        rope_parameters={"rope_type": "default", "rope_theta": 1e6},
        tie_word_embeddings=False,
        pad_token_id=words.pad_token_id,
        eos_token_id=words.eos_token_id,
        bos_token_id=None,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        network = Qwen3ForCausalLM(config).to(torch.bfloat16)
    write_model(folder / "whole", network, words, {})
    shutil.copytree(folder / "whole", folder / "weightless", ignore=shutil.ignore_patterns("*.safetensors"))
    return folder


def of_base(settings: ReasonerTrainingSettings, base: Path, place: ProcessContext) -> ReasonerTrainingSettings:
    """Settings with the base model: only the first process has a folder with weights, so that no other one can read them."""
    return replace(settings, base=str(base / ("whole" if place.rank == 0 else "weightless")))


def in_processes(world: int, work: Callable[..., Any], *arguments: Any) -> list[Any]:
    """Runs a function, with its place as the first argument, in processes that form a group; returns the results as JSON."""
    with tempfile.TemporaryDirectory() as folder:
        spawn(_process, (world, Path(folder), work, arguments), nprocs=world)  # type: ignore[no-untyped-call]
        return [json.loads((Path(folder) / f"{rank}.json").read_text("utf-8")) for rank in range(world)]


def _process(rank: int, world: int, folder: Path, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    torch.set_num_threads(1)
    patience = timedelta(seconds=120)  # after that, a process that hangs ends
    dist.init_process_group("gloo", f"file://{folder}/group", patience, rank=rank, world_size=world)
    found = work(ProcessContext(torch.device("cpu"), rank, world), *arguments)
    (folder / f"{rank}.json").write_text(json.dumps(found), "utf-8")
    dist.barrier()
    dist.destroy_process_group()


def trainer(settings: ReasonerTrainingSettings, place: ProcessContext, data: str = "") -> ReasonerTrainer:
    return ReasonerTrainer(DATA, settings, tokenizer(), place, CheckpointIdentity(data))


def advance(made: ReasonerTrainer, steps: int) -> list[list[float]]:
    """Does steps; their losses and norms."""
    return [[step.loss, step.norm] for step in (made.advance() for _ in range(steps))]


def whole_state(made: ReasonerTrainer) -> dict[str, Tensor]:
    """Trained weights and the optimizer's averages, whole; all processes call it."""
    parts = {**made._weights(), **made._optimizers.averages()}
    return {name: gather_tensor(value).clone() for name, value in parts.items()}


def write_state(made: ReasonerTrainer, path: Path) -> None:
    found = whole_state(made)
    if made.place.rank == 0:
        save_file(found, path)


def code_of_refusal(call: Callable[[], object]) -> str:
    try:
        call()
    except ConfigError as error:
        return error.code
    return ""


def bytes_of(values: Any) -> int:
    """Bytes of this process's parts."""
    local = [value.to_local() if isinstance(value, DTensor) else value for value in values]
    return sum(value.numel() * value.element_size() for value in local)


def memory_of(made: ReasonerTrainer, rows: list[list[int]]) -> dict[str, int]:
    """What a training that has done a step holds in this process."""
    batch = batch_of(DATA, rows, 0)
    kept = bytes_kept(made.loss, torch.from_numpy(batch.tokens), torch.from_numpy(batch.target))
    parameters = list(made.loss.network.parameters())
    made.loss.of_batch(batch, made.place).backward()  # type: ignore[no-untyped-call]
    found = {
        "weights": bytes_of(parameters),
        "gradients": bytes_of(p.grad for p in parameters if p.grad is not None),
        "optimizer": bytes_of(made._optimizers.averages().values()),
        "activations": kept,
    }
    for p in parameters:
        p.grad = None
    return found


def bytes_kept(loss: ReplyLoss, tokens: Tensor, target: Tensor) -> int:
    """What autograd keeps of a forward pass until the backward pass, beside the parameters."""
    kept: dict[int, Tensor] = {}

    def keep(value: Tensor) -> Tensor:
        kept[value.untyped_storage().data_ptr()] = value  # a reference, so that its address is not used again
        return value

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value):
        found = loss(tokens, target)
    # Parameters count elsewhere, those too that FSDP gathered. Gathered layers are freed by now, so their storages are empty.
    for part in [loss, *loss.network.modules()]:
        for p in part.parameters(recurse=False):
            kept.pop((p.to_local() if isinstance(p, DTensor) else p).untyped_storage().data_ptr(), None)
    sizes = [value.untyped_storage().nbytes() for value in kept.values()]
    found.backward()
    loss.zero_grad()
    return sum(sizes)
