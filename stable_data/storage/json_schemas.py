"""The contracts as files: JSON Schema of a scene, a layout reply and a task info, and the columns of every table.

Written by ``make schemas`` into ``schemas/`` and checked in; a test keeps them in step with the code.
"""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from stable_data.scene import Stage
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.task_info import TASK_INFO_SCHEMA

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}


def _numbers(count: int, description: str) -> dict[str, Any]:
    return {"type": "array", "items": _NUMBER, "minItems": count, "maxItems": count, "description": description}


_ZONE = _numbers(4, "x_min, x_max, y_min, y_max, centimetres")

LAYOUT_REPLY: dict[str, Any] = {
    "$schema": _DRAFT,
    "title": "Layout reply of a language model",
    "type": "object",
    "required": ["objects"],
    "properties": {
        "item_placement_zone": _ZONE,
        "sink_zone": _ZONE,
        "objects": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["instance", "description", "size", "position", "z_rotation"],
                "properties": {
                    "instance": {**_TEXT, "description": "category and running number, such as pen_0"},
                    "description": {**_TEXT, "description": "words that the asset is retrieved by"},
                    "size": {**_numbers(3, "width, depth, height before yaw, centimetres")},
                    "position": {**_numbers(3, "centre of the box, centimetres")},
                    "z_rotation": {**_NUMBER, "description": "counter-clockwise, degrees; 0 faces the viewer"},
                },
            },
        },
    },
}
"""What a language model answers with: centimetres and degrees."""


def json_schema_of(type_: pa.DataType) -> dict[str, Any]:
    """JSON Schema of a value of an Arrow type; null is always allowed, as in Arrow."""
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
    """JSON Schema of a row of ``scenes``."""
    properties = {}
    for column in SCHEMAS["scenes"]:
        about = {k.decode(): v.decode() for k, v in column.metadata.items() if v}
        properties[column.name] = json_schema_of(column.type) | {"description": _described(about)}
    stage = properties["objects"]["items"]["properties"]["stage"]
    stage["enum"] = [*map(str, Stage), None]
    return {"$schema": _DRAFT, "title": "Scene", "type": "object", "required": list(properties), "properties": properties}


def _described(about: dict[str, str]) -> str:
    return f"{about['meaning']}, {about['unit']}" if "unit" in about else about["meaning"]


def tables_document() -> dict[str, Any]:
    """Name, type, unit and meaning of every column of every table."""
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
    """File name -> content of everything in ``schemas/``."""
    documents = {
        "scene.schema.json": scene_schema(),
        "layout_reply.schema.json": LAYOUT_REPLY,
        "task_info.schema.json": TASK_INFO_SCHEMA,
        "tables.json": tables_document(),
    }
    return {name: json.dumps(document, indent=2, ensure_ascii=False) + "\n" for name, document in documents.items()}


def write_contracts(folder: Path) -> None:
    """Writes the files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contract_files().items():
        (folder / name).write_text(content, "utf-8")
