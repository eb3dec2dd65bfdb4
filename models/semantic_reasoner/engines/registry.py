"""Settings of an engine, and the function that makes the engine which they name."""

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Engine, Sampling
from models.settings import PositiveCount, Settings
from stable_data.content_id import content_id
from stable_data.errors import ConfigError

EMBEDDED = Path(__file__).resolve().parents[2] / "weights" / "semantic_reasoner"
"""Folder of the embedded small reasoner; its README.md describes its training and its results."""

KINDS = ("embedded", "transformers", "vllm", "openai", "scripted")
"""Kinds of engines."""

_MODEL_FILES = ("*.json", "*.safetensors", "*.jinja", "*.model")


@dataclass(frozen=True, slots=True)
class EngineSettings(Settings):
    """Settings of an engine."""

    engine: str = "embedded"
    """``embedded`` (the small model in models/weights), ``transformers:FOLDER`` (a Hugging Face folder), ``vllm:FOLDER``,
    ``openai:MODEL`` (an endpoint, ``http.base_url``) or ``scripted:FILE`` (replies of a file).
    """

    sampling: Sampling = field(default_factory=Sampling)
    """How tokens are drawn."""

    num_slots: PositiveCount = 64
    """Sequences that a model in this process or in vLLM decodes at a time, at most. A shared model holds as many more requests
    that wait for a place; further ones wait at the workers.
    """

    cache: str = ""
    """Folder that keeps completions; a run that is resumed reads them from there. Empty keeps none. It is for engines whose
    replies differ from call to call (``openai``, ``vllm``).
    """

    num_gpus: PositiveCount = 1
    """GPUs that a model in vLLM is split over."""

    vllm: str = "{}"
    """Further arguments of ``vllm.AsyncEngineArgs``, a JSON object."""

    http: HttpSettings = field(default_factory=lambda: HttpSettings("http://127.0.0.1:8000/v1", "default"))
    """The endpoint of the ``openai`` engine."""

    def check(self) -> None:
        """Refuses an unknown engine; see the base class."""
        kind, _, what = self.engine.partition(":")
        if kind not in KINDS or bool(what) != (kind != "embedded"):
            raise ConfigError(
                f"engine is {self.engine!r}, expected embedded, transformers:FOLDER, vllm:FOLDER, openai:MODEL or scripted:FILE",
                "config_invalid",
            )

    @property
    def kind(self) -> str:
        """One of :data:`KINDS`."""
        return self.engine.partition(":")[0]

    @property
    def is_priced(self) -> bool:
        """Whether the cost of replies is known: an endpoint without prices may cost anything."""
        return self.kind != "openai" or self.http.prompt_price > 0 or self.http.reply_price > 0

    @property
    def num_at_once(self) -> int:
        """Number of requests that are completed at a time, at most."""
        return self.http.concurrency if self.kind == "openai" else self.num_slots

    @property
    def reads_reasons(self) -> bool:
        """Whether the engine can use the reasons of refusals; the embedded model was not trained on any."""
        return self.kind != "embedded"

    def settled(self) -> "EngineSettings":
        """Returns the settings with absolute paths, so that they hold in any working directory."""
        kind, _, what = self.engine.partition(":")
        engine = f"{kind}:{_absolute(what)}" if kind in ("transformers", "vllm", "scripted") else self.engine
        return replace(self, engine=engine, cache=_absolute(self.cache) if self.cache else "")

    def shaping(self) -> dict[str, Any]:
        """Returns everything that replies depend on, with hashes of files; the endpoint's address and limits are left out.

        Raises:
            ConfigError: The model or the script is missing (``engine_missing``), or the key is (``key_missing``).
        """
        kind, _, what = self.engine.partition(":")
        found: dict[str, Any] = {"engine": kind, "sampling": asdict(self.sampling)}
        if kind == "openai":
            self.http.read_key()
            return found | {"model": what, "extra": self.http.extra_fields()}
        if kind == "scripted":
            return found | {"model": _file_hash(Path(what), "a script")}
        assert self.folder is not None
        _file_hash(self.folder / "config.json", "a Hugging Face folder")
        files = sorted(path for pattern in _MODEL_FILES for path in self.folder.glob(pattern))
        found["model"] = content_id({path.name: _file_hash(path, "a file of a model") for path in files})
        return found | ({"vllm": _options(self.vllm)} if kind == "vllm" else {})

    @property
    def folder(self) -> Path | None:
        """The model's folder; None if the engine has no local model."""
        if self.kind == "embedded":
            return EMBEDDED
        return Path(self.engine.partition(":")[2]) if self.kind in ("transformers", "vllm") else None


_EMBEDDED_MAX_TOKENS = 1280
"""Limit of the embedded model's replies: the longest one of its training has 711 tokens, and much longer ones are loops."""


def load_engine(settings: EngineSettings) -> Engine:
    """Loads the engine that the settings name.

    Raises:
        ConfigError: It cannot be loaded: a missing folder, a missing extra, or a key that is not set.
    """
    engine = _uncached_engine(settings)
    if not settings.cache:
        return engine
    from models.semantic_reasoner.engines.response_cache import CachedEngine, ResponseCache

    return CachedEngine(engine, ResponseCache(settings.cache), settings.sampling)


def _uncached_engine(settings: EngineSettings) -> Engine:
    # Imported on use, since torch, transformers and vLLM take seconds to import.
    what = settings.engine.partition(":")[2]
    if settings.kind == "openai":
        from models.semantic_reasoner.engines.openai_engine import OpenAIEngine

        return OpenAIEngine(replace(settings.http, model=what), settings.sampling)
    if settings.kind == "vllm":
        from models.semantic_reasoner.engines.vllm_engine import VllmEngine

        options = {"max_num_seqs": settings.num_slots, **_options(settings.vllm)}
        return VllmEngine(what, settings.sampling, settings.num_gpus, **options)
    if settings.kind == "scripted":
        from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine

        return ScriptedEngine.from_file(Path(what))
    from models.semantic_reasoner.engines.local_engine import LocalEngine

    assert settings.folder is not None
    name, sampling = "", settings.sampling
    if settings.kind == "embedded":
        name = "embedded"
        sampling = replace(sampling, max_tokens=min(sampling.max_tokens, _EMBEDDED_MAX_TOKENS))
    return LocalEngine.load(settings.folder, name, sampling, settings.num_slots)


def _absolute(path: str) -> str:
    return str(Path(path).expanduser().resolve())


def _file_hash(path: Path, expected: str) -> str:
    """Hash of a file's content."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()[:16]
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror or error}), expected {expected}; name another engine", "engine_missing"
        ) from error


def _options(text: str) -> dict[str, object]:
    try:
        options = json.loads(text)
    except ValueError:
        options = None
    if not isinstance(options, dict):
        raise ConfigError(f"vllm is {text!r:.80}, expected a JSON object such as {{}}", "config_invalid")
    return options
