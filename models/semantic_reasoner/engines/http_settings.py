"""Settings of the ``openai`` engine; the engine itself is imported only where it is used, since the client takes long to load."""

import json
import math
import os
from dataclasses import dataclass
from typing import Any, ClassVar
from urllib.parse import urlsplit

from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class HttpSettings:
    """An endpoint, and how long the engine waits for it.

    Attributes:
        base_url: What ``/chat/completions`` is appended to, such as ``https://api.openai.com/v1``; for Azure the resource, such as
            ``https://NAME.openai.azure.com``.
        model: The endpoint's name of the model; for Azure the deployment.
        key_variable: Environment variable that holds the key, such as ``OPENAI_API_KEY``; empty sends none.
        azure_api_version: Version of Azure's API, such as ``2024-10-21``; empty: the endpoint is not of Azure.
        concurrency: Most requests under way at once, those that wait for their next try included.
        tries: Most times that a request is sent. The client waits between them: 0.5 s doubled each time up to 8 s, or what the
            endpoint asks for up to 120 s.
        connect_s: Longest wait for a connection, seconds.
        read_s: Longest silence while an answer is waited for, seconds.
        total_s: Longest time for a request with all of its tries, seconds.
        prompt_price: Of a million tokens read, in any currency.
        reply_price: Of a million tokens written.
        extra: More fields of the body, a JSON object, such as ``{"top_k": 50}`` for vLLM; null leaves a field out, such as
            ``{"max_tokens": null, "max_completion_tokens": 4096, "temperature": null}``.
        rest_s: When the endpoint is down, requests fail at once for so long, seconds.
    """

    base_url: str
    model: str
    key_variable: str = ""
    azure_api_version: str = ""
    concurrency: int = 32
    tries: int = 6
    connect_s: float = 10.0
    read_s: float = 300.0
    total_s: float = 900.0
    prompt_price: float = 0.0
    reply_price: float = 0.0
    extra: str = ""
    rest_s: float = 60.0

    REMOVED: ClassVar[dict[str, str]] = {
        "first_wait_s": "the openai client chooses the waits; set tries and total_s",
        "longest_wait_s": "the openai client chooses the waits; set tries and total_s",
        "give_up_after": "a short question tells whether the endpoint is down; set tries and rest_s",
        "sends_form": "the form is sent as response_format; extra has further fields",
    }
    """Settings of earlier versions, and what to do instead."""

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ConfigError: One of them cannot work.
        """
        if not self._is_url():
            shown = self.base_url.rpartition("@")[2].partition("?")[0]  # what stands around it may be a password
            expected = (
                "expected such as https://api.openai.com/v1, without user, query and fragment; key_variable names the key"
            )
            raise ConfigError(f"base_url is {shown!r}, {expected}", "config_invalid")
        if not self.model:
            raise ConfigError("model is empty, expected the endpoint's name of one, such as gpt-4o", "config_invalid")
        for key in ("concurrency", "tries", "connect_s", "read_s", "total_s", "prompt_price", "reply_price", "rest_s"):
            value, least = getattr(self, key), 1 if key in ("concurrency", "tries") else 0
            if not least <= value < math.inf:
                raise ConfigError(f"{key} is {value}, expected {least} or more", "config_invalid")
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
        """The fields of ``extra``.

        Raises:
            ConfigError: It is no JSON object.
        """
        try:
            fields = json.loads(self.extra) if self.extra else {}
        except (ValueError, RecursionError):
            fields = None
        if not isinstance(fields, dict):
            raise ConfigError(f'extra is {self.extra!r:.80}, expected a JSON object such as {{"top_k": 50}}', "config_invalid")
        return fields

    def read_key(self) -> str:
        """The key, empty where none is sent; it is nowhere but in the environment.

        Raises:
            ConfigError: The variable is not set, or its value cannot be sent.
        """
        if not self.key_variable:
            return ""
        key = os.environ.get(self.key_variable, "").strip()
        if not key:
            raise ConfigError(f"{self.key_variable} is not set, expected the key of {self.base_url}; export it", "key_missing")
        if not key.isascii() or not key.isprintable() or " " in key:
            raise ConfigError(f"{self.key_variable} is no key, expected printable ASCII without spaces", "key_missing")
        return key
