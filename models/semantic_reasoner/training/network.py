"""The networks that are trained: the small Qwen3 of the embedded engine, or a base model, whole or with LoRA."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from transformers import AutoModelForCausalLM, PreTrainedModel, PreTrainedTokenizerBase, Qwen3Config, Qwen3ForCausalLM

from models.semantic_reasoner.training.hf_folder import read_config, read_model
from models.semantic_reasoner.training.settings import LanguageModelSettings, LoraSettings, ReasonerTrainingSettings


def new_network(
    settings: LanguageModelSettings, tokenizer: PreTrainedTokenizerBase, max_tokens: int, seed: int
) -> Qwen3ForCausalLM:
    """Makes a Qwen3 that reads ``max_tokens`` tokens of a tokenizer's vocabulary, with weights drawn from a seed."""
    config = Qwen3Config(
        vocab_size=-(-len(tokenizer) // 64) * 64,  # matrix products are faster with a multiple of 64
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
    _initialise_number_embeddings(
        network.get_input_embeddings().weight[:, :width], tokenizer.get_vocab(), config.initializer_range
    )
    _initialise_copy_heads(network, width)
    return network


@torch.no_grad()
def _initialise_number_embeddings(embeddings: Tensor, vocabulary: Mapping[str, int], scale: float) -> None:
    """Gives tokens of close numbers close embeddings: sinusoids of wavelengths 3 to 1,200.

    A layout consists mostly of numbers, and an object in a bowl has about the position of the bowl. From random embeddings the
    network would have to learn for each pair of numbers, such as 45 and 46, that they are close.

    Args:
        embeddings: (V, 2 N), written to: the part of the width that encodes the number of a token.
        vocabulary: Tokens with their indices.
        scale: Standard deviation of the other embeddings; these are larger, so that the first steps do not destroy them.
    """
    if embeddings.is_meta:
        return  # a network without memory
    numbers = {int(word): index for word, index in vocabulary.items() if re.fullmatch(r"-?[0-9]{1,3}", word)}
    values = torch.tensor(sorted(numbers), dtype=torch.float32)
    waves = 2 * math.pi * values[:, None] / torch.logspace(math.log10(3), math.log10(1200), embeddings.shape[1] // 2)
    rows = torch.tensor([numbers[int(v)] for v in values])
    embeddings[rows] = 3 * math.sqrt(2) * scale * torch.cat([waves.sin(), waves.cos()], 1)


@torch.no_grad()
def _initialise_copy_heads(network: Qwen3ForCausalLM, width: int) -> None:
    """Initialises the first query head of each key-value head to copy the number of the token that it attends to.

    To copy a number, a head has to attend to the right token and to output its number, and neither helps without the other:
    from random weights, objects in a bowl still had random positions after thousands of steps. With the output initialised,
    the attention is learned in a few hundred steps. ``width`` is that of the part of an embedding that encodes the number.
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
    """The network of a training, with LoRA if the settings have a rank.

    Args:
        settings: The settings of the training.
        tokenizer: Its tokenizer.
        is_empty: Whether the network has no values and takes no memory (PyTorch's device ``meta``): of ``base`` only the
            configuration is read.

    Attributes:
        network: The causal language model, on the CPU; with LoRA only the added low-rank matrices are trained.

    Raises:
        ConfigError: ``base`` is not a readable model.
    """

    def __init__(
        self, settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase, *, is_empty: bool = False
    ) -> None:
        self._adapter: Any = None
        with torch.device("meta" if is_empty else "cpu"):
            if settings.base:
                folder = Path(settings.base).expanduser()
                self.network: PreTrainedModel = (_empty_model if is_empty else read_model)(folder, settings.max_tokens)
            else:
                self.network = new_network(settings.network, tokenizer, settings.max_tokens, settings.seed)
            if settings.lora.rank:
                self._adapter = _with_lora(self.network.to(torch.float32), settings.lora, settings.seed)
                self.network = self._adapter.get_base_model()
        self.network.train()

    def with_values(self, values: Mapping[str, Tensor]) -> "TrainableNetwork":
        """Sets values by the names of :func:`trainable_parameters`, in float32, and returns the object itself."""
        self.network.to(torch.float32)
        parameters = trainable_parameters(self.network)
        with torch.no_grad():
            for name, value in values.items():
                parameters[name].copy_(value)
        return self

    def to_save(self, settings: ReasonerTrainingSettings) -> Any:
        """Returns the model to save: one of transformers, or an adapter of peft. Do not train the network after that."""
        dtype = getattr(torch, settings.storage)
        if self._adapter is None:
            return self.network.to(dtype).eval()
        if settings.lora.merges:
            return self._adapter.merge_and_unload().to(dtype).eval()
        return self._adapter.to(dtype).eval()


def trainable_parameters(network: PreTrainedModel) -> dict[str, torch.nn.Parameter]:
    """Returns the trained parameters by name; a shared parameter has one name."""
    return {name: p for name, p in network.named_parameters() if p.requires_grad}


def _empty_model(folder: Path, max_tokens: int) -> PreTrainedModel:
    found: PreTrainedModel = AutoModelForCausalLM.from_config(read_config(folder, max_tokens))
    return found


def _with_lora(network: PreTrainedModel, settings: LoraSettings, seed: int) -> Any:
    from peft import LoraConfig, get_peft_model

    config = LoraConfig(r=settings.rank, lora_alpha=settings.alpha, target_modules="all-linear", task_type="CAUSAL_LM")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return get_peft_model(network, config)
