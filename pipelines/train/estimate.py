"""Plans a training of the reasoner without running it (``--dry-run``): examples, tokens, steps, memory and time.

Token lengths of a large table are estimated from a part of it. Memory follows from the sizes of the network. Time is measured
for a small network; for a large one it follows from the number of operations and an assumed speed.
"""

import time
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from transformers import AutoModelForCausalLM, PreTrainedTokenizerBase

from models.semantic_reasoner.training.batch_sampler import padding_of
from models.semantic_reasoner.training.hf_folder import read_config
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.optimizers import is_hidden
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import KINDS, TokenDataset
from models.semantic_reasoner.training.trainer import ReasonerTrainer
from models.training.distributed import ProcessContext
from pipelines.train.reasoner import ReasonerTrainingJob
from pipelines.train.run import training_device

ASSUMED_FLOPS = 4e14
"""Assumed operations per second of each process: 40 % of an H100's peak in bfloat16."""

_READ = 6000  # examples whose token lengths are counted
_MEASURED_WEIGHTS = 5e7  # largest number of weights of a network whose steps are measured
_STEPS = 3
_FLOAT = 4  # bytes of a float32


def training_plan(job: ReasonerTrainingJob, workers: int) -> dict[str, Any]:
    """Describes what a run would do.

    Args:
        job: The job.
        workers: Processes of Ray Train; 0 is this process.

    Returns:
        Settings and figures, ready for JSON.

    Raises:
        ConfigError: The run could not start.
    """
    job.check_start(workers)
    world, source = max(1, workers), job.source()
    examples = {split: source.num_examples(split) for split in ("train", "validation")}
    total = examples["train"].total()
    with TemporaryDirectory() as aside:
        source = replace(source, cache=Path(aside), every=max(1, total // _READ))
        tokenizer = source.tokenizer()
        data = source.load("train", tokenizer)
        scale = total / max(1, len(data) + int(data.too_long.sum() + data.unasked.sum()))
        batches = job.batches(data)
        settings = job.settings.resolved(max(1, round(scale * len(batches))))
        sizes = [
            len(rows) * max(int(data.length[row].sum()) for row in rows) for rows in batches
        ]  # tokens of each batch, with padding
        replies = max(sum(int(data.reply_length[row].sum()) for row in rows) for rows in batches)
        memory = memory_bytes(settings, tokenizer, max(sizes), replies, world)
        tokens_a_step = round(settings.accumulate * sum(sizes) / len(sizes))
        seconds, how = _seconds_a_step(settings, tokenizer, data, memory, tokens_a_step, world)
    return {
        "settings": asdict(settings),
        "data_fingerprint": job.source().fingerprint(),
        "processes": world,
        "examples": {split: dict(counts) for split, counts in examples.items()},
        "examples_read": len(data),
        "tokens": _tokens(data, scale),
        "padding": padding_of(data, batches),
        "steps": settings.steps,
        "tokens_a_step": tokens_a_step,
        "memory_bytes": memory,
        "time": {"seconds": settings.steps * seconds, "tokens_a_second": tokens_a_step / seconds, "how": how},
    }


def _tokens(data: TokenDataset, scale: float) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for kind, name in enumerate(KINDS):
        length, reply = data.length[data.kind == kind], data.reply_length[data.kind == kind]
        if len(length) or data.too_long[kind]:
            found[str(name)] = {
                "prompt_mean": float((length - reply).sum() / max(1, len(length))),
                "reply_mean": float(reply.sum() / max(1, len(length))),
                "longest": int(length.max(initial=0)),
                "total": round(scale * int(length.sum())),
                "too_long": round(scale * int(data.too_long[kind])),
                "unasked": round(scale * int(data.unasked[kind])),
            }
    return found


def memory_bytes(
    settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase, tokens: int, replies: int, world: int
) -> dict[str, int]:
    """Estimates the memory of each process.

    Args:
        settings: The settings of the training.
        tokenizer: Its tokenizer.
        tokens: Tokens of the largest batch, with padding.
        replies: Largest number of tokens in a batch for which the loss is computed.
        world: Number of processes, which share weights, gradients and averages.

    Returns:
        Bytes by use; also the numbers of weights and of trained weights.
    """
    with torch.device("meta"):
        network: Any = (
            AutoModelForCausalLM.from_config(read_config(Path(settings.base).expanduser(), settings.max_tokens))
            if settings.base
            else new_network(settings.network, tokenizer, settings.max_tokens, settings.seed)
        )
    config, rank, layers = network.config, settings.lora.rank, network.model.layers
    num_weights, num_layer = (sum(p.numel() for p in module.parameters()) for module in (network, layers[0]))
    linear = [module for module in network.model.modules() if isinstance(module, torch.nn.Linear)]
    num_low_rank = sum(rank * (module.in_features + module.out_features) for module in linear)
    num_hidden = sum(p.numel() for name, p in network.named_parameters() if is_hidden(name, p))
    trained, of_muon = (num_low_rank, num_low_rank) if rank else (num_weights, num_hidden)
    averages = 2 * trained - (
        of_muon if settings.optimizer == "muon" else 0
    )  # AdamW stores two averages of each weight, Muon one
    size = 2 if settings.precision == "bfloat16" else _FLOAT  # bytes of a factor in matrix products
    head = getattr(config, "head_dim", None) or config.hidden_size // config.num_attention_heads
    heads = (config.num_attention_heads + config.num_key_value_heads) * head
    # The backward pass of a layer needs, for each token, the inputs of norms, attention and products, and weights in bfloat16.
    of_layer = tokens * (24 * config.hidden_size + 16 * heads + 4 * size * config.intermediate_size)
    of_layer += 2 * num_layer if size == 2 else 0
    inputs = tokens * config.hidden_size * _FLOAT * len(layers)
    activations = inputs + 2 * of_layer if settings.recomputes else (len(layers) + 1) * of_layer  # one more for the gradients
    logits = (min(replies, 1024) if settings.recomputes else replies) * config.vocab_size * (2 + 3 * _FLOAT)
    # Not sharded while in use: embedding and head with their gradients; a layer, its gradient and the next layer.
    whole = 2 * (num_weights - len(layers) * num_layer) + 3 * num_layer if world > 1 else 0
    numbers = {"weights": num_weights / world, "gradients": trained / world, "optimizer": averages / world, "gathered": whole}
    parts = {name: round(_FLOAT * number) for name, number in numbers.items()} | {"activations": activations + logits}
    totals = {"each_process": sum(parts.values()), "checkpoint": _FLOAT * (trained + averages)}
    return {"num_weights": num_weights, "num_trained": trained, **parts, **totals}


def _seconds_a_step(
    settings: ReasonerTrainingSettings,
    tokenizer: PreTrainedTokenizerBase,
    data: TokenDataset,
    memory: dict[str, int],
    tokens: int,
    world: int,
) -> tuple[float, str]:
    """The seconds of a step, and how they were obtained."""
    if memory["num_weights"] <= _MEASURED_WEIGHTS and world == 1:
        training = ReasonerTrainer(data, settings, tokenizer, ProcessContext(training_device()))
        training.advance()  # the first step allocates buffers; it is not measured
        began = time.perf_counter()
        for _ in range(_STEPS):
            training.advance()
        return (time.perf_counter() - began) / _STEPS, f"measured on {training_device().type}"
    # For each weight and token: 2 operations forward, 2 for the gradient of the input, 2 for that of a trained weight.
    operations = memory["num_weights"] * (6 if settings.recomputes else 4) + 2 * memory["num_trained"]
    return tokens * operations / (ASSUMED_FLOPS * world), f"assumed: {ASSUMED_FLOPS / 1e12:g} TFLOP/s for each process"
