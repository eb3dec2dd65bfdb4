"""What a training of the reasoner would do: examples, tokens, steps, memory and time, before anything is kept (``--dry-run``).

Lengths come from a part of the table where it is large; memory is counted on a network of the same widths and one or two
layers; time is measured where the network is small enough to try, else it follows from the arithmetic and a stated speed.
"""

import time
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from transformers import AutoModelForCausalLM, PreTrainedTokenizerBase

from models.semantic_reasoner.training.batch_sampler import batches_of_pass, padding_of
from models.semantic_reasoner.training.hf_folder import read_config
from models.semantic_reasoner.training.loss import ReplyLoss, put_in_place
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.optimizers import is_hidden
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import KINDS, TokenDataset
from models.semantic_reasoner.training.trainer import ReasonerTrainer
from models.training.distributed import CPU, ProcessContext
from pipelines.train.reasoner import ReasonerTrainingJob
from pipelines.train.run import here
from stable_data.errors import ConfigError

ASSUMED_FLOPS = 4e14
"""Arithmetic operations a second of each process where nothing can be measured: 40 % of an H100's peak in bfloat16."""

_READ = 6000  # examples whose lengths are looked at
_TRIED = 5e7  # parameters up to which a few steps are measured
_STEPS = 3
_QUANTILES = (0.5, 0.9, 0.99, 1.0)
_FLOAT = 4  # bytes
_PARTS = ("weights", "gradients", "optimizer", "gathered", "activations")


def plan_of(job: ReasonerTrainingJob, workers: int) -> dict[str, Any]:
    """What a run would do.

    Args:
        job: The job.
        workers: Processes of Ray Train; 0 is this process.

    Returns:
        Settings and figures, as JSON takes them.

    Raises:
        ConfigError: It could not start.
    """
    settings, world = job.settings, max(1, workers)
    if settings.accumulate % world:
        raise ConfigError(f"accumulate is {settings.accumulate}, expected a multiple of --workers {workers}", "config_invalid")
    source = job.source()
    examples = {"train": source.num_examples("train"), "validation": source.num_examples("validation")}
    total = examples["train"].total()
    with TemporaryDirectory() as aside:
        source = replace(source, cache=Path(aside), every=max(1, total // _READ))
        tokenizer = source.tokenizer()
        data = source.load("train", tokenizer)
        scale = total / max(1, len(data) + int(data.too_long.sum() + data.unasked.sum()))
        batches = batches_of_pass(data, settings, 0)
        if not batches:
            raise ConfigError("shares leave no example of those that there are, expected some", "config_invalid")
        resolved = settings.resolved(max(1, round(scale * len(batches))))
        tokens_of_step = float(np.mean([_places(data, rows) for rows in batches])) * settings.accumulate
        plan = {
            "settings": asdict(resolved),
            "data_fingerprint": source.fingerprint(),
            "processes": world,
            "examples": {split: dict(counts) for split, counts in examples.items()},
            "examples_read": len(data),
            "tokens": _tokens(data, scale),
            "padding": _padding(data, settings),
            "steps": resolved.steps,
            "tokens_a_step": round(tokens_of_step),
            "memory_bytes": _memory(resolved, tokenizer, data, world),
        }
        plan["time"] = _time(resolved, tokenizer, data, plan, world)
    return plan


def _tokens(data: TokenDataset, scale: float) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for kind, name in enumerate(KINDS):
        members = data.kind == kind
        num_left_out = int(data.too_long[kind])
        if not members.any() and not num_left_out:
            continue
        length, reply = data.length[members], data.reply_length[members]
        found[str(name)] = {
            "prompt_mean": float((length - reply).mean()) if len(length) else 0.0,
            "reply_mean": float(reply.mean()) if len(length) else 0.0,
            "quantiles": dict(zip(map(str, _QUANTILES), np.quantile(length, _QUANTILES).tolist(), strict=True))
            if len(length)
            else {},
            "total": round(scale * int(length.sum())),
            "too_long": round(scale * num_left_out),
            "unasked": round(scale * int(data.unasked[kind])),
        }
    return found


def _padding(data: TokenDataset, settings: ReasonerTrainingSettings) -> dict[str, float]:
    packs = {"grouped": False, "packed": True}
    return {name: padding_of(data, batches_of_pass(data, replace(settings, packs=way), 0)) for name, way in packs.items()}


def _places(data: TokenDataset, rows: list[list[int]]) -> int:
    return len(rows) * max(int(data.length[row].sum()) for row in rows)


def _config(settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase) -> Any:
    if settings.base:
        return read_config(Path(settings.base).expanduser(), settings.max_tokens)
    with torch.device("meta"):
        return new_network(settings.network, tokenizer, settings.max_tokens, settings.seed).config


def _memory(
    settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase, data: TokenDataset, world: int
) -> dict[str, Any]:
    """Bytes of each process."""
    config = _config(settings, tokenizer)
    with torch.device("meta"):
        network = AutoModelForCausalLM.from_config(config)
    num_weights = sum(p.numel() for p in network.parameters())
    num_trained = num_averaged_once = _num_trained(network, settings) if settings.lora.rank else num_weights
    if not settings.lora.rank:
        num_averaged_once = sum(p.numel() for name, p in network.named_parameters() if is_hidden(name, p))
    num_averages = 2 * num_trained - (num_averaged_once if settings.optimizer == "muon" else 0)
    per_token, per_layer = _saved_by_a_layer(config, settings)
    rows = max(batches_of_pass(data, settings, 0), key=lambda rows: _places(data, rows))
    places = _places(data, rows)
    replies = sum(int(data.reply_length[row].sum()) for row in rows)
    layers = config.num_hidden_layers
    of_layer = per_token * places + per_layer
    if settings.recomputes:
        kept = layers * places * config.hidden_size * _FLOAT + of_layer  # what goes into each, and one of them again
        replies = min(replies, 1024)
    else:
        kept = layers * of_layer
    kept += of_layer  # gradients, of about what one layer keeps
    logits = replies * config.vocab_size * (2 + 3 * _FLOAT)  # bfloat16; float32, its logarithmic softmax and its gradient
    of_one = sum(p.numel() for p in network.model.layers[0].parameters())
    outside = num_weights - sum(p.numel() for p in network.model.layers.parameters())
    # Whole on each process while they are used: embedding and head with their gradients; a layer, its gradient and the next
    # one.
    gathered = _FLOAT * (2 * outside + 3 * of_one) if world > 1 else 0
    parts = {
        "weights": _FLOAT * num_weights / world,
        "gradients": _FLOAT * num_trained / world,
        "optimizer": _FLOAT * num_averages / world,
        "gathered": gathered,
        "activations": kept + logits,
    }
    figures = {name: round(size) for name, size in parts.items()}
    total = {"each_process": sum(figures.values()), "checkpoint": round(_FLOAT * (num_trained + num_averages))}
    return {"num_weights": num_weights, "num_trained": num_trained, **figures, **total}


def _num_trained(network: Any, settings: ReasonerTrainingSettings) -> int:
    linear = [m for m in network.model.modules() if isinstance(m, torch.nn.Linear)]
    return sum(settings.lora.rank * (m.in_features + m.out_features) for m in linear)


def _saved_by_a_layer(config: Any, settings: ReasonerTrainingSettings) -> tuple[float, float]:
    """Bytes that the backward pass of one layer needs: for each token, and whatever the tokens are."""
    found = {(layers, length): _saved(config, layers, length, settings) for layers in (1, 2) for length in (32, 64)}
    short, long = (found[2, length] - found[1, length] for length in (32, 64))
    return (long - short) / 32, max(0.0, 2 * short - long)


def _saved(config: Any, layers: int, length: int, settings: ReasonerTrainingSettings) -> int:
    """Bytes kept for the backward pass of a network of the same widths, its parameters left out."""
    values = config.to_dict() | {"num_hidden_layers": layers, "vocab_size": 64, "pad_token_id": None}
    if values.get("layer_types"):
        values["layer_types"] = values["layer_types"][:1] * layers
    small = type(config)(**values)
    network: Any = AutoModelForCausalLM.from_config(small, dtype=torch.float32)
    if here().type == "cpu":
        put_in_place(ReplyLoss(network, replace(settings, recomputes=False, compiles=False)), CPU)  # attention as it is there
    own = {p.untyped_storage().data_ptr() for p in network.parameters()}
    kept: dict[int, int] = {}

    def keep(value: torch.Tensor) -> torch.Tensor:
        storage = value.untyped_storage()
        if storage.data_ptr() not in own:
            kept[storage.data_ptr()] = storage.nbytes()
        return value

    is_low = settings.precision == "bfloat16"
    hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value)
    with hooks, torch.autocast("cpu", torch.bfloat16, enabled=is_low, cache_enabled=False):
        hidden = network.model(input_ids=torch.zeros((1, length), dtype=torch.long), use_cache=False).last_hidden_state
    del hidden
    return sum(kept.values())


def _time(
    settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase, data: TokenDataset, plan: dict[str, Any], world: int
) -> dict[str, Any]:
    memory, tokens = plan["memory_bytes"], plan["tokens_a_step"]
    if memory["num_weights"] <= _TRIED and world == 1:
        measured = _measured(settings, tokenizer, data)
        return {"seconds": plan["steps"] * tokens / measured, "tokens_a_second": measured, "how": f"measured on {here().type}"}
    # 2 a weight and token forward, 2 for the gradient of what goes in, 2 for that of the weight where it is trained.
    passes = (4 if settings.recomputes else 2) + 2
    operations = memory["num_weights"] * passes + 2 * memory["num_trained"]
    speed = ASSUMED_FLOPS * world / operations
    how = f"assumed: {ASSUMED_FLOPS / 1e12:g} TFLOP/s a process"
    return {"seconds": plan["steps"] * tokens / speed, "tokens_a_second": speed, "how": how}


def _measured(settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase, data: TokenDataset) -> float:
    """Tokens a second, padding included, of a few steps after a first one."""
    training = ReasonerTrainer(data, settings, tokenizer, ProcessContext(here()))
    training.advance()
    batches = batches_of_pass(data, settings, 0)[settings.accumulate : (1 + _STEPS) * settings.accumulate]
    began = time.perf_counter()
    done = 0
    while done < len(batches):
        training.advance()
        done += settings.accumulate
    tokens = sum(_places(data, rows) for rows in batches)
    if not tokens:  # all was in the first step
        began = time.perf_counter()
        training.advance()
        tokens = sum(_places(data, rows) for rows in batches_of_pass(data, settings, 1)[: settings.accumulate])
    return tokens / (time.perf_counter() - began)


# --- page ---------------------------------------------------------------------------------------------------------------------


def page_of(plan: dict[str, Any]) -> str:
    """A plan as a page to read."""
    memory, settings = plan["memory_bytes"], plan["settings"]
    trained = f", {_count(memory['num_trained'])} trained" if memory["num_trained"] != memory["num_weights"] else ""
    way = "packed" if settings["packs"] else "grouped"
    lines = [
        f"network     {settings['base'] or 'from scratch'}: {_count(memory['num_weights'])} weights{trained}",
        *(f"{split:<12}{_listed(counts)}" for split, counts in plan["examples"].items()),
        "",
        f"{'tokens':<12}{'prompt':>8}{'reply':>8}{'median':>8}{'90 %':>8}{'99 %':>8}{'longest':>9}{'total':>10}{'too long':>10}",
    ]
    for kind, of in plan["tokens"].items():
        quantiles = "".join(f"{q:>{w}.0f}" for q, w in zip(of["quantiles"].values(), (8, 8, 8, 9), strict=False))
        means = f"{of['prompt_mean']:>8.0f}{of['reply_mean']:>8.0f}"
        lines.append(f"{kind:<12}{means}{quantiles:>33}{_count(of['total']):>10}{of['too_long']:>10,}")
    if plan["examples_read"] < sum(plan["examples"]["train"].values()):
        lines.append(f"            lengths from {plan['examples_read']:,} examples, totals scaled")
    padding = ", ".join(f"{name} {100 * share:.1f} %" for name, share in plan["padding"].items())
    seconds = plan["time"]["seconds"]
    lines += [
        "",
        f"padding     {padding}; this run: {way}",
        f"steps       {plan['steps']:,} of about {plan['tokens_a_step']:,} tokens, batches of each: {settings['accumulate']}",
        f"time        {_duration(seconds)} at {plan['time']['tokens_a_second']:,.0f} tokens a second ({plan['time']['how']})",
        f"memory      {_size(memory['each_process'])} in each of {plan['processes']}: "
        + ", ".join(f"{name} {_size(memory[name])}" for name in _PARTS if memory[name]),
        f"checkpoint  {_size(memory['checkpoint'])}, gathered by the first process",
    ]
    return "\n".join(lines)


def _listed(counts: dict[str, int]) -> str:
    return f"{sum(counts.values()):,} examples ({', '.join(f'{kind} {count:,}' for kind, count in counts.items())})"


def _count(number: float) -> str:
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.0f}"


def _size(number: float) -> str:
    for size, unit in ((1e9, "GB"), (1e6, "MB")):
        if number >= size:
            return f"{number / size:.3g} {unit}"
    return f"{number / 1e3:.3g} kB"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min" if minutes else "under a minute"
