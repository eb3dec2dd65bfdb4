"""Which reasoner a job asks, as words that a command line can say and a worker can open."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from models.semantic_reasoner.engine import Engine, Sampling
from stable_data.errors import ConfigError
from stable_data.shards import content_id

NONE, EMBEDDED = "none", "embedded"

EMBEDDED_FOLDER = Path(__file__).resolve().parents[1] / "models" / "weights" / "semantic_reasoner"

_SHAPING = ("*.json", "*.safetensors", "*.jinja", "*.model")


@dataclass(frozen=True, slots=True)
class EngineChoice:
    """An engine that is not open yet; what is sent to workers.

    Attributes:
        name: What it is called.
        fingerprint: Of all that its replies depend on: a run is resumed only with the same.
        open: Opens it; a function that can be pickled.
    """

    name: str
    fingerprint: str
    open: Callable[[], Engine]


def engine_choice(words: str, sampling: Sampling) -> EngineChoice | None:
    """The engine that some words name.

    Args:
        words: ``none``; ``embedded``, the one in the repository; or a Hugging Face folder.
        sampling: How it draws.

    Returns:
        The engine; None for ``none``.

    Raises:
        ConfigError: There is no such folder (``engine_missing``).
    """
    if words == NONE:
        return None
    folder = (EMBEDDED_FOLDER if words == EMBEDDED else Path(words).expanduser()).resolve()
    if not (folder / "config.json").is_file():
        raise ConfigError(
            f"engine {words}: {folder} holds no config.json, expected a Hugging Face folder; name another, or none where every "
            "edit has its reply",
            "engine_missing",
        )
    found = content_id(str(sampling), {path.name: _sha256(path) for pattern in _SHAPING for path in folder.glob(pattern)})
    return EngineChoice(words if words == EMBEDDED else folder.name, found, partial(_local, folder, sampling))


def _local(folder: Path, sampling: Sampling) -> Engine:
    from models.semantic_reasoner.local_engine import LocalEngine  # transformers takes seconds to import

    return LocalEngine.load(folder, sampling=sampling)


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
