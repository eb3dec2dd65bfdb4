from dataclasses import replace

import pytest
import torch

from models.semantic_reasoner.training.loss import ReplyLoss
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.settings import EMBEDDED, LanguageModelSettings, Precision, ReasonerTrainingSettings
from models.semantic_reasoner.training.sharding import place_network
from models.training.distributed import CPU
from pipelines.train.estimate import memory_bytes
from tests.models.semantic_reasoner.training.reasoner_examples import tokenizer

TOKENS = 128


def bytes_kept_for_backward(settings: ReasonerTrainingSettings) -> int:
    """What autograd keeps of the layers' forward pass over one row, beside the parameters."""
    loss = ReplyLoss(new_network(settings.network, tokenizer(), 512, 0), settings)
    place_network(loss, CPU)
    parameters = {p.untyped_storage().data_ptr() for p in loss.parameters()}
    kept: dict[int, torch.Tensor] = {}

    def keep(value: torch.Tensor) -> torch.Tensor:
        if value.untyped_storage().data_ptr() not in parameters:
            kept[value.untyped_storage().data_ptr()] = value  # a reference, so that its address is not used again
        return value

    low = settings.precision == "bfloat16"
    hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value)
    with hooks, torch.autocast("cpu", torch.bfloat16, enabled=low, cache_enabled=False):
        output = loss.network.model(input_ids=torch.zeros((1, TOKENS), dtype=torch.long), use_cache=False)
    assert output.last_hidden_state.requires_grad
    return sum(value.untyped_storage().nbytes() for value in kept.values())


@pytest.mark.parametrize("precision", ["bfloat16", "float32"])
@pytest.mark.parametrize(
    "network",
    [LanguageModelSettings(), LanguageModelSettings(layers=3, heads=8, key_value_heads=8, head=32, intermediate=512)],
    ids=["embedded", "other"],
)
def test_the_activations_of_a_plan_are_what_autograd_keeps(network: LanguageModelSettings, precision: Precision) -> None:
    settings = replace(EMBEDDED, network=network, precision=precision)
    planned = memory_bytes(settings, tokenizer(), TOKENS, replies=0, world=1)["activations"]
    kept = bytes_kept_for_backward(settings)
    assert planned * network.layers / (network.layers + 1) == pytest.approx(kept, rel=0.05)
