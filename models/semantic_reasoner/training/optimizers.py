"""The optimizers of the reasoner's training behind one interface."""

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from models.semantic_reasoner.training.settings import ReasonerTrainingSettings

_AVERAGES = ("exp_avg", "exp_avg_sq", "momentum_buffer")  # of AdamW and Muon


class OptimizerSet:
    """AdamW, and Muon for the matrices between embeddings and head if the settings select it.

    Args:
        parameters: The trained parameters by name.
        settings: Optimizer, learning rate and weight decay.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], settings: ReasonerTrainingSettings) -> None:
        self._parameters = parameters
        muon_parameters = {name: p for name, p in parameters.items() if settings.optimizer == "muon" and is_hidden(name, p)}
        rest = [p for name, p in parameters.items() if name not in muon_parameters]
        groups = [
            {"params": [p for p in rest if p.dim() >= 2], "weight_decay": settings.weight_decay},
            {"params": [p for p in rest if p.dim() < 2], "weight_decay": 0.0},
        ]
        # Fused: else AdamW takes a tenth of a step of the small network.
        self._optimizers: list[torch.optim.Optimizer] = [
            torch.optim.AdamW(groups, settings.learning_rate, betas=(0.9, 0.95), fused=True)
        ]
        if muon_parameters:
            rate, decay = settings.learning_rate, settings.weight_decay
            # Steps as large as AdamW's, so that both use one learning rate.
            self._optimizers.append(torch.optim.Muon(muon_parameters.values(), rate, decay, adjust_lr_fn="match_rms_adamw"))

    def step(self, learning_rate: float) -> None:
        """Updates the parameters and clears their gradients."""
        for optimizer in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            optimizer.step()
            optimizer.zero_grad()

    def averages(self) -> dict[str, Tensor]:
        """Returns the moving averages as ``average.parameter``, of sharded parameters this process's part."""
        known = [(name, o.state[p]) for name, p in self._parameters.items() for o in self._optimizers if p in o.state]
        return {f"{key}.{name}": state[key] for name, state in known for key in _AVERAGES if key in state}

    def make_averages(self, names: Collection[str], step: int) -> None:
        """Makes the averages of these names, for values from a checkpoint, as they are after a number of steps."""
        for optimizer in self._optimizers:
            own = {id(p) for group in optimizer.param_groups for p in group["params"]}
            for name, p in self._parameters.items():
                made = {key: torch.zeros_like(p.detach()) for key in _AVERAGES if f"{key}.{name}" in names}
                if id(p) in own and made:
                    # AdamW counts the steps of each parameter; Muon does not.
                    count = {"step": torch.tensor(float(step), device=p.device)} if "exp_avg" in made else {}
                    optimizer.state[p] = {**count, **made}


def is_hidden(name: str, parameter: Tensor) -> bool:
    """Returns whether a parameter is a matrix between embeddings and head, whose rows Muon must not mix."""
    return parameter.dim() == 2 and "embed_tokens" not in name and "lm_head" not in name
