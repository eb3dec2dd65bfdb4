"""Batched decoding with a key-value cache of slots: sequences of different lengths share a step and leave it when finished.

In a plain cache all sequences of a batch grow together, so that a batch takes as long as its longest reply. Here each sequence
has a slot and its own length. The used slots are contiguous, so that a step reads views of the cache and copies nothing.

The logits of a sequence do not depend on the other sequences of its batch, to the last bit. Products of matrices round
differently for different numbers of rows, so three things are fixed:

- a prompt is read alone;
- the rows of a step are filled up: to a multiple of :data:`_ROWS` on a CPU, whose products give a row the same bits in any such
  number of rows (``test_local_engine.py`` measures it), and to all slots on other devices, which choose a kernel by the shape;
- on a CPU each sequence attends alone to its own tokens; on other devices all attend together, and the hidden tokens have the
  weight 0, in whole blocks of a kernel.
"""

from typing import Any
from weakref import proxy

import torch
from torch import Tensor
from torch.nn.functional import pad, scaled_dot_product_attention
from transformers import AttentionInterface, PreTrainedModel
from transformers.cache_utils import Cache, CacheLayerMixin

from models.semantic_reasoner.engines.qwen3_step import Qwen3Step

ATTENTION = "stable_data_slots"
"""Name of :func:`slot_attention` in transformers."""

_GROWTH = 256  # tokens by which the cache grows at a time
_ROWS = 4
_BLOCK = 128  # tokens that attention kernels of GPUs read at a time, at most


def slot_attention(
    module: torch.nn.Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Tensor | None, **more: object
) -> tuple[Tensor, None]:
    """Computes attention with key and value heads that several query heads share, without a copy for each of them.

    Args:
        module: The layer; unused.
        query: (B, H, Q, C).
        key: (B, K, T, C), K a divisor of H.
        value: (B, K, T, C).
        attention_mask: Added to the scores, (B, 1, 1, T), and Q = 1; None: causal, Q = T.
        more: Further arguments of transformers, with ``scaling``.

    Returns:
        (B, Q, H, C), and no weights.
    """
    scaling = more.get("scaling")
    assert isinstance(scaling, float)
    if attention_mask is None:
        attended = scaled_dot_product_attention(query, key, value, is_causal=query.shape[2] > 1, scale=scaling, enable_gqa=True)
        return attended.transpose(1, 2), None
    seen: Tensor | list[int] = attention_mask
    if query.device.type == "cpu":
        seen = (attention_mask[:, 0, 0] == 0).sum(1).tolist()
    return attend(query[:, :, 0], key, value, seen, scaling)[:, None], None


def attend(query: Tensor, keys: Tensor, values: Tensor, seen: Tensor | list[int], scaling: float) -> Tensor:
    """Computes the attention of one token of each sequence.

    Args:
        query: (B, H, C).
        keys: (B, K, T, C), K a divisor of H.
        values: (B, K, T, C).
        seen: The tokens that each sequence attends to. A mask that is added to the scores, (B, 1, 1, T), and all attend together;
            or the numbers of first tokens of the first sequences, and each attends alone; the other rows have no meaning.
        scaling: Factor of the scores.

    Returns:
        (B, H, C).
    """
    # Query heads that share a key head become queries of one head, so that no key is repeated.
    batch, heads, width = query.shape
    grouped = query.view(batch, keys.shape[1], heads // keys.shape[1], width)
    if isinstance(seen, Tensor):
        return scaled_dot_product_attention(grouped, keys, values, attn_mask=seen, scale=scaling).flatten(1, 2)
    attended = torch.zeros_like(grouped)
    for k, n in enumerate(seen):
        row = slice(k, k + 1)
        attended[row] = scaled_dot_product_attention(grouped[row], keys[row, :, :n], values[row, :, :n], scale=scaling)
    return attended.flatten(1, 2)


AttentionInterface.register(ATTENTION, slot_attention)


class _SlotLayer(CacheLayerMixin):  # type: ignore[misc]
    """Keys and values of one layer, (slots, K, tokens, C)."""

    def __init__(self, cache: "SlotCache") -> None:
        super().__init__()
        # A cycle would keep the tensors, tens of megabytes for each batch, until Python looks for cycles among all of its objects.
        self._cache: Any = proxy(cache)

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
        slots, tokens = self._cache.num_slots - self.keys.shape[0], self._cache.capacity - self.keys.shape[2]
        if slots or tokens:
            more = (0, 0, 0, tokens, 0, 0, 0, slots)
            self.keys, self.values = pad(self.keys, more), pad(self.values, more)
        count, size = len(key_states), key_states.shape[2]
        if self._cache.positions is None:
            self.keys[self._cache.first, :, :size] = key_states[0]
            self.values[self._cache.first, :, :size] = value_states[0]
            return key_states, value_states  # a new sequence has no older tokens
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
    """A key-value cache of ``num_layers`` layers in which each sequence has a slot.

    Attributes:
        num_slots: Number of slots; grows with the batch.
        capacity: Number of tokens of a slot; grows with the longest sequence.
        first: Slot of the prompt that is read.
        positions: Positions of the tokens of a step; None while a prompt is read.
        width: Number of tokens that a step attends to.
    """

    def __init__(self, num_layers: int) -> None:
        self.num_slots, self.capacity = _ROWS, _GROWTH
        self.first, self.width = 0, 0
        self.positions: Tensor | None = None
        self._slots = [_SlotLayer(self) for _ in range(num_layers)]
        super().__init__(layers=list(self._slots))

    def reserve(self, num_slots: int, width: int) -> None:
        """Grows to at least ``num_slots`` slots of at least ``width`` tokens."""
        if num_slots > self.num_slots:
            self.num_slots = max(num_slots, 2 * self.num_slots)
        self.capacity = max(self.capacity, _filled(width, _GROWTH))

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
        logits: Logits of the next tokens on the model's device, (rows, V), one row for each slot; rows after the last sequence
            have no meaning.
    """

    def __init__(self, model: PreTrainedModel, num_slots: int, pad: int) -> None:
        self._model, self._pad = model, pad
        self._step = Qwen3Step(model, attend) if Qwen3Step.knows(model) else None
        self._cache = SlotCache(model.config.get_text_config().num_hidden_layers)
        self._multiple = _ROWS if model.device.type == "cpu" else num_slots
        self.num_slots = num_slots
        self.lengths: list[int] = []
        self.logits = torch.zeros(0, model.get_output_embeddings().weight.shape[0], device=model.device)

    @torch.inference_mode()
    def admit(self, prompt: list[int]) -> None:
        """Reads the prompt of a new sequence into the next free slot."""
        cache, slot, size = self._cache, len(self.lengths), len(prompt)
        self.lengths.append(size)
        rows = _filled(len(self.lengths), self._multiple)
        cache.reserve(rows, size)
        cache.first, cache.positions, cache.width = slot, None, size
        device = self._model.device
        hidden = self._forward(torch.tensor([prompt], device=device), torch.arange(size, device=device)[None], None)
        if rows != len(self.logits):
            self.logits = pad(self.logits, (0, 0, 0, rows - len(self.logits)))
        self.logits[slot] = self._logits(hidden[:, -1])[0]

    @torch.inference_mode()
    def step(self, tokens: list[int]) -> None:
        """Appends one token to each sequence, in slot order."""
        cache, device = self._cache, self._model.device
        rows = _filled(len(tokens), self._multiple)
        more = rows - len(tokens)  # rows of one token, whose slots are free
        places = torch.tensor([self.lengths + [0] * more, tokens + [self._pad] * more], device=device)
        positions, read = places.unbind()
        self.lengths = [n + 1 for n in self.lengths]
        cache.width = max(self.lengths) if device.type == "cpu" else _filled(max(self.lengths), _BLOCK)
        cache.reserve(rows, cache.width)
        cache.positions = positions
        if self._step is not None and device.type == "cpu":
            hidden = self._step(read, positions, self.lengths, cache)
        else:
            # Sequences that are shorter than the longest one do not attend to the rest of their slots.
            hides = torch.arange(cache.width, device=device)[None] > positions[:, None]
            mask = torch.zeros(hides.shape, dtype=self._model.dtype, device=device).masked_fill_(hides, -torch.inf)
            mask = mask[:, None, None]
            if self._step is not None:
                hidden = self._step(read, positions, mask, cache)
            else:
                hidden = self._forward(read[:, None], positions[:, None], mask)[:, 0]
        self.logits = self._logits(hidden)

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

        The logits are not moved: a step follows.

        Returns:
            The former slot of the moved sequence; None if the ended one was the last.
        """
        last = len(self.lengths) - 1
        if slot != last:
            self._cache.move(last, slot, self.lengths[last])
            self.lengths[slot] = self.lengths[last]
        self.lengths.pop()
        return None if slot == last else last


def _filled(count: int, multiple: int) -> int:
    """The next multiple."""
    return -(-count // multiple) * multiple
