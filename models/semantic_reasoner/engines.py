"""Which engine answers: named in a word, made in one place."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

from models.semantic_reasoner.engine import Engine, Sampling
from models.semantic_reasoner.http_settings import HttpSettings
from stable_data.errors import ConfigError

EMBEDDED = Path(__file__).resolve().parents[1] / "weights" / "semantic_reasoner"
"""Our own small reasoner; models/weights/README.md says how it was made and what it does."""

KINDS = ("embedded", "transformers", "vllm", "openai", "scripted")
"""Kinds of engines."""


@dataclass(frozen=True, slots=True)
class EngineSettings:
    """An engine.

    Attributes:
        engine: ``embedded`` (our own small model), ``transformers:FOLDER`` (a Hugging Face folder), ``vllm:FOLDER``,
            ``openai:MODEL`` (the endpoint ``http.base_url``) or ``scripted:FILE``.
        sampling: How tokens are drawn.
        num_slots: Most sequences that a model in this process decodes at a time.
        cache: Folder that keeps completions, so that a run that is taken up again replays them; empty keeps none. For engines
            that cannot repeat themselves (``openai``, ``vllm``).
        num_gpus: That share a model in vLLM.
        vllm: More arguments of ``vllm.LLM``, a JSON object.
        http: Of the endpoint.
    """

    engine: str = "embedded"
    sampling: Sampling = field(default_factory=Sampling)
    num_slots: int = 64
    cache: str = ""
    num_gpus: int = 1
    vllm: str = "{}"
    http: HttpSettings = field(default_factory=lambda: HttpSettings("http://127.0.0.1:8000/v1", "default"))

    def __post_init__(self) -> None:
        """Refuses what names no engine."""
        kind, _, what = self.engine.partition(":")
        if kind not in KINDS or bool(what) != (kind != "embedded"):
            raise ConfigError(
                f"engine is {self.engine!r}, expected embedded, transformers:FOLDER, vllm:FOLDER, openai:MODEL or scripted:FILE",
                "config_invalid",
            )
        if self.num_slots < 1 or self.num_gpus < 1:
            raise ConfigError(f"num_slots is {self.num_slots}, num_gpus {self.num_gpus}, expected at least 1", "config_invalid")

    @property
    def kind(self) -> str:
        """One of :data:`KINDS`."""
        return self.engine.partition(":")[0]

    @property
    def reads_reasons(self) -> bool:
        """Whether the engine can use the reason why an answer was refused: the embedded model has seen none."""
        return self.kind != "embedded"

    @property
    def folder(self) -> Path | None:
        """The model's folder, where it is one here."""
        if self.kind == "embedded":
            return EMBEDDED
        return Path(self.engine.partition(":")[2]) if self.kind in ("transformers", "vllm") else None


def load_engine(settings: EngineSettings) -> Engine:
    """The engine that the settings name.

    Raises:
        ConfigError: It cannot be made: no such folder, an extra that is missing, a key that is not set.
    """
    engine = _bare(settings)
    if not settings.cache:
        return engine
    from models.semantic_reasoner.response_cache import CachedEngine, ResponseCache

    return CachedEngine(engine, ResponseCache(settings.cache), settings.sampling)


def _bare(settings: EngineSettings) -> Engine:
    # Imported where they are asked for: torch, transformers and vLLM take seconds to load.
    what = settings.engine.partition(":")[2]
    if settings.kind == "openai":
        from models.semantic_reasoner.http_engine import HttpEngine

        return HttpEngine(replace(settings.http, model=what), settings.sampling)
    if settings.kind == "vllm":
        from models.semantic_reasoner.vllm_engine import VllmEngine

        return VllmEngine(what, settings.sampling, settings.num_gpus, **_options(settings.vllm))
    if settings.kind == "scripted":
        from models.semantic_reasoner.scripted_engine import ScriptedEngine

        return ScriptedEngine.from_file(Path(what))
    from models.semantic_reasoner.local_engine import LocalEngine

    assert settings.folder is not None
    name = "embedded" if settings.kind == "embedded" else ""
    return LocalEngine.load(settings.folder, name, settings.sampling, settings.num_slots)


def _options(text: str) -> dict[str, object]:
    try:
        options = json.loads(text)
    except ValueError:
        options = None
    if not isinstance(options, dict):
        raise ConfigError(f"vllm is {text!r:.80}, expected a JSON object such as {{}}", "config_invalid")
    return options
