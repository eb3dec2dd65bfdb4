"""Settings of the ``openai`` engine."""

import json
import math
import os
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class HttpSettings:
    """An endpoint, and how patiently it is asked.

    Attributes:
        base_url: What ``/chat/completions`` is appended to, such as ``https://api.openai.com/v1``.
        model: The endpoint's name of the model.
        key_variable: Environment variable that holds the key, such as ``OPENAI_API_KEY``; empty sends none.
        concurrency: Most requests under way at once.
        tries: Most times that a request is sent.
        first_wait_s: Longest wait before the second try, seconds; doubled for every further one ...
        longest_wait_s: ... up to this. Waits are drawn evenly from 0 on; one that the endpoint asks for is kept.
        connect_s: Longest wait for a connection, seconds.
        read_s: Longest silence while an answer is waited for, seconds.
        total_s: Longest time for a request with all of its tries, seconds; a last try may go on for ``read_s``.
        prompt_price: Of a million tokens read, in whatever currency.
        reply_price: Of a million tokens written.
        extra: More fields of the body, a JSON object, such as ``{"top_k": 50}`` for vLLM; empty: none.
        sends_form: Whether the form of replies is sent in a field of our own; for :mod:`.chat_server`, others refuse it.
        give_up_after: So many failures in a row while nothing was answered yet, and the endpoint is held to be down ...
        rest_s: ... for so long, seconds: what is asked meanwhile fails at once.
    """

    base_url: str
    model: str
    key_variable: str = ""
    concurrency: int = 32
    tries: int = 8
    first_wait_s: float = 0.5
    longest_wait_s: float = 60.0
    connect_s: float = 10.0
    read_s: float = 300.0
    total_s: float = 900.0
    prompt_price: float = 0.0
    reply_price: float = 0.0
    extra: str = ""
    sends_form: bool = False
    give_up_after: int = 5
    rest_s: float = 60.0

    def __post_init__(self) -> None:
        """Refuses what cannot work."""
        self._check_url()
        if not self.model:
            raise ConfigError("model is empty, expected the endpoint's name of one, such as gpt-4o", "config_invalid")
        for key in ("concurrency", "tries", "connect_s", "read_s", "total_s", "give_up_after"):
            if not 0 < getattr(self, key) < math.inf:
                raise ConfigError(f"{key} is {getattr(self, key)}, expected a positive number", "config_invalid")
        for key in ("first_wait_s", "longest_wait_s", "prompt_price", "reply_price", "rest_s"):
            if not 0 <= getattr(self, key) < math.inf:
                raise ConfigError(f"{key} is {getattr(self, key)}, expected 0 or more", "config_invalid")
        self.extra_fields()

    def _check_url(self) -> None:
        try:
            parts = urlsplit(self.base_url)
            is_whole = parts.scheme in ("http", "https") and parts.hostname and (parts.port is None or parts.port > 0)
        except ValueError:
            is_whole = False
        if not is_whole or not self.base_url.isascii() or set(self.base_url) & set(" \t\r\n"):
            shown = self.base_url.rpartition("@")[2]  # what stands before it may be a password
            raise ConfigError(f"base_url is {shown!r}, expected such as https://api.openai.com/v1", "config_invalid")
        if parts.username is not None or parts.query or parts.fragment:
            raise ConfigError(
                "base_url has a user, a query or a fragment, expected none; name the variable that holds a key in key_variable",
                "config_invalid",
            )

    def extra_fields(self) -> dict[str, Any]:
        """What ``extra`` says.

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
            ConfigError: The variable is not set, or holds what cannot be sent.
        """
        if not self.key_variable:
            return ""
        key = os.environ.get(self.key_variable, "").strip()
        if not key:
            raise ConfigError(f"{self.key_variable} is not set, expected the key of {self.base_url}; export it", "key_missing")
        if not key.isascii() or not key.isprintable() or " " in key:
            raise ConfigError(
                f"{self.key_variable} holds what is no key: expected printable ASCII without spaces", "key_missing"
            )
        return key
