"""Models and tokenizers as plain Hugging Face folders: read with one clear line where that fails, written in one step."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from transformers import AutoConfig, AutoModelForCausalLM, AutoTokenizer, PreTrainedModel, PreTrainedTokenizerBase

from stable_data.content_id import content_id
from stable_data.errors import ConfigError

NOTES = "reasoner.json"
"""What a folder of weights says of how they were made."""

# What transformers raises on folders that hold something else.
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, ImportError, SafetensorError)


def read_tokenizer(folder: Path) -> PreTrainedTokenizerBase:
    """The tokenizer in a folder.

    Raises:
        ConfigError: There is none, or it has no chat template or no token that ends a reply.
    """
    try:
        if not folder.is_dir():
            raise OSError("no such folder")  # transformers would look for it elsewhere
        found: PreTrainedTokenizerBase = AutoTokenizer.from_pretrained(str(folder), local_files_only=True)
    except _UNREADABLE as error:
        raise _invalid(folder, "tokenizer", error) from error
    for what, value in (("chat template", found.chat_template), ("token that ends a reply", found.eos_token)):
        if value is None:
            raise ConfigError(f"{folder}: its tokenizer has no {what}, expected one of a chat model", "base_invalid")
    if not found.is_fast:
        raise ConfigError(f"{folder}: its tokenizer has no tokenizer.json, expected one", "base_invalid")
    if found.pad_token_id is None:
        found.pad_token = found.eos_token
    return found


def read_config(folder: Path, max_tokens: int) -> Any:
    """The configuration of the model in a folder.

    Raises:
        ConfigError: There is none, or its model is not made for sequences that long.
    """
    try:
        if not (folder / "config.json").is_file():
            raise OSError("no config.json")
        config = AutoConfig.from_pretrained(str(folder), local_files_only=True)
    except _UNREADABLE as error:
        raise _invalid(folder, "model", error) from error
    longest = getattr(config, "max_position_embeddings", max_tokens)
    if longest < max_tokens:
        raise ConfigError(f"{folder}: is made for {longest} tokens, expected max_tokens {max_tokens} or more", "base_invalid")
    return config


def read_model(folder: Path, max_tokens: int) -> PreTrainedModel:
    """The causal language model in a folder, in the precision of its file, on the CPU.

    Raises:
        ConfigError: There is none that can be read, or none of a decoder and a head.
    """
    read_config(folder, max_tokens)
    try:
        found: PreTrainedModel = AutoModelForCausalLM.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, dtype="auto"
        )
    except _UNREADABLE as error:
        raise _invalid(folder, "model", error) from error
    if not (hasattr(getattr(found, "model", None), "layers") and hasattr(found, "lm_head")):
        name = type(found).__name__
        raise ConfigError(f"{folder}: {name} has no model.layers and lm_head, expected a decoder such as Qwen3", "base_invalid")
    return found


def model_fingerprint(folder: Path) -> str:
    """Which model a folder holds: its configuration, and the names and sizes of its files of weights."""
    try:
        config = json.loads((folder / "config.json").read_text("utf-8"))
        sizes = {path.name: path.stat().st_size for path in sorted(folder.glob("*.safetensors"))}
    except (OSError, ValueError) as error:
        raise _invalid(folder, "model", error) from error
    return content_id(config, sizes)


def write_model(folder: Path, model: Any, tokenizer: PreTrainedTokenizerBase, notes: dict[str, Any]) -> None:
    """Puts a model in place in one step, as transformers loads it.

    Args:
        folder: Where.
        model: A model of transformers or peft.
        tokenizer: Its tokenizer.
        notes: What ``reasoner.json`` says.
    """
    aside = folder.with_name(f".{folder.name}.{os.getpid()}")
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        model.save_pretrained(aside)
        tokenizer.save_pretrained(aside)
        (aside / NOTES).write_text(json.dumps(notes, indent=2, sort_keys=True, ensure_ascii=False) + "\n", "utf-8")
        for path in aside.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())  # a rename must not outlive its content
        shutil.rmtree(old, ignore_errors=True)
        if folder.is_dir():
            folder.replace(old)
        aside.replace(folder)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _invalid(folder: Path, what: str, error: Exception) -> ConfigError:
    reason = str(error).strip().partition("\n")[0] or type(error).__name__
    return ConfigError(f"{folder}: holds no {what} that can be read ({reason}), expected a Hugging Face folder", "base_invalid")
