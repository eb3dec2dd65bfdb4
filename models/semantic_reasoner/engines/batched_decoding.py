"""Batched decoding with a key-value cache of slots: sequences of different lengths share a step and leave it when finished.

In a plain cache all sequences of a batch grow together, so that a batch takes as long as its longest reply. Here each sequence
has a slot and its own length. The used slots are contiguous, so that a step reads views of the cache and copies nothing.
"""

import torch
from torch import Tensor
from transformers import AttentionInterface, PreTrainedModel
from transformers.cache_utils import Cache, CacheLayerMixin

from models.semantic_reasoner.engines.qwen3_step import Qwen3Step

ATTENTION = "stable_data_slots"
"""Name of :func:`slot_attention` in transformers."""

_GROWTH = 256  # tokens by which the cache grows at a time


def slot_attention(
    module: torch.nn.Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Tensor | None, **more: object
) -> tuple[Tensor, None]:
    """Computes attention with key and value heads that several query heads share, without a copy for each of them.

    Args:
        module: The layer; unused.
        query: (B, H, Q, C).
        key: (B, K, T, C), K a divisor of H.
        value: (B, K, T, C).
        attention_mask: Added to the scores, (B, 1, 1, T); None: causal, Q = T.
        more: Further arguments of transformers, with ``scaling``.

    Returns:
        (B, Q, H, C), and no weights.
    """
    scaling = more.get("scaling")
    assert isinstance(scaling, float)
    if attention_mask is None:
        attended = torch.nn.functional.scaled_dot_product_attention(
            query, key, value, is_causal=query.shape[2] > 1, scale=scaling, enable_gqa=True
        )
        return attended.transpose(1, 2), None
    batch, heads, _, width = query.shape
    grouped = query.view(batch, key.shape[1], heads // key.shape[1], width)
    weights = torch.softmax(torch.matmul(grouped, key.transpose(2, 3)) * scaling + attention_mask, -1)
    return torch.matmul(weights, value).view(batch, 1, heads, width), None


AttentionInterface.register(ATTENTION, slot_attention)


class _SlotLayer(CacheLayerMixin):  # type: ignore[misc]
    """Keys and values of one layer, (slots, K, tokens, C)."""

    def __init__(self, cache: "SlotCache") -> None:
        super().__init__()
        self._cache = cache

    def lazy_initialization(self, key_states: Tensor, value_states: Tensor) -> None:
        """Allocates the keys and values."""
        _, heads, _, width = key_states.shape
        shape = (self._cache.num_slots, heads, self._cache.capacity, width)
        self.keys, self.values = key_states.new_zeros(shape), value_states.new_zeros(shape)
        self.is_initialized = True

    def update(self, key_states: Tensor, value_states: Tensor, *args: object, **kwargs: object) -> tuple[Tensor, Tensor]:
        """Writes new keys and values, and returns those that the step attends to."""
        if not self.is_initialized:
            self.lazy_initialization(key_states, value_states)
        assert self.keys is not None
        assert self.values is not None
        if missing := self._cache.capacity - self.keys.shape[2]:
            self.keys = torch.nn.functional.pad(self.keys, (0, 0, 0, missing))
            self.values = torch.nn.functional.pad(self.values, (0, 0, 0, missing))
        first, count, size = self._cache.first, len(key_states), key_states.shape[2]
        if self._cache.positions is None:
            self.keys[first : first + count, :, :size] = key_states
            self.values[first : first + count, :, :size] = value_states
            return key_states, value_states  # new sequences have no older tokens
        rows = torch.arange(count, device=key_states.device)  # one token for each sequence, at its own position
        self.keys[rows, :, self._cache.positions] = key_states[:, :, 0]
        self.values[rows, :, self._cache.positions] = value_states[:, :, 0]
        return self.keys[:count, :, : self._cache.width], self.values[:count, :, : self._cache.width]

    def get_mask_sizes(self, query_length: int) -> tuple[int, int]:
        """Unused, since masks are given."""
        return self._cache.width, 0

    def get_seq_length(self) -> int:
        """Unused, since positions are given."""
        return 0

    def get_max_length(self) -> int:
        """Returns -1: no bound."""
        return -1


class SlotCache(Cache):  # type: ignore[misc]
    """A key-value cache of ``num_layers`` layers in which each of at most ``num_slots`` sequences has a slot."""

    def __init__(self, num_layers: int, num_slots: int) -> None:
        self.num_slots, self.capacity = num_slots, _GROWTH
        self.first, self.width = 0, 0
        self.positions: Tensor | None = None
        self._slots = [_SlotLayer(self) for _ in range(num_layers)]
        super().__init__(layers=list(self._slots))

    def reserve(self, width: int) -> None:
        """Grows the capacity to at least ``width`` tokens of a sequence."""
        if width > self.capacity:
            self.capacity = -(-width // _GROWTH) * _GROWTH

    def move(self, source: int, target: int, length: int) -> None:
        """Copies the first ``length`` tokens of a slot to another."""
        for layer in self._slots:
            if layer.keys is not None and layer.values is not None:
                layer.keys[target, :, :length] = layer.keys[source, :, :length]
                layer.values[target, :, :length] = layer.values[source, :, :length]


class Decoder:
    """The sequences that are being decoded.

    Args:
        model: A causal language model whose attention is :data:`ATTENTION`.
        num_slots: Largest number of sequences at a time.
        pad: Any token.

    Attributes:
        lengths: Number of tokens of each sequence in the cache, in slot order.
    """

    def __init__(self, model: PreTrainedModel, num_slots: int, pad: int) -> None:
        self._model, self._pad = model, pad
        self._step = Qwen3Step(model) if Qwen3Step.knows(model) else None
        self._cache = SlotCache(model.config.get_text_config().num_hidden_layers, num_slots)
        self.num_slots = num_slots
        self.lengths: list[int] = []

    @torch.inference_mode()
    def admit(self, prompts: list[list[int]]) -> Tensor:
        """Reads the prompts of new sequences into the next free slots.

        Returns:
            Logits of the token after each prompt, (len(prompts), V).
        """
        width = max(map(len, prompts))
        cache, device = self._cache, self._model.device
        cache.reserve(width)
        cache.first, cache.positions, cache.width = len(self.lengths), None, width
        tokens = torch.tensor([p + [self._pad] * (width - len(p)) for p in prompts], device=device)
        hidden = self._forward(tokens, torch.arange(width, device=device).expand_as(tokens), None)
        last = torch.tensor([len(p) - 1 for p in prompts], device=device)
        self.lengths += map(len, prompts)
        return self._logits(hidden[torch.arange(len(prompts), device=device), last])

    @torch.inference_mode()
    def step(self, tokens: list[int]) -> Tensor:
        """Appends one token to each sequence, in slot order.

        Returns:
            Logits of the next tokens, (len(tokens), V).
        """
        cache, device = self._cache, self._model.device
        positions = torch.tensor(self.lengths, device=device)
        self.lengths = [n + 1 for n in self.lengths]
        cache.width = max(self.lengths)
        cache.reserve(cache.width)
        cache.first, cache.positions = 0, positions
        # Sequences that are shorter than the longest one do not attend to the rest of their slots.
        hides = torch.arange(cache.width, device=device)[None] > positions[:, None]
        mask = torch.zeros(hides.shape, dtype=self._model.dtype, device=device).masked_fill_(hides, -torch.inf)[:, None, None]
        read = torch.tensor(tokens, device=device)
        if self._step is not None:
            return self._logits(self._step(read, positions, mask if min(self.lengths) < cache.width else None, cache))
        return self._logits(self._forward(read[:, None], positions[:, None], mask)[:, 0])

    def _forward(self, tokens: Tensor, positions: Tensor, mask: Tensor | None) -> Tensor:
        # A mask by attention type is used unchanged; for any other the decoder makes a mask for a cache that grows.
        types = set(getattr(self._model.config.get_text_config(), "layer_types", None) or ["full_attention"])
        hidden: Tensor = self._model.model(
            input_ids=tokens,
            position_ids=positions,
            attention_mask=dict.fromkeys(types, mask),
            past_key_values=self._cache,
            use_cache=True,
        ).last_hidden_state
        return hidden

    def _logits(self, hidden: Tensor) -> Tensor:
        logits: Tensor = self._model.lm_head(hidden)
        return logits.float()

    def rewind(self, slot: int, length: int) -> None:
        """Removes the tokens of a sequence after the first ``length``."""
        self.lengths[slot] = length

    @torch.inference_mode()
    def release(self, slot: int) -> int | None:
        """Ends a sequence and moves the last one to its slot, so that used slots stay contiguous.

        Returns:
            The former slot of the moved sequence; None if the ended one was the last.
        """
        last = len(self.lengths) - 1
        if slot != last:
            self._cache.move(last, slot, self.lengths[last])
            self.lengths[slot] = self.lengths[last]
        self.lengths.pop()
        return None if slot == last else last
