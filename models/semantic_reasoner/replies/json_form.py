"""The form of replies that are any JSON object by a schema, for questions other than those about layouts."""

import json
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class JsonForm:
    """A form of replies, by its JSON Schema.

    Attributes:
        name: Its name, letters, digits and underscores.
        schema_json: The JSON Schema as text, so that forms can be compared and hashed. Endpoints know the keywords of OpenAI's
            strict mode only: every key is required and no other is allowed.
        binds: Whether an answer is this JSON alone; else any text may surround it.
    """

    name: str
    schema_json: str
    binds: bool = True

    def schema(self) -> dict[str, Any]:
        """Returns the JSON Schema."""
        found: dict[str, Any] = json.loads(self.schema_json)
        return found

    def grammar(self) -> str:
        """Returns the Lark grammar for llguidance."""
        return f"start: %json {self.schema_json}"
