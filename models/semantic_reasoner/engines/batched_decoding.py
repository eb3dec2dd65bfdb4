"""Batched decoding with a key-value cache of slots: sequences of any length share a step, and finished ones make room for others.

A plain cache is one tensor that all sequences grow together, so that a batch takes as long as its longest reply. Here each
sequence has a slot and its own length, and slots in use are kept next to each other, so that a step reads views of the cache
and copies nothing.
"""

import torch
from torch import Tensor
from transformers import AttentionInterface, PreTrainedModel
from transformers.cache_utils import Cache, CacheLayerMixin

from models.semantic_reasoner.engines.qwen3_step import Qwen3Step

ATTENTION = "stable_data_slots"
"""Name under which the attention below is registered with transformers."""

_GROWTH = 256  # the cache grows by so many tokens at a time


def slot_attention(
    module: torch.nn.Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Tensor | None, **more: object
) -> tuple[Tensor, None]:
    """Attention whose key and value heads are shared by several query heads without being repeated in memory.

    Args:
        module: The layer; unused but for its scaling.
        query: (B, H, Q, C).
        key: (B, K, T, C), K a divisor of H.
        value: (B, K, T, C).
        attention_mask: What is added to the scores, (B, 1, 1, T); None: causal, Q = T.
        more: What transformers passes on, ``scaling`` among it.

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
        """Makes room for one token more than nothing."""
        _, heads, _, width = key_states.shape
        shape = (self._cache.num_slots, heads, self._cache.capacity, width)
        self.keys, self.values = key_states.new_zeros(shape), value_states.new_zeros(shape)
        self.is_initialized = True

    def update(self, key_states: Tensor, value_states: Tensor, *args: object, **kwargs: object) -> tuple[Tensor, Tensor]:
        """Writes what is new, and gives what the step looks at."""
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
            return key_states, value_states  # these slots have nothing older
        rows = torch.arange(count, device=key_states.device)
        self.keys[rows, :, self._cache.positions] = key_states[:, :, 0]
        self.values[rows, :, self._cache.positions] = value_states[:, :, 0]
        return self.keys[:count, :, : self._cache.width], self.values[:count, :, : self._cache.width]

    def get_mask_sizes(self, query_length: int) -> tuple[int, int]:
        """Not asked for: masks are given."""
        return self._cache.width, 0

    def get_seq_length(self) -> int:
        """Not asked for: positions are given."""
        return 0

    def get_max_length(self) -> int:
        """No bound."""
        return -1


class SlotCache(Cache):  # type: ignore[misc]
    """A key-value cache in which each sequence has a slot.

    Args:
        num_layers: Of the model.
        num_slots: Sequences that it has room for.
    """

    def __init__(self, num_layers: int, num_slots: int) -> None:
        self.num_slots, self.capacity = num_slots, _GROWTH
        self.first, self.width = 0, 0
        self.positions: Tensor | None = None
        self._slots = [_SlotLayer(self) for _ in range(num_layers)]
        super().__init__(layers=list(self._slots))

    def reserve(self, width: int) -> None:
        """Makes room for so many tokens of a sequence."""
        if width > self.capacity:
            self.capacity = -(-width // _GROWTH) * _GROWTH

    def move(self, source: int, target: int, length: int) -> None:
        """Copies what a slot holds into another."""
        for layer in self._slots:
            if layer.keys is not None and layer.values is not None:
                layer.keys[target, :, :length] = layer.keys[source, :, :length]
                layer.values[target, :, :length] = layer.values[source, :, :length]


class Decoder:
    """The sequences that are being decoded.

    Args:
        model: A causal language model whose attention is :data:`ATTENTION`.
        num_slots: Most sequences at a time.
        pad: Any token.

    Attributes:
        lengths: Tokens of each sequence that the cache holds, in slot order.
    """

    def __init__(self, model: PreTrainedModel, num_slots: int, pad: int) -> None:
        self._model, self._pad = model, pad
        self._step = Qwen3Step(model) if Qwen3Step.knows(model) else None
        self._cache = SlotCache(model.config.get_text_config().num_hidden_layers, num_slots)
        self.num_slots = num_slots
        self.lengths: list[int] = []

    @torch.inference_mode()
    def admit(self, prompts: list[list[int]]) -> Tensor:
        """Reads new sequences into the next free slots.

        Args:
            prompts: Their tokens.

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
        """Adds one token to each sequence.

        Args:
            tokens: In slot order.

        Returns:
            Logits of the token after it, (len(tokens), V).
        """
        cache, device = self._cache, self._model.device
        positions = torch.tensor(self.lengths, device=device)
        self.lengths = [n + 1 for n in self.lengths]
        cache.width = max(self.lengths)
        cache.reserve(cache.width)
        cache.first, cache.positions = 0, positions
        hides = torch.arange(cache.width, device=device)[None] > positions[:, None]
        mask = torch.zeros(hides.shape, dtype=self._model.dtype, device=device).masked_fill_(hides, -torch.inf)[:, None, None]
        read = torch.tensor(tokens, device=device)
        if self._step is not None:
            return self._logits(self._step(read, positions, mask if min(self.lengths) < cache.width else None, cache))
        return self._logits(self._forward(read[:, None], positions[:, None], mask)[:, 0])

    def _forward(self, tokens: Tensor, positions: Tensor, mask: Tensor | None) -> Tensor:
        # A mask by attention type is taken as it is; the decoder would else make one for a cache that grows.
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
        """Forgets what a sequence has beyond so many tokens."""
        self.lengths[slot] = length

    @torch.inference_mode()
    def release(self, slot: int) -> int | None:
        """Ends a sequence; the last one takes its slot.

        Returns:
            The slot that the last one had, None where it was the last itself.
        """
        last = len(self.lengths) - 1
        if slot != last:
            self._cache.move(last, slot, self.lengths[last])
            self.lengths[slot] = self.lengths[last]
        self.lengths.pop()
        return None if slot == last else last
