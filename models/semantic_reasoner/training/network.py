"""The networks that are trained: the small Qwen3 of the embedded engine, or a base model, adapted or whole."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from transformers import PreTrainedModel, PreTrainedTokenizerBase, Qwen3Config, Qwen3ForCausalLM

from models.semantic_reasoner.training.hf_folder import read_model
from models.semantic_reasoner.training.settings import LanguageModelSettings, LoraSettings, ReasonerTrainingSettings


def new_network(
    settings: LanguageModelSettings, tokenizer: PreTrainedTokenizerBase, max_tokens: int, seed: int
) -> Qwen3ForCausalLM:
    """A Qwen3 with weights drawn from a seed.

    Args:
        settings: Its shape.
        tokenizer: Whose vocabulary it reads.
        max_tokens: Longest sequence that it is made for.
        seed: Of the weights.
    """
    config = Qwen3Config(
        vocab_size=-(-len(tokenizer) // 64) * 64,  # a multiple of 64 is faster to multiply with
        hidden_size=settings.hidden,
        num_hidden_layers=settings.layers,
        num_attention_heads=settings.heads,
        num_key_value_heads=settings.key_value_heads,
        head_dim=settings.head,
        intermediate_size=settings.intermediate,
        max_position_embeddings=max_tokens,
        rope_parameters={"rope_type": "default", "rope_theta": 10_000.0},
        tie_word_embeddings=True,
        pad_token_id=tokenizer.pad_token_id,
        eos_token_id=tokenizer.eos_token_id,
        bos_token_id=None,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Qwen3ForCausalLM(config)
    width = 2 * (settings.hidden // 8)
    _order_numbers(network.get_input_embeddings().weight[:, :width], tokenizer.get_vocab(), config.initializer_range)
    _hand_numbers_on(network, width)
    return network


@torch.no_grad()
def _order_numbers(embeddings: Tensor, vocabulary: Mapping[str, int], scale: float) -> None:
    """Puts near numbers near each other, by waves of 3 to 1,200.

    A layout is mostly numbers, and what stands in a bowl stands where the bowl stands, give or take. Drawn at random, that 45
    is next to 46 would have to be learned for each of them.

    Args:
        embeddings: (V, 2 N), written to: the part of the width that says which number a token is.
        vocabulary: Tokens.
        scale: Of the other embeddings; these are larger, so that the first steps do not blur them.
    """
    if embeddings.is_meta:
        return  # a network that is only counted
    numbers = {int(word): index for word, index in vocabulary.items() if re.fullmatch(r"-?[0-9]{1,3}", word)}
    values = torch.tensor(sorted(numbers), dtype=torch.float32)
    waves = 2 * math.pi * values[:, None] / torch.logspace(math.log10(3), math.log10(1200), embeddings.shape[1] // 2)
    rows = torch.tensor([numbers[int(v)] for v in values])
    embeddings[rows] = 3 * math.sqrt(2) * scale * torch.cat([waves.sin(), waves.cos()], 1)


@torch.no_grad()
def _hand_numbers_on(network: Qwen3ForCausalLM, width: int) -> None:
    """Lets the first query head of each pair of key and value hand on the number that it looks at, as that number.

    Copying takes two things, looking at the right token and saying what it says, and neither pays without the other: from
    random weights alone, what stands in a bowl stood anywhere after thousands of steps. With the second given, the first is
    learned in a few hundred.

    Args:
        network: Written to.
        width: Of the part of an embedding that says which number it is.
    """
    head = int(network.config.head_dim)
    heads_each = int(network.config.num_attention_heads) // int(network.config.num_key_value_heads)
    number = torch.arange(min(width, head))
    for layer in network.model.layers:
        value, output = layer.self_attn.v_proj.weight, layer.self_attn.o_proj.weight
        for start in range(0, len(value), head):
            columns = slice(start * heads_each, start * heads_each + head)
            value[start : start + head] *= 0.1
            output[:, columns] *= 0.1
            value[start + number, number] += 0.2
            output[number, columns.start + number] += 0.2


class TrainableNetwork:
    """A network and what of it is trained.

    Args:
        settings: Of the training.
        tokenizer: Whose vocabulary a new network reads.

    Attributes:
        network: The causal language model, on the CPU; under LoRA its linear layers have matrices beside them, and these alone
            are trained.

    Raises:
        ConfigError: ``base`` is no model that can be read.
    """

    def __init__(self, settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase) -> None:
        self._adapted: Any = None
        if settings.base:
            self.network = read_model(Path(settings.base).expanduser(), settings.max_tokens)
        else:
            self.network = new_network(settings.network, tokenizer, settings.max_tokens, settings.seed)
        if settings.lora.rank:
            self._adapted = _adapted(self.network.to(torch.float32), settings.lora, settings.seed)
            self.network = self._adapted.get_base_model()
        self.network.train()

    def with_values(self, values: Mapping[str, Tensor]) -> "TrainableNetwork":
        """The same with these values, by the names of :func:`trainable_parameters`, in float32."""
        self.network.to(torch.float32)
        parameters = trainable_parameters(self.network)
        with torch.no_grad():
            for name, value in values.items():
                parameters[name].copy_(value)
        return self

    def to_keep(self, settings: ReasonerTrainingSettings) -> Any:
        """What is kept of it in the end: a model of transformers, or an adapter of peft. It cannot be trained on after that."""
        dtype = getattr(torch, settings.storage)
        if self._adapted is None:
            return self.network.to(dtype).eval()
        if settings.lora.merges:
            return self._adapted.merge_and_unload().to(dtype).eval()
        return self._adapted.to(dtype).eval()


def trainable_parameters(network: PreTrainedModel) -> dict[str, torch.nn.Parameter]:
    """The parameters that are trained, by name; one that has two places has one name."""
    return {name: p for name, p in network.named_parameters() if p.requires_grad}


def _adapted(network: PreTrainedModel, settings: LoraSettings, seed: int) -> Any:
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(r=settings.rank, lora_alpha=settings.alpha, target_modules="all-linear", task_type="CAUSAL_LM")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return get_peft_model(network, config)
