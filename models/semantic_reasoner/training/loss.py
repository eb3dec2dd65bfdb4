"""The loss of the reasoner's training: the negative log-likelihood of the replies; prompts have no loss."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint
from transformers import AttentionInterface, PreTrainedModel
from transformers.masking_utils import AttentionMaskInterface, sdpa_mask

from models.semantic_reasoner.training.batch_sampler import IGNORED, TokenBatch
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.training.distributed import ProcessContext

HEAD_CHUNK = 1024
"""Tokens whose logits are in memory at a time if activations are recomputed."""


class ReplyLoss(nn.Module):
    """A network with its loss.

    The loss is a module, since FSDP gathers sharded weights when a module is called.

    Args:
        network: A causal language model with ``model`` (the decoder) and ``lm_head``.
        settings: Precision, packing, compilation, and recomputation of activations.

    Attributes:
        network: The network.
    """

    def __init__(self, network: PreTrainedModel, settings: ReasonerTrainingSettings) -> None:
        super().__init__()
        self.network = network
        self._settings = settings
        if settings.recomputes:
            network.activation_checkpointing_enable({"use_reentrant": False})
        self._head_loss = _head_loss
        if settings.compiles:
            decoder: Any = network.model
            decoder.compile(dynamic=True)  # nearly every batch has a new shape
            self._head_loss = torch.compile(_head_loss, dynamic=True)

    def forward(self, tokens: Tensor, target: Tensor, position: Tensor | None = None) -> Tensor:
        """Returns the sum of the loss over the replies' tokens, nats.

        Args:
            tokens: (B, T) int64.
            target: (B, T) int64; see :class:`TokenBatch`.
            position: (B, T) int64 if rows have several examples: transformers separates examples where positions start again.
                None if rows have one each: only padding follows it, which a causal model does not see.
        """
        is_low = self._settings.precision == "bfloat16"
        # Each weight is used once a pass: a cache of bfloat16 copies would only take memory.
        with torch.autocast(tokens.device.type, torch.bfloat16, enabled=is_low, cache_enabled=False):
            more: dict[str, Any] = {} if position is None else {"position_ids": position}
            hidden = self.network.model(input_ids=tokens, use_cache=False, **more).last_hidden_state
            counts = target != IGNORED
            # (R, C), (R,): no logits for prompts, which are long, since the vocabulary is large.
            hidden, target = hidden[counts], target[counts]
            if not self._settings.recomputes:
                return self._head(hidden, target)
            parts = zip(torch.split(hidden, HEAD_CHUNK), torch.split(target, HEAD_CHUNK), strict=True)
            losses = [checkpoint(self._head, h, t, use_reentrant=False) for h, t in parts]
        return torch.stack(losses).sum()

    def _head(self, hidden: Tensor, target: Tensor) -> Tensor:
        return self._head_loss(self.network.lm_head, hidden, target)

    def of_batch(self, batch: TokenBatch, place: ProcessContext) -> Tensor:
        """Returns the loss of a batch."""
        position = torch.from_numpy(batch.position).to(place.device) if self._settings.packs else None
        loss: Tensor = self(*(torch.from_numpy(v).to(place.device) for v in (batch.tokens, batch.target)), position)
        return loss


def _head_loss(head: nn.Module, hidden: Tensor, target: Tensor) -> Tensor:
    return functional.cross_entropy(head(hidden).float(), target, reduction="sum")


def _attention_in_float32(
    module: nn.Module,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attention_mask: Tensor | None,
    scaling: float | None = None,
    **_: Any,
) -> tuple[Tensor, None]:
    """Attention for transformers: PyTorch's CPU kernel is far slower in bfloat16 than in float32, mostly in the backward pass."""
    with torch.autocast("cpu", enabled=False):
        found = functional.scaled_dot_product_attention(
            query.float(),
            key.float(),
            value.float(),
            attn_mask=attention_mask,
            is_causal=attention_mask is None and query.shape[2] > 1,  # a single generated token sees all earlier ones
            scale=scaling,
            enable_gqa=True,
        )
    return found.transpose(1, 2).contiguous().to(value.dtype), None


FLOAT32_ON_CPU = "float32_on_cpu"
"""Name of this attention for transformers."""

AttentionInterface.register(FLOAT32_ON_CPU, _attention_in_float32)
AttentionMaskInterface.register(FLOAT32_ON_CPU, sdpa_mask)
