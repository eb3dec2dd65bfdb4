"""The optimizers of the reasoner's training, seen as one."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn

from models.semantic_reasoner.training.loss import shard_like
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings

_KEPT = ("step", "exp_avg", "exp_avg_sq", "momentum_buffer")  # what AdamW and Muon know of a parameter


class OptimizerSet:
    """AdamW, and Muon for the matrices between embeddings and head where the settings say so.

    Args:
        parameters: What is trained, by name.
        settings: Which, and how.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], settings: ReasonerTrainingSettings) -> None:
        self._parameters = parameters
        turned = {name: p for name, p in parameters.items() if settings.optimizer == "muon" and is_hidden(name, p)}
        rest = [p for name, p in parameters.items() if name not in turned]
        groups = [
            {"params": [p for p in rest if p.dim() >= 2], "weight_decay": settings.weight_decay},
            {"params": [p for p in rest if p.dim() < 2], "weight_decay": 0.0},
        ]
        # Fused: a tenth of a step of the small network is AdamW otherwise.
        self._all: list[torch.optim.Optimizer] = [
            torch.optim.AdamW(groups, settings.learning_rate, betas=(0.9, 0.95), fused=True)
        ]
        if turned:
            rate, decay = settings.learning_rate, settings.weight_decay
            # Steps as large as AdamW's, so that both take one learning rate.
            self._all.append(torch.optim.Muon(turned.values(), rate, decay, adjust_lr_fn="match_rms_adamw"))

    def step(self, learning_rate: float) -> None:
        """Goes down the gradients, and forgets them."""
        for optimizer in self._all:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            optimizer.step()
            optimizer.zero_grad()

    def state(self) -> Iterator[tuple[str, str, Tensor]]:
        """What is known of each parameter: which of :data:`_KEPT`, the parameter's name, and the value as it lies here."""
        known = [(name, o.state[p]) for name, p in self._parameters.items() for o in self._all if p in o.state]
        return ((key, name, state[key]) for key in _KEPT for name, state in known if key in state)

    def take(self, state: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Goes on from what :meth:`state` said, gathered whole, by key and name."""
        for optimizer in self._all:
            own = {id(p) for group in optimizer.param_groups for p in group["params"]}
            for name, p in self._parameters.items():
                found = {key: values[name] for key, values in state.items() if name in values}
                if id(p) in own and found:
                    optimizer.state[p] = {key: _placed(key, value, p) for key, value in found.items()}


def is_hidden(name: str, parameter: Tensor) -> bool:
    """Whether a parameter is a matrix between embeddings and head: rows of those are steps of their own, which Muon would mix."""
    return parameter.dim() == 2 and "embed_tokens" not in name and "lm_head" not in name


def _placed(key: str, value: Tensor, like: Tensor) -> Tensor:
    return value.to(like.device).clone() if key == "step" else shard_like(value, like).clone()
