"""Weights of point encoders on disk: our own format, and published checkpoints. Mismatches are refused.

Our files are safetensors, whose metadata are configuration, preprocessing and fingerprint. Published checkpoints are files of
Pointcept's tools; the names and shapes of their tensors determine the variant. Only tensors and plain values are unpickled.
"""

import json
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from models.point_encoder.cloud import Preprocessing
from models.point_encoder.encoder import PointEncoder
from models.point_encoder.serialization import CURVES
from models.point_encoder.transformer import TransformerConfig
from models.training.weights_file import build_no_larger_than, read_weights, save_weights
from stable_data.errors import ConfigError
from stable_data.limits import is_out_of_memory

FORMAT = "stable-data point encoder 1"

DEFAULT_WEIGHTS = Path(__file__).resolve().parents[1] / "weights" / "point_encoder.safetensors"
"""The small encoder of this repository; models/weights/point_encoder.md describes its training and its results."""

_PREFIXES = ("module.student.backbone.", "student.backbone.", "module.backbone.", "backbone.", "module.", "")
_NOT_ENCODING = re.compile(r"(seg_head|cls_head)\.|embedding\.mask_token$")  # task heads, and the token of masked pre-training
_HEAD_CHANNELS = 16  # channels of an attention head, in all published models
_WRONG_VALUES = (ValueError, LookupError, AttributeError, TypeError)  # what reading raises for content that is none
_ARCHIVE = b"PK\x03\x04"
_END, _END_64, _LOCATOR_64 = 22, 56, 20  # bytes of the records at the end of an archive
_MAX_LISTED = 12  # names that a message lists


def save(encoder: PointEncoder, path: Path) -> None:
    """Writes an encoder atomically; equal ones give equal bytes."""
    settings = {name: json.dumps(value) for name, value in encoder.settings().items()}
    metadata = {"format": FORMAT, "fingerprint": encoder.fingerprint(), **settings}
    save_weights(path, encoder.state_dict(), metadata)


def load(path: Path) -> PointEncoder:
    """Reads an encoder that `save` wrote.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``), is not an encoder or of another version
            (``weights_invalid``), its tensors do not match its configuration (``weights_mismatch``), or its content has changed
            (``weights_changed``).
    """
    tensors, metadata = read_weights(path)
    if metadata.get("format") != FORMAT:
        message = (
            f"{path} has format {metadata.get('format')!r}, expected {FORMAT!r}; for published weights, use load_published"
        )
        raise ConfigError(message, "weights_invalid")
    encoder = _build(path, lambda: _stated_shape(metadata))
    _fill(encoder, tensors, str(path))
    if encoder.fingerprint() != metadata.get("fingerprint"):
        found, expected = encoder.fingerprint(), metadata.get("fingerprint")
        message = f"{path} has fingerprint {found}, expected {expected}; the file was changed: download it again"
        raise ConfigError(message, "weights_changed")
    return encoder


def load_default() -> PointEncoder:
    """Loads the small encoder of this repository.

    Raises:
        ConfigError: Its weights are missing or damaged.
    """
    return load(DEFAULT_WEIGHTS)


def load_published(path: Path, preprocessing: Preprocessing) -> PointEncoder:
    """Reads a published checkpoint of Point Transformer V3: Pointcept's training files, Sonata, Concerto, or a plain state dict.

    Args:
        path: A ``.pth`` file in the format that torch writes since version 1.6, or a ``.safetensors`` file.
        preprocessing: The preprocessing of its training, which the file does not contain, such as
            :data:`models.point_encoder.cloud.SCANNET`.

    Returns:
        The encoder; if its output has not 64 channels, call `PointEncoder.fit_projection` next.

    Raises:
        ConfigError: The file cannot be read (``weights_invalid``), its variant is not supported (``weights_unsupported``), or its
            tensors do not match the variant (``weights_mismatch``); the message lists them.
    """
    content = _read(path)
    inner, stated = content.get("state_dict", content), content.get("config", {})
    if not (isinstance(inner, Mapping) and isinstance(stated, Mapping)):
        raise ConfigError(f"{path} holds no state dict, expected one of Point Transformer V3", "weights_invalid")
    tensors = _encoder_part({str(name): value for name, value in inner.items()}, str(path))
    encoder = _build(path, lambda: (_detect_config(tensors, stated, str(path)), preprocessing))
    _fill(encoder.backbone, tensors, str(path))
    return encoder


def _build(path: Path, read_shape: Callable[[], tuple[TransformerConfig, Preprocessing]]) -> PointEncoder:
    """Builds the encoder that a file describes, if it is no larger than the file.

    Raises:
        ConfigError: The encoder is larger, or what the file says of it has a wrong form (``weights_invalid``).
    """
    try:
        shape = read_shape()
        return build_no_larger_than(path, lambda: PointEncoder(*shape))
    except ConfigError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, RuntimeError) and is_out_of_memory(error):  # as torch says it
            raise
        message = f"{path}: its configuration cannot be read ({error!s:.300}), expected that of this version; train or convert it again"
        raise ConfigError(message, "weights_invalid") from error


def _stated_shape(metadata: Mapping[str, str]) -> tuple[TransformerConfig, Preprocessing]:
    config, preprocessing = (_tuples(json.loads(metadata[name])) for name in ("config", "preprocessing"))
    return TransformerConfig(**config), Preprocessing(**preprocessing)


def _read(path: Path) -> Mapping[str, Any]:
    try:
        if path.suffix != ".safetensors":
            _check_archive(path)
        content = load_file(path) if path.suffix == ".safetensors" else torch.load(path, map_location="cpu", weights_only=True)
    except (
        OSError,
        SafetensorError,
        pickle.UnpicklingError,
        RuntimeError,
        EOFError,
        AssertionError,
        BadZipFile,
        *_WRONG_VALUES,
    ) as error:
        if isinstance(error, RuntimeError) and is_out_of_memory(error):  # as torch says it
            raise
        # torch's own message for a file with code explains how to execute the code.
        what = "more than data" if isinstance(error, pickle.UnpicklingError) else f"{str(error).partition(chr(10))[0]:.300}"
        message = f"{path}: found {what}, expected a checkpoint of tensors and plain values alone"
        raise ConfigError(message, "weights_invalid") from error
    if not isinstance(content, Mapping):
        raise ConfigError(f"{path} holds a {type(content).__name__}, expected a state dict", "weights_invalid")
    return content


def _check_archive(path: Path) -> None:
    """Refuses a file of a format that torch no longer writes, and an archive that unpacks to more than its size.

    Raises:
        ConfigError: A member is packed, members share their bytes, or there are two lists of members (``weights_invalid``).
        BadZipFile: It is no archive.
    """
    with path.open("rb") as file:
        if file.read(4) != _ARCHIVE:  # what torch decides by
            raise BadZipFile("no archive as torch.save writes it since version 1.6")
    with ZipFile(path) as archive:
        members = archive.infolist()
        if not _is_list_where_stated(path, archive):
            raise ConfigError(
                f"{path}: its end names another list of members than the one before it, expected one list; it is damaged",
                "weights_invalid",
            )
    if packed := next((member for member in members if member.compress_type != ZIP_STORED), None):
        raise ConfigError(
            f"{path}: its member {packed.filename!r:.120} is packed, expected members as torch.save stores them; unpack and save it again",
            "weights_invalid",
        )
    if (size := sum(member.file_size for member in members)) > (there := path.stat().st_size):
        raise ConfigError(
            f"{path}: its members state {size:,} bytes, expected at most the {there:,} of the file; it is damaged",
            "weights_invalid",
        )


def _is_list_where_stated(path: Path, archive: ZipFile) -> bool:
    """Whether torch reads the list of members that Python reads: torch goes where the end of a file says, Python looks just before it."""
    end = path.stat().st_size - _END - len(archive.comment)
    with path.open("rb") as file:
        file.seek(max(end - _LOCATOR_64 - _END_64, 0))
        before = file.read(end - file.tell())
        record = file.read(_END)
    if not record.startswith(b"PK\x05\x06"):  # there is more after it
        return False
    stated = record[16:20]
    if before[-_LOCATOR_64:].startswith(b"PK\x06\x07"):
        longer, locator = before[:-_LOCATOR_64], before[-_LOCATOR_64:]
        if not longer.startswith(b"PK\x06\x06") or int.from_bytes(locator[8:16], "little") != end - _LOCATOR_64 - _END_64:
            return False
        stated = longer[48:56]
    return int.from_bytes(stated, "little") == archive.start_dir


def _encoder_part(content: Mapping[str, Any], origin: str) -> dict[str, Tensor]:
    """Returns the network's tensors without their common prefix; tensors with other prefixes are left out."""
    for prefix in _PREFIXES:
        if any(name.startswith(f"{prefix}embedding.stem.") for name in content):
            found = {name.removeprefix(prefix): value for name, value in content.items() if name.startswith(prefix)}
            found = {name: value for name, value in found.items() if not _NOT_ENCODING.match(name)}
            if others := [name for name, value in found.items() if not isinstance(value, Tensor)]:
                raise ConfigError(f"{origin}: {_first(others)} are not tensors, expected a state dict", "weights_invalid")
            return found
    message = f"{origin} has no embedding.stem ({_first(list(content))}), expected Point Transformer V3"
    raise ConfigError(message, "weights_invalid")


def _detect_config(tensors: Mapping[str, Tensor], stated: Mapping[str, Any], origin: str) -> TransformerConfig:
    """Detects the variant from names and shapes; heads, patches and curves are from the stated configuration, if any."""
    if rope := [name for name in tensors if "rope" in name]:
        message = f"{origin} has rotary positions ({_first(rope)}), expected first generation, Sonata or Concerto"
        raise ConfigError(message, "weights_unsupported")
    is_conv = "embedding.stem.conv.weight" in tensors
    stem = tensors.get(f"embedding.stem.{'conv' if is_conv else 'linear'}.weight")
    if stem is None or stem.ndim != (5 if is_conv else 2):
        message = (
            f"{origin} has stem {None if stem is None else tuple(stem.shape)}, expected a 5-D convolution or a linear layer"
        )
        raise ConfigError(message, "weights_mismatch")
    depths, channels, heads = {}, {}, {}
    for part in ("enc", "dec"):
        depths[part], channels[part] = _stages(tensors, part)
        default = [c // _HEAD_CHANNELS for c in channels[part]]
        heads[part] = tuple(stated.get(f"{part}_num_head", default))[: len(default)]
    scales = [tensor for name, tensor in tensors.items() if name.endswith(".ls1.0.gamma")]
    patch_sizes = {*stated.get("enc_patch_size", (1024,)), *(stated.get("dec_patch_size", ()) if depths["dec"] else ())}
    if len(patch_sizes) != 1:
        message = f"{origin} has patch sizes {sorted(patch_sizes)}, expected the same in every stage"
        raise ConfigError(message, "weights_unsupported")
    order = stated.get("order", CURVES)
    return TransformerConfig(
        in_channels=stem.shape[-1],
        stem="conv" if is_conv else "linear",
        norm="bn" if "embedding.stem.norm.running_mean" in tensors else "ln",
        pool="code" if is_conv else "grid",
        enc_mode=not depths["dec"],
        layer_scale=float(scales[0][(0,) * scales[0].ndim]) if scales else None,
        legacy_stale_cpe=is_conv,
        curves=(order,) if isinstance(order, str) else tuple(order),
        patch_size=int(patch_sizes.pop()),
        enc_depths=depths["enc"],
        enc_channels=channels["enc"],
        enc_heads=heads["enc"],
        dec_depths=depths["dec"],
        dec_channels=channels["dec"],
        dec_heads=heads["dec"],
    )


def _stages(tensors: Mapping[str, Tensor], part: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The depth and channels of each stage."""
    blocks: dict[int, set[int]] = {}
    for name in tensors:
        if found := re.match(rf"{part}\.{part}(\d+)\.block(\d+)\.", name):
            blocks.setdefault(int(found[1]), set()).add(int(found[2]))
    widths = {s: tensors.get(f"{part}.{part}{s}.block0.norm1.0.weight") for s in blocks}
    return (
        tuple(len(blocks[s]) for s in sorted(blocks)),
        tuple(0 if (width := widths[s]) is None else len(width) for s in sorted(blocks)),
    )


def _fill(module: torch.nn.Module, tensors: Mapping[str, Tensor], origin: str) -> None:
    """Loads all tensors, or refuses with lists of missing, unexpected and differently shaped ones."""
    required = module.state_dict()
    wrong = [
        f"{name} is {tuple(tensors[name].shape)}, expected {tuple(required[name].shape)}"
        for name in required
        if name in tensors and tensors[name].shape != required[name].shape
    ]
    missing, unexpected = [n for n in required if n not in tensors], [n for n in tensors if n not in required]
    found = (("missing", missing), ("unexpected", unexpected), ("shape", wrong))
    if any(names for _, names in found):
        listed = "; ".join(f"{len(names)} {what}: {_first(names)}" for what, names in found if names)
        raise ConfigError(f"{origin} does not match its variant of Point Transformer V3: {listed}", "weights_mismatch")
    module.load_state_dict(dict(tensors))


def _first(names: list[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else "")


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Converts lists to tuples, which JSON does not have."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
