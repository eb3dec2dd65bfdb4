"""Weights of the reader on disk: what differs from the sentence encoder that the network starts from.

Matrices of the encoder are stored as their difference from the encoder's own, in 8 bits for each row's largest entry; the heads
and vectors are stored as float16. The file is therefore a tenth of the network, and needs the same encoder.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import safe_open
from tokenizers import Tokenizer
from torch import Tensor
from transformers import BertConfig

from models.instruction_reader.network import ReaderNetwork, WordTokens
from models.text_encoder.folder import packaged_folder, read_folder
from models.training.weights_file import read_weights, save_weights
from stable_data.errors import ConfigError

DEFAULT_WEIGHTS = Path(__file__).resolve().parents[1] / "weights" / "instruction_reader.safetensors"
"""The reader of this repository; models/weights/instruction_reader.md describes its training and its results."""

FORMAT = "stable-data instruction reader 1"

_LATER = ("in_sentence.", "among_pairs.")
"""Layers that earlier files do not have; they change nothing before they are trained."""

_SCALE = ".scale"
_LEVELS = 127


@dataclass(frozen=True, slots=True, eq=False)
class ReaderModel:
    """A network with its tokens.

    Attributes:
        network: The network.
        tokens: Splits words into its tokens.
        encoder: Fingerprint of the sentence encoder that it started from.
        notes: Notes of the file.
    """

    network: ReaderNetwork
    tokens: WordTokens
    encoder: str
    notes: Mapping[str, str]


def new_reader(seed: int = 0) -> ReaderModel:
    """Returns a network with the packaged sentence encoder and random heads.

    Raises:
        ConfigError: The encoder's package is not installed.
    """
    folder = read_folder(packaged_folder())
    config = BertConfig.from_pretrained(folder.folder, local_files_only=True)
    config.hidden_dropout_prob = config.attention_probs_dropout_prob = 0.0  # no sentence comes twice
    config._attn_implementation = "eager"  # on a CPU its gradient is twice as fast as that of sdpa in bfloat16
    torch.manual_seed(seed)
    network = ReaderNetwork(config)
    with safe_open(folder.folder / "model.safetensors", "pt") as file:
        own = {name.removeprefix("bert."): file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    network.encoder.load_state_dict({name: own[name] for name in network.encoder.state_dict() if name in own}, strict=False)
    missing = [name for name, _ in network.encoder.named_parameters() if name not in own]
    if missing:
        raise ConfigError(f"{folder.folder}: has no weights {missing[0]}, expected those of a BERT encoder", "model_invalid")
    tokenizer = Tokenizer.from_file(str(folder.folder / "tokenizer.json"))
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return ReaderModel(network, WordTokens(tokenizer), folder.fingerprint, {})


def save_reader(path: Path, model: ReaderModel, notes: Mapping[str, str]) -> None:
    """Writes the weights that differ from the sentence encoder.

    Args:
        path: The file to write.
        model: The network.
        notes: Notes for the header, such as settings and figures.
    """
    own = new_reader().network.encoder.state_dict()
    tensors: dict[str, Tensor] = {}
    for name, value in model.network.state_dict().items():
        base = own.get(name.removeprefix("encoder.")) if name.startswith("encoder.") else None
        if base is None:
            tensors[name] = value.detach().half().contiguous()
        elif not torch.equal(base, value.cpu()):
            difference = value.detach().cpu() - base
            if difference.ndim == 2:
                scale = (difference.abs().amax(1, keepdim=True) / _LEVELS).clamp(min=1e-12)
                tensors[name] = (difference / scale).round().to(torch.int8)
                tensors[name + _SCALE] = scale
            else:
                tensors[name] = difference
    header = {"format": FORMAT, "encoder": model.encoder, **notes}
    save_weights(path, tensors, header)


def load_reader(path: Path = DEFAULT_WEIGHTS, trains: bool = False) -> ReaderModel:
    """Reads a reader.

    Args:
        path: The file.
        trains: Whether its weights shall be trained further.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``), is not a reader (``weights_invalid``), or it belongs to
            another sentence encoder (``encoder_mismatch``).
    """
    model = new_reader()
    tensors, notes = read_weights(path)
    if notes.get("format") != FORMAT:
        raise ConfigError(f"{path}: its format is {notes.get('format')}, expected {FORMAT}", "weights_invalid")
    if notes.get("encoder") != model.encoder:
        message = f"{path}: was trained on the sentence encoder {notes.get('encoder')}, expected {model.encoder}"
        raise ConfigError(message, "encoder_mismatch")
    state = model.network.state_dict()
    unknown = sorted(name for name in tensors if name.removesuffix(_SCALE) not in state)
    is_early = not any(name.startswith(_LATER) for name in tensors)
    given = ("encoder.", *_LATER) if is_early else ("encoder.",)
    missing = sorted(name for name in state if not name.startswith(given) and name not in tensors)
    if unknown or missing:
        message = f"{path}: has {(unknown or ['no ' + missing[0]])[0]}, expected the weights of {ReaderNetwork.__name__}"
        raise ConfigError(message, "weights_invalid")
    for name, value in tensors.items():
        if name.endswith(_SCALE):
            continue
        value = value.float() * tensors[name + _SCALE] if name + _SCALE in tensors else value.float()
        state[name] = state[name] + value if name.startswith("encoder.") else value
    model.network.load_state_dict(state)
    model.network.train(trains).requires_grad_(trains)
    return ReaderModel(model.network, model.tokens, model.encoder, notes)


def figures_note(figures: Mapping[str, float]) -> str:
    """Returns figures as the text of a note."""
    return json.dumps({name: round(value, 5) for name, value in figures.items()}, sort_keys=True)
