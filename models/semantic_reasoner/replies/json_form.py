"""The form of replies that are any JSON document, for questions that are not about a layout."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# Else llguidance tokenizes forced text by itself, as in the grammar of layouts.
_GRAMMAR = '%llguidance {{"no_forcing": true}}\nstart: reply\nreply: %json {}'


@dataclass(frozen=True, slots=True)
class JsonForm:
    """A JSON Schema.

    Attributes:
        name: Its name, which endpoints ask for.
        text: The schema as JSON text. Every object has all of its keys required and no others, as the strict mode of endpoints needs.
        binds: Whether an answer is this JSON alone; else any text may surround it, a chain of thought included.
    """

    name: str
    text: str
    binds: bool = True

    @classmethod
    def of(cls, name: str, schema: Mapping[str, Any]) -> "JsonForm":
        """Returns the form of a schema."""
        return cls(name, json.dumps(schema))

    def schema(self) -> dict[str, Any]:
        """Returns the JSON Schema."""
        found: dict[str, Any] = json.loads(self.text)
        return found

    def grammar(self) -> str:
        """Returns the Lark grammar for llguidance, without white space between the parts of a reply."""
        compact = self.schema() | {"x-guidance": {"whitespace_flexible": False}}
        return _GRAMMAR.format(json.dumps(compact))


def closed_object(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the schema of an object with exactly these keys."""
    return {"type": "object", "properties": dict(properties), "required": list(properties), "additionalProperties": False}
