"""The files in ``schemas/``: JSON Schemas of a scene, a layout reply and a task info, and the columns of every table.

``make schemas`` writes them; they are part of the repository, and a test compares them with the code.
"""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from stable_data.scene import Stage
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.task_info import TASK_INFO_SCHEMA

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_TEXT = {"type": "string"}

MOST_ENTRIES = 1000
"""Maximum number of objects in a layout reply, and of instances that it removes. The checks of a reply allow fewer objects."""

LONGEST_CM = 1e6
"""Exclusive bound on the magnitude of lengths, coordinates and angles in a layout reply, centimetres or degrees."""

LEAST_SIDE_CM = 0.1
"""Minimum side of an object in a layout reply after rounding to one decimal, centimetres."""

_REPLY_NUMBER = {"type": "number", "exclusiveMinimum": -LONGEST_CM, "exclusiveMaximum": LONGEST_CM}


def _triple(item: dict[str, Any], description: str) -> dict[str, Any]:
    return {"type": "array", "items": item, "minItems": 3, "maxItems": 3, "description": description}


LAYOUT_REPLY: dict[str, Any] = {
    "$schema": _DRAFT,
    "title": "Layout reply of a language model",
    "description": "New and changed objects of a layout; of an edit, also the instances that it removes. Other keys are ignored. "
    "A request narrows this: positions lie on its table, and a reply that is decoded under its grammar has no other keys.",
    "type": "object",
    "required": ["objects"],
    "properties": {
        "remove": {
            "type": "array",
            "items": _TEXT,
            "maxItems": MOST_ENTRIES,
            "description": "instances that an edit removes",
        },
        "objects": {
            "type": "array",
            "maxItems": MOST_ENTRIES,
            "items": {
                "type": "object",
                "required": ["instance", "description", "size", "position", "z_rotation"],
                "properties": {
                    "instance": {
                        **_TEXT,
                        "pattern": r"^[^\s0-9_]\S*_[0-9]+$",
                        "description": "category in letters, digits and underscores, and running number, such as pen_0",
                    },
                    "description": {
                        **_TEXT,
                        "pattern": r"[^\s\u0000-\u001f\u007f]",
                        "description": "words that the asset is retrieved by",
                    },
                    "size": _triple(
                        {"type": "number", "minimum": LEAST_SIDE_CM / 2, "exclusiveMaximum": LONGEST_CM},
                        "width, depth and height of the box before z_rotation, centimetres; rounded to one decimal",
                    ),
                    "position": _triple(_REPLY_NUMBER, "centre of the box, centimetres; rounded to one decimal"),
                    "z_rotation": {
                        **_REPLY_NUMBER,
                        "description": "counter-clockwise, degrees; 0 faces the viewer; rounded to a whole degree",
                    },
                },
            },
        },
    },
}
"""JSON Schema of the replies that ``models.semantic_reasoner.text.reply_json.parse_reply`` reads, centimetres and degrees."""


def json_schema_of(type_: pa.DataType) -> dict[str, Any]:
    """Returns the JSON Schema of a value of an Arrow type; null is always allowed, as in Arrow."""
    if pa.types.is_struct(type_):
        properties = {f.name: json_schema_of(f.type) for f in type_}
        return {
            "type": ["object", "null"],
            "properties": properties,
            "required": list(properties),
            "additionalProperties": False,
        }
    if pa.types.is_list(type_):
        return {"type": ["array", "null"], "items": json_schema_of(type_.value_type)}
    if pa.types.is_boolean(type_):
        return {"type": ["boolean", "null"]}
    if pa.types.is_integer(type_):
        return {"type": ["integer", "null"]}
    if pa.types.is_floating(type_):
        return {"type": ["number", "null"]}
    return {"type": ["string", "null"]}


def scene_schema() -> dict[str, Any]:
    """Returns the JSON Schema of a row of ``scenes``."""
    properties = {}
    for column in SCHEMAS["scenes"]:
        about = [column.metadata[key].decode() for key in (b"meaning", b"unit")]
        properties[column.name] = json_schema_of(column.type) | {"description": ", ".join(filter(None, about))}
    stage = properties["objects"]["items"]["properties"]["stage"]
    stage["enum"] = [*map(str, Stage), None]
    return {"$schema": _DRAFT, "title": "Scene", "type": "object", "required": list(properties), "properties": properties}


def tables_document() -> dict[str, Any]:
    """Returns the name, type, unit and meaning of every column of every table."""
    return {
        "table_version": TABLE_VERSION,
        "tables": {
            name: [
                {
                    "name": c.name,
                    "type": str(c.type),
                    "unit": c.metadata[b"unit"].decode(),
                    "meaning": c.metadata[b"meaning"].decode(),
                }
                for c in schema
            ]
            for name, schema in SCHEMAS.items()
        },
    }


def contract_files() -> dict[str, str]:
    """Returns file name -> content of all files in ``schemas/``."""
    documents = {
        "scene.schema.json": scene_schema(),
        "layout_reply.schema.json": LAYOUT_REPLY,
        "task_info.schema.json": TASK_INFO_SCHEMA,
        "tables.json": tables_document(),
    }
    return {name: json.dumps(document, indent=2, ensure_ascii=False) + "\n" for name, document in documents.items()}


def write_contracts(folder: Path) -> None:
    """Writes the files of :func:`contract_files` into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contract_files().items():
        (folder / name).write_text(content, "utf-8")
