"""The training of the reasoner, step by step: cross-entropy on the replies alone (the paper's supervised fine-tuning).

A step is a function of the weights and of its number: which examples it takes comes from streams named by (seed, pass), so a run
that was stopped and resumed is the run that was not.
"""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from transformers import PreTrainedModel

from models.semantic_reasoner.token_set import TokenSet, batch_of, batches_of_pass
from models.semantic_reasoner.training_settings import ReasonerTraining


class Training:
    """A reasoner being trained.

    Args:
        network: A causal language model with ``model`` (the decoder) and ``lm_head``.
        data: What it learns from.
        settings: What shapes the weights, ``steps`` set.
        pad: Token that fills rows up.

    Attributes:
        step: Steps done.
        tokens: Tokens of replies seen.
    """

    def __init__(self, network: PreTrainedModel, data: TokenSet, settings: ReasonerTraining, pad: int) -> None:
        self.network, self.data, self.settings, self._pad = network, data, settings, pad
        matrices = [p for p in network.parameters() if p.dim() >= 2]
        others = [p for p in network.parameters() if p.dim() < 2]
        groups = [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self._optimizer = torch.optim.AdamW(groups, settings.learning_rate, betas=(0.9, 0.95))
        self.step = self.tokens = 0
        self._batches = self._from(0)

    def _from(self, step: int) -> Iterator[list[list[int]]]:
        """Batches of all passes, one after another, from a step on."""
        batches = itertools.chain.from_iterable(map(self.pass_of, itertools.count()))
        return itertools.islice(batches, step * self.settings.accumulate, None)

    def pass_of(self, number: int) -> list[list[list[int]]]:
        """The batches of a pass."""
        s = self.settings
        rng = np.random.default_rng([s.seed, number])
        return batches_of_pass(self.data, s.shares.of_kinds(), s.tokens_per_batch, s.max_tokens, s.packs, rng)

    def advance(self) -> float:
        """One step; gives its loss, nats a token."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.settings.learning_rate_at(self.step)
        batches = [batch_of(self.data, rows, self._pad) for rows in itertools.islice(self._batches, self.settings.accumulate)]
        count = sum(int((b.target >= 0).sum()) for b in batches)
        total = 0.0
        for b in batches:
            loss = self._loss(torch.from_numpy(b.tokens), torch.from_numpy(b.position), torch.from_numpy(b.target)) / count
            loss.backward()  # type: ignore[no-untyped-call]
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip)
        self._optimizer.step()
        self._optimizer.zero_grad()
        self.step += 1
        self.tokens += count
        return total

    def _loss(self, tokens: Tensor, position: Tensor, target: Tensor) -> Tensor:
        """Sum of the negative log-likelihood of the replies' tokens."""
        with torch.autocast(self.network.device.type, torch.bfloat16):
            # Without packing nothing comes after what counts but padding, which a causal model does not see.
            known: dict[str, Any] = {"position_ids": position} if self.settings.packs else {}
            hidden = self.network.model(input_ids=tokens, use_cache=False, **known).last_hidden_state
            counts = target >= 0
            logits = self.network.lm_head(hidden[counts])  # of the replies alone
        return functional.cross_entropy(logits.float(), target[counts], reduction="sum")

    @torch.no_grad()
    def validate(self, data: TokenSet, most: int = 600) -> dict[int, float]:
        """Nats a token of held-out replies, by kind."""
        found: dict[int, float] = {}
        for kind in np.unique(data.kind).tolist():
            members = np.flatnonzero(data.kind == kind)[:most]
            members = members[np.argsort(data.length[members])]
            total, count = 0.0, 0
            for part in np.array_split(members, max(1, math.ceil(len(members) / 32))):
                b = batch_of(data, [[int(k)] for k in part], self._pad)
                total += float(self._loss(*(torch.from_numpy(v) for v in (b.tokens, b.position, b.target))))
                count += int((b.target >= 0).sum())
            found[kind] = total / count
        return found

    def save(self, path: Path) -> None:
        """Keeps the training where another process can go on with it, in one step."""
        aside = path.with_name(f".{path.name}.tmp")
        state = {
            "step": self.step,
            "tokens": self.tokens,
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }
        torch.save(state, aside)
        aside.replace(path)

    def resume(self, path: Path) -> bool:
        """Goes on where :meth:`save` was called; False where nothing was kept."""
        if not path.is_file():
            return False
        state = torch.load(path, map_location="cpu", weights_only=True)
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.step, self.tokens = state["step"], state["tokens"]
        self._batches = self._from(self.step)
        return True
