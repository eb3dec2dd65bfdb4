"""Targets: files of weights of others, and the documents beside them."""

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import check_finite
from models.physics_corrector.flow.checkpoint import load_corrector, save_corrector
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.point_encoder.checkpoint import load, load_published, save
from models.point_encoder.cloud import MODELNET
from models.point_encoder.encoder import PointEncoder
from models.point_encoder.transformer import PointTransformer, TransformerConfig
from models.policy.network import PolicyNetwork, PolicyShape
from models.policy.weights import PolicyWeights, load_policy, save_policy
from models.rearrangement.settings import RearrangerSettings
from models.rearrangement.weights import build_network, load_rearranger, save_rearranger
from models.text_encoder.folder import packaged_folder, read_folder
from models.training.checkpoint import load_checkpoint, save_checkpoint
from stable_data.robot.episodes import EpisodeFeatures

_SMALL = VelocityNetworkSettings(
    "set_transformer", channels=16, levels=1, heads=2, context_channels=16, time_channels=16, pair_channels=8, code_channels=8
)
_TINY = TransformerConfig(
    enc_depths=(1, 1),
    enc_channels=(16, 32),
    enc_heads=(1, 2),
    dec_depths=(1,),
    dec_channels=(16,),
    dec_heads=(1,),
    patch_size=16,
)
_FEATURES = EpisodeFeatures("simple", 10.0, "joint", ("a", "b"), ("c",), ("d", "e"))
_ABOUT = {"seed": 0, "settings": {"steps": 3}}
_FILE = "weights.safetensors"


def _files() -> list[Base]:
    torch.manual_seed(0)
    found = {}
    with TemporaryDirectory() as folder:
        place = Path(folder, _FILE)
        corrector = CorrectorSettings(_SMALL)
        save_corrector(place, corrector, corrector.build()[0].state_dict(), {"encoder": "abc"})
        found["corrector"] = place.read_bytes()
        rearranger = RearrangerSettings("lego_net", _SMALL)
        save_rearranger(place, rearranger, build_network(rearranger).state_dict(), {"encoder": "abc"})
        found["rearranger"] = place.read_bytes()
        shape = PolicyShape(width=16, depth=1, modes=1, point_width=8, dropout=0.0)
        save_policy(place, PolicyWeights(PolicyNetwork(shape), shape, _FEATURES, 8, frozenset({"a"}), {"episodes": "3"}))
        found["policy"] = place.read_bytes()
        save(PointEncoder(_TINY, MODELNET), place)
        found["encoder"] = place.read_bytes()
    return [Base(name, {_FILE: content}) for name, content in found.items()]


def _read_file(folder: Path, base: str) -> bool:
    path = folder / _FILE
    network: torch.nn.Module
    if base == "corrector":
        network = load_corrector(path).network
    elif base == "rearranger":
        network = load_rearranger(path).network
    elif base == "policy":
        network = load_policy(path).network
    else:
        network = load(path)
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            check_finite(f"tensor {name}", value.numpy())
    return True


def _published() -> list[Base]:
    torch.manual_seed(0)
    state = PointTransformer(_TINY).state_dict()
    sink = io.BytesIO()
    stated = {"enc_num_head": _TINY.enc_heads, "enc_patch_size": (16, 16), "order": tuple(map(str, _TINY.curves))}
    tensors = {f"module.backbone.{name}": value for name, value in state.items()}
    torch.save({"state_dict": tensors, "config": stated, "epoch": 3}, sink)
    with TemporaryDirectory() as folder:
        place = Path(folder, "state.pt")
        save_checkpoint(place, {"step": 3, "tensors": {"a": torch.zeros(4)}, "words": ["a"]}, _ABOUT)
        checkpoint = place.read_bytes()
    return [Base("published", {"model.pth": sink.getvalue()}), Base("checkpoint", {"state.pth": checkpoint})]


def _read_published(folder: Path, base: str) -> bool:
    if base == "published":
        load_published(folder / "model.pth", MODELNET)
        return True
    return load_checkpoint(folder / "state.pth", _ABOUT, "step", "tensors") is not None


def _readers() -> list[Base]:
    folder = packaged_folder()
    names = (
        "modules.json",
        "config_sentence_transformers.json",
        "1_Pooling/config.json",
        "config.json",
        "sentence_bert_config.json",
    )
    known = {name: (folder / name).read_bytes() for name in names if (folder / name).is_file()}
    known |= {"tokenizer.json": b"{}", "model.safetensors": b"none"}
    changed = {name: 1.0 for name in known if name.endswith(".json") and name != "tokenizer.json"}
    return [Base("sentence_model", known, changed)]


def _read_folder(folder: Path, base: str) -> bool:
    read_folder(folder)
    return True


TARGETS = (
    Target(
        "weights",
        10,
        _files,
        _read_file,
        ("settings", "network", "F32", "I64", "F8_E4M3", "shape", "dtype", "data_offsets", "features"),
    ),
    Target("checkpoint", 6, _published, _read_published, ("state_dict", "about", "step")),
    Target(
        "model_folder", 12, _readers, _read_folder, ("path", "type", "Pooling", "Transformer", "max_seq_length", "pooling_mode")
    ),
)
"""The targets of this module."""
