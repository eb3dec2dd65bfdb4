"""Places a network on the training device: whole in one process, or sharded over several ones.

In several processes the weights, their gradients and the optimizer's averages are sharded (FSDP) by PyTorch's ``fully_shard``:
names of parameters and classes of modules do not change, and trained and frozen parameters may be mixed, as with LoRA.
accelerate would only start the processes in addition, which Ray Train does already.
"""

from typing import Any

import torch
from torch import Tensor
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor
from transformers import PreTrainedModel, PreTrainedTokenizerBase

from models.semantic_reasoner.training.loss import FLOAT32_ON_CPU, ReplyLoss
from models.semantic_reasoner.training.network import TrainableNetwork
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.training.distributed import ProcessContext


def make_loss(settings: ReasonerTrainingSettings, tokenizer: PreTrainedTokenizerBase, place: ProcessContext) -> ReplyLoss:
    """Makes the network of a training, with its loss, on the training device in float32; all processes call it.

    Of several processes only the first reads or draws the weights. The others make the network without memory, and each gets its
    shard of one parameter after another: none but the first ever holds a whole network.

    Raises:
        ConfigError: ``base`` is not a readable model.
    """
    source = TrainableNetwork(settings, tokenizer).network if place.rank == 0 else None
    if place.world_size == 1:
        assert source is not None
        return place_network(ReplyLoss(source, settings), place)
    loss = ReplyLoss(TrainableNetwork(settings, tokenizer, is_empty=True).network, settings)
    _shard(loss, settings, place)
    _fill(loss.network, source, place)
    return loss


def place_network(loss: ReplyLoss, place: ProcessContext) -> ReplyLoss:
    """Moves a whole network to the training device in float32, and returns it."""
    network: Any = loss.network
    _choose_attention(network, place)
    network.to(place.device, torch.float32)
    return loss


def _choose_attention(network: Any, place: ProcessContext) -> None:
    if place.device.type == "cpu":
        network.set_attn_implementation(FLOAT32_ON_CPU)


def _shard(loss: ReplyLoss, settings: ReasonerTrainingSettings, place: ProcessContext) -> None:
    """Makes each process hold a shard of each parameter, of which the values are not set."""
    network: Any = loss.network
    _choose_attention(network, place)
    network.to(torch.float32)
    mesh = init_device_mesh(place.device.type, (place.world_size,))
    of_layers = MixedPrecisionPolicy()
    if settings.precision == "bfloat16":
        # Layers are gathered in bfloat16, in which they are multiplied: half the memory and traffic. Their inputs stay float32,
        # as in one process.
        of_layers = MixedPrecisionPolicy(torch.bfloat16, torch.float32, cast_forward_inputs=False)
    for layer in network.model.layers:
        fully_shard(layer, mesh=mesh, mp_policy=of_layers)
    # The rest is gathered in float32: gradients of embeddings and head are sums over many tokens and chunks, too long for bfloat16.
    fully_shard(loss, mesh=mesh)
    loss.to_empty(device=place.device)


@torch.no_grad()
def _fill(network: PreTrainedModel, source: PreTrainedModel | None, place: ProcessContext) -> None:
    """Sets the values of a sharded network from a whole one on the first process."""
    values: dict[str, Tensor] = {}
    if source is not None:
        values = {**dict(source.named_parameters()), **dict(source.named_buffers())}
    for name, parameter in network.named_parameters():
        assert isinstance(parameter, DTensor)
        whole = _whole(values.get(name), parameter, torch.float32, place)
        parameter.copy_(distribute_tensor(whole, parameter.device_mesh, parameter.placements, src_data_rank=0))
    for name, buffer in network.named_buffers():  # also those that files do not have, such as rotary frequencies
        buffer.copy_(_whole(values.get(name), buffer, buffer.dtype, place))
        torch.distributed.broadcast(buffer, 0)


def _whole(value: Tensor | None, like: Tensor, dtype: torch.dtype, place: ProcessContext) -> Tensor:
    """A value on the training device; without one, memory of its shape, in which a process receives."""
    if value is None:
        return torch.empty(like.shape, dtype=dtype, device=place.device)
    return value.detach().to(place.device, dtype)


def gather_tensor(value: Tensor) -> Tensor:
    """Returns the whole tensor of a shard, on every process."""
    return value.full_tensor() if isinstance(value, DTensor) else value
