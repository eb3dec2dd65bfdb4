"""Settings of the ``openai`` engine, apart from the engine, since the ``openai`` client takes long to import."""

import json
import os
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from models.settings import NonNegative, PositiveCount, Settings
from stable_data.errors import ConfigError

CONNECT_SECONDS = 10.0
"""The longest wait for a connection; a round figure, not tuned."""


@dataclass(frozen=True, slots=True)
class HttpSettings(Settings):
    """Settings of an endpoint and of the waits for it."""

    base_url: str
    """URL that ``/chat/completions`` is appended to, such as ``https://api.openai.com/v1``; for Azure the resource, such as
    ``https://NAME.openai.azure.com``.
    """

    model: str
    """The endpoint's name of the model; for Azure the deployment. The jobs take it from ``engine.engine``."""

    key_variable: str = ""
    """Environment variable that holds the key, such as ``OPENAI_API_KEY``; empty sends no key."""

    azure_api_version: str = ""
    """Version of Azure's API, such as ``2024-10-21``; empty where the endpoint is not of Azure."""

    concurrency: PositiveCount = 32
    """Requests under way at once, at most; a request that waits for its next try counts."""

    tries: PositiveCount = 6
    """How often a request is sent, at most. The client waits between tries: 0.5 s, doubled each time up to 8 s, or what the
    endpoint asks for, up to 120 s.
    """

    read_s: NonNegative = 300.0
    """Seconds; the longest silence while an answer is waited for."""

    total_s: NonNegative = 900.0
    """Seconds; the longest time for a request with all of its tries."""

    prompt_price: NonNegative = 0.0
    """Price of a million tokens that are read, in any currency."""

    reply_price: NonNegative = 0.0
    """Price of a million tokens that are written, in the same currency."""

    extra: str = ""
    """Further fields of the request, a JSON object, such as ``{"top_k": 50}`` for vLLM; null removes a field, as in
    ``{"max_tokens": null, "max_completion_tokens": 4096}``.
    """

    rest_s: NonNegative = 60.0
    """Seconds; for this long all requests fail at once after the endpoint was found to be down."""

    def check(self) -> None:
        """Refuses an invalid address, model or field; see the base class.

        Raises:
            ConfigError: One of them is invalid (``config_invalid``).
        """
        if not self._is_url():
            shown = self.base_url.rpartition("@")[2].partition("?")[0]  # user and query may contain a password
            expected = (
                "expected such as https://api.openai.com/v1, without user, query and fragment; key_variable names the key"
            )
            raise ConfigError(f"base_url is {shown!r}, {expected}", "config_invalid")
        if not self.model:
            raise ConfigError("model is empty, expected the endpoint's name of a model, such as gpt-4o", "config_invalid")
        if self.azure_api_version and not self.key_variable:
            raise ConfigError("key_variable is empty, expected one for Azure, such as AZURE_OPENAI_API_KEY", "config_invalid")
        self.extra_fields()

    def _is_url(self) -> bool:
        if not self.base_url.isascii() or any(c.isspace() for c in self.base_url):
            return False
        try:
            url = urlsplit(self.base_url)
            is_host = url.scheme in ("http", "https") and url.hostname and url.port != 0
        except ValueError:
            return False
        return bool(is_host) and url.username is None and not url.query and not url.fragment

    def extra_fields(self) -> dict[str, Any]:
        """Returns the fields of ``extra``.

        Raises:
            ConfigError: ``extra`` is not a JSON object.
        """
        try:
            fields = json.loads(self.extra) if self.extra else {}
        except (ValueError, RecursionError):
            fields = None
        if not isinstance(fields, dict):
            raise ConfigError(f'extra is {self.extra!r:.80}, expected a JSON object such as {{"top_k": 50}}', "config_invalid")
        return fields

    def read_key(self) -> str:
        """Returns the key, which only the environment holds; empty if none is sent.

        Raises:
            ConfigError: The variable is not set, or its value cannot be sent (``key_missing``).
        """
        if not self.key_variable:
            return ""
        key = os.environ.get(self.key_variable, "").strip()
        if not key:
            raise ConfigError(f"{self.key_variable} is not set, expected the key of {self.base_url}; export it", "key_missing")
        if not key.isascii() or not key.isprintable() or " " in key:
            raise ConfigError(f"{self.key_variable} is not a key, expected printable ASCII without spaces", "key_missing")
        return key
