"""The small Qwen3 of the embedded engine, and its folder: a plain Hugging Face model that any of its tools loads."""

import torch
from transformers import PreTrainedTokenizerBase, Qwen3Config, Qwen3ForCausalLM

from models.semantic_reasoner.training_settings import NetworkSettings


def new_network(settings: NetworkSettings, tokenizer: PreTrainedTokenizerBase, max_tokens: int, seed: int) -> Qwen3ForCausalLM:
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
        return Qwen3ForCausalLM(config)
