"""Draws tokens from logits on the device where they are: masks and random numbers go there, only token ids come back."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.semantic_reasoner.engines.protocol import Sampling

_HEAT = 0.5  # temperature that each further redraw adds
_WORD = 32  # bits of an integer of a mask
_BITS = (1 << np.arange(_WORD, dtype=np.int64)).astype(np.uint32).view(np.int32)


class TokenSampler:
    """Draws one token for each sequence of a batch.

    The end of a list of objects is drawn with the model's own probability at any temperature. The model decides it once an
    object, so a temperature below 1 and the cut at ``top_p`` would give longer lists than those of its training.

    Args:
        sampling: How tokens are drawn.
        closing: The tokens that end a list of objects, (V,) bool.
    """

    def __init__(self, sampling: Sampling, closing: npt.NDArray[np.bool_]) -> None:
        self._sampling, self._closing = sampling, closing
        bits = np.zeros(-(-len(closing) // _WORD) * _WORD, bool)
        bits[: len(closing)] = closing
        self._closing_bits = np.packbits(bits, bitorder="little").view(np.int32)

    def may_end(self, allowed: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
        """Returns which sequences may either end their list or continue it, (B,), from the bit masks of allowed tokens."""
        closes = allowed & self._closing_bits
        found: npt.NDArray[np.bool_] = closes.any(1) & (closes != allowed).any(1)
        return found

    @torch.inference_mode()
    def draw(
        self,
        logits: Tensor,
        allowed: npt.NDArray[np.int32] | None,
        draws: npt.NDArray[np.float64],
        end_draws: npt.NDArray[np.float64],
        redraws: npt.NDArray[np.int64],
    ) -> list[int]:
        """Draws the next tokens.

        Args:
            logits: (rows, V); rows after the last sequence are not read.
            allowed: Bit masks of the allowed tokens, (B, V / 32); None allows all.
            draws: A random number of each sequence, (B,), in [0, 1).
            end_draws: Another for each sequence that may either end its list or continue it; not a number for the others.
            redraws: How often each sequence has drawn this part already, (B,). Each time its temperature is higher, and
                ``top_p`` does not apply, since a part that is refused again and again has to become another one.

        Returns:
            A token of each sequence.
        """
        count, rows = len(draws), len(logits)
        sampling, device = self._sampling, logits.device
        if allowed is not None:
            words = torch.from_numpy(_filled(allowed, rows, -1)).to(device)
            bits = words[:, :, None] & torch.from_numpy(_BITS).to(device)
            logits = logits.masked_fill(bits.flatten(1)[:, : logits.shape[1]] == 0, -torch.inf)
        likeliest = logits.argmax(1) if sampling.temperature == 0 else None
        if likeliest is not None and not redraws.any():
            return likeliest[:count].tolist()
        temperature = np.where(redraws > 0, 1 + _HEAT * (redraws - 1), sampling.temperature or 1.0)
        top_p = np.where(redraws > 0, 1.0, sampling.top_p)
        numbers = np.stack([draws, end_draws, temperature, top_p]).astype(np.float32).T
        random, ends, temperatures, shares = torch.from_numpy(_filled(numbers, rows, np.nan)).to(device).chunk(4, 1)
        if not np.isnan(end_draws).all():
            logits = self._with_ends(logits, ends)
        # Top k, then top p, in the order of transformers.
        best, tokens = torch.topk(logits, min(sampling.top_k or logits.shape[1], logits.shape[1]))
        share = torch.softmax(best / temperatures, 1)
        before = torch.cumsum(share, 1) - share
        share = share * (before < shares)  # the most probable token always remains
        place = (torch.cumsum(share, 1) <= random * share.sum(1, keepdim=True)).sum(1, keepdim=True)
        drawn = tokens.gather(1, place.clamp_max(share.shape[1] - 1))[:count, 0]
        if likeliest is not None:
            drawn = torch.where(torch.from_numpy(redraws > 0).to(device), drawn, likeliest[:count])
        return drawn.tolist()

    def _with_ends(self, logits: Tensor, draws: Tensor) -> Tensor:
        """Decides which lists end, and masks the other tokens of these, or else the end; draws are (rows, 1)."""
        closing = torch.from_numpy(self._closing).to(logits.device)
        odds = torch.softmax(logits, 1).masked_fill(~closing, 0).sum(1, keepdim=True)
        other = closing[None] != (draws < odds)
        return logits.masked_fill(other & ~draws.isnan(), -torch.inf)


def _filled(values: npt.NDArray[np.generic], rows: int, value: float) -> npt.NDArray[np.generic]:
    """An array with further rows of a value."""
    return np.concatenate([values, np.full((rows - len(values), *values.shape[1:]), value, values.dtype)])
