"""Reads and writes models and tokenizers as Hugging Face folders: failures give one clear line, and writing is atomic."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from transformers import AutoConfig, AutoModelForCausalLM, AutoTokenizer, PreTrainedModel, PreTrainedTokenizerBase

from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.json_text import read_json

NOTES = "reasoner.json"
"""File in a folder of weights that states how they were made."""

# The errors of transformers for folders with other content.
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, ImportError, SafetensorError)


def read_tokenizer(folder: Path) -> PreTrainedTokenizerBase:
    """Reads the tokenizer in a folder.

    Raises:
        ConfigError: There is none, or it has no chat template or no token that ends a reply (``base_invalid``).
    """
    try:
        if not folder.is_dir():
            raise OSError("no such folder")  # transformers would take the path as the name of a model on its hub
        found: PreTrainedTokenizerBase = AutoTokenizer.from_pretrained(
            str(folder), local_files_only=True, trust_remote_code=False
        )
    except _UNREADABLE as error:
        raise _unreadable(folder, "tokenizer", error) from error
    for what, value in (("chat template", found.chat_template), ("token that ends a reply", found.eos_token)):
        if value is None:
            raise ConfigError(f"{folder}: its tokenizer has no {what}, expected one of a chat model", "base_invalid")
    if not found.is_fast:
        raise ConfigError(f"{folder}: its tokenizer has no tokenizer.json, expected one", "base_invalid")
    if found.pad_token_id is None:
        found.pad_token = found.eos_token
    return found


def read_config(folder: Path, max_tokens: int) -> Any:
    """Reads the configuration of the model in a folder.

    Raises:
        ConfigError: There is none, or the model does not read ``max_tokens`` tokens (``base_invalid``).
    """
    try:
        if not (folder / "config.json").is_file():
            raise OSError("no config.json")
        config = AutoConfig.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False)
    except _UNREADABLE as error:
        raise _unreadable(folder, "model", error) from error
    longest = getattr(config, "max_position_embeddings", max_tokens)
    if longest < max_tokens:
        raise ConfigError(f"{folder}: reads {longest} tokens, expected max_tokens {max_tokens} or more", "base_invalid")
    return config


def read_model(folder: Path, max_tokens: int) -> PreTrainedModel:
    """Reads the causal language model in a folder, in the precision of its file, on the CPU.

    Raises:
        ConfigError: There is no readable one, or it is not a decoder with a head (``base_invalid``).
    """
    read_config(folder, max_tokens)
    try:
        found: PreTrainedModel = AutoModelForCausalLM.from_pretrained(
            str(folder), local_files_only=True, trust_remote_code=False, use_safetensors=True, dtype="auto"
        )
    except _UNREADABLE as error:
        raise _unreadable(folder, "model", error) from error
    if not (hasattr(getattr(found, "model", None), "layers") and hasattr(found, "lm_head")):
        name = type(found).__name__
        raise ConfigError(f"{folder}: {name} has no model.layers and lm_head, expected a decoder such as Qwen3", "base_invalid")
    return found


def model_fingerprint(folder: Path) -> str:
    """Returns a fingerprint of the model in a folder: of its configuration, and of the names and sizes of its weight files."""
    try:
        config = read_json(folder / "config.json")
        sizes = {path.name: path.stat().st_size for path in sorted(folder.glob("*.safetensors"))}
    except (OSError, ValueError) as error:
        raise _unreadable(folder, "model", error) from error
    return content_id(config, sizes)


def write_model(folder: Path, model: Any, tokenizer: PreTrainedTokenizerBase, notes: dict[str, Any]) -> None:
    """Writes a model of transformers or peft atomically, in the form that transformers loads; an existing folder is replaced.

    ``notes`` are the content of ``reasoner.json``.
    """
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}")
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        model.save_pretrained(temporary)
        tokenizer.save_pretrained(temporary)
        (temporary / NOTES).write_text(json.dumps(notes, indent=2, sort_keys=True, ensure_ascii=False) + "\n", "utf-8")
        for path in temporary.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())  # else a power cut may keep the rename and lose the content
        shutil.rmtree(old, ignore_errors=True)
        if folder.is_dir():  # a rename does not replace a folder with content
            folder.replace(old)
        temporary.replace(folder)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _unreadable(folder: Path, what: str, error: Exception) -> ConfigError:
    reason = str(error).strip().partition("\n")[0] or type(error).__name__
    return ConfigError(f"{folder}: has no readable {what} ({reason}), expected a Hugging Face folder", "base_invalid")
