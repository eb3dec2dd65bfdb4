"""Plans a training of the reasoner without running it (``--dry-run``): examples, tokens, steps, memory and time.

Token lengths of a large table are estimated from a part of it. Memory follows from the sizes of the network. Time is measured
for a small network; for a large one it follows from the number of operations and an assumed speed.
"""

import time
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.training.batch_sampler import padding_of
from models.semantic_reasoner.training.loss import HEAD_CHUNK
from models.semantic_reasoner.training.network import TrainableNetwork
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
_FLOAT, _LOW = 4, 2  # bytes of a float32 and of a bfloat16


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
        Bytes of a process by use: ``weights``, ``gradients`` and ``optimizer`` are exact, of the first process, whose shards are
        the largest; ``gathered`` are whole weights and gradients while they are in use; ``activations`` are kept from the forward
        to the backward pass; ``working`` is the most that the backward pass takes at a time. Also the bytes of a checkpoint, and
        the numbers of weights and of trained weights.
    """
    network: Any = TrainableNetwork(settings, tokenizer, is_empty=True).network
    parameters = dict(network.named_parameters())
    trained = {name: p for name, p in parameters.items() if p.requires_grad}
    averages = {name: 1 if settings.optimizer == "muon" and is_hidden(name, p) else 2 for name, p in trained.items()}
    shard = {name: -(-len(p) // world) * (p.numel() // len(p)) for name, p in parameters.items()}  # as fully_shard cuts them
    kept, working = _activations(network, settings, tokens, replies, world)
    parts = {
        "weights": _FLOAT * sum(shard.values()),
        "gradients": _FLOAT * sum(shard[name] for name in trained),
        "optimizer": _FLOAT * sum(count * shard[name] for name, count in averages.items()),
        "gathered": _gathered(network, settings) if world > 1 else 0,
        "activations": kept,
        "working": working,
    }
    saved = _FLOAT * sum((1 + averages[name]) * p.numel() for name, p in trained.items())
    counts = {"num_weights": _count(parameters.values()), "num_trained": _count(trained.values())}
    return {**counts, **parts, "each_process": sum(parts.values()), "checkpoint": saved}


def _activations(network: Any, settings: ReasonerTrainingSettings, tokens: int, replies: int, world: int) -> tuple[int, int]:
    """The bytes that a process keeps for the backward pass, and the most that the backward pass takes at a time besides."""
    config, layers = network.config, network.model.layers
    width, is_low, has_lora = config.hidden_size, settings.precision == "bfloat16", settings.lora.rank > 0
    size = _LOW if is_low else _FLOAT  # of a factor in matrix products
    head = getattr(config, "head_dim", None) or width // config.num_attention_heads
    heads = (config.num_attention_heads + config.num_key_value_heads) * head
    # For each token, float32: the inputs of two norms and, where their weights are trained, their results; the same for queries
    # and keys. Factors: five inputs of products, of which equal ones are one in float32; four of the feed-forward layer.
    of_norms = 2 * _FLOAT if has_lora else 4 * _FLOAT
    of_token = width * (of_norms + (5 if is_low else 2) * size) + heads * (16 - (size if has_lora else 0))
    of_token += 4 * size * config.intermediate_size + 7 * size * settings.lora.rank
    # Autocast makes copies of weights in bfloat16, except where layers are gathered in it.
    copies = _LOW * _count(layers[0].parameters()) if is_low and world == 1 else 0
    of_layer = tokens * of_token + copies
    # The head: its weights as a factor with their gradient, and for each logit its values in both formats and their gradient.
    num_head = network.lm_head.weight.numel()
    of_head = num_head * (_LOW if is_low else 0)
    of_gradient = num_head * ((_LOW if is_low else 0) + _FLOAT) if network.lm_head.weight.requires_grad else 0
    logits = (min(replies, HEAD_CHUNK) if settings.recomputes else replies) * config.vocab_size
    of_loss = tokens * width * (_FLOAT if has_lora else 2 * _FLOAT) + replies * width * _FLOAT  # the last norm
    if settings.recomputes:
        kept = of_loss + len(layers) * tokens * width * _FLOAT
        working = max(2 * of_layer, logits * (_LOW + 3 * _FLOAT) + of_head + of_gradient)
    else:
        kept = of_loss + len(layers) * of_layer + logits * _FLOAT + of_head + (replies * width * size if is_low else 0)
        working = max(of_layer, logits * (_LOW + 2 * _FLOAT) + of_gradient)
    return kept, working


def _gathered(network: Any, settings: ReasonerTrainingSettings) -> int:
    """The bytes of whole weights and gradients in use at a time: embedding and head, a layer, and the next one on its way."""
    layer, head = list(network.model.layers[0].parameters()), network.lm_head.weight
    inside = {id(p) for p in network.model.layers.parameters()}
    rest = [p for p in network.parameters() if id(p) not in inside]
    size = _LOW if settings.precision == "bfloat16" else _FLOAT
    # A layer and the next, which arrives in one piece and is then taken apart; gradients, and those that are being added up.
    of_layer = 3 * size * _count(layer) + (size + _FLOAT) * _count(p for p in layer if p.requires_grad)
    # The gradient of separate embeddings comes last, when the activations are gone.
    return of_layer + _FLOAT * (_count(rest) + (head.numel() if head.requires_grad else 0))


def _count(parameters: Iterable[torch.Tensor]) -> int:
    return sum(p.numel() for p in parameters)


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
