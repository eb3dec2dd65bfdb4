"""Metadata of a published run in the form of MLCommons Croissant 1.0 (https://docs.mlcommons.org/croissant/docs/croissant-spec.html)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from stable_data.assets.licences import normalise_licence
from stable_data.publishing.asset_licences import SCHEMA as LICENCE_SCHEMA
from stable_data.publishing.dataset_card import ABOUT, KEYWORDS, LICENCE_FILE, PublishedTable
from stable_data.storage.schemas import SCHEMAS
from stable_data.verification.known_ids import KEYS

_PARQUET = "application/x-parquet"
_VERSION = "http://mlcommons.org/croissant/1.0"

FIRST_VERSION = "1.0.0"
"""Version of a dataset that is published for the first time."""

_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{
        name: f"cr:{name}"
        for name in (
            *("citeAs", "column", "equivalentProperty", "extract", "field", "fileProperty", "fileObject", "fileSet", "format"),
            *("includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex"),
            *("repeated", "replace", "samplingRate", "separator", "source", "subField", "transform"),
        )
    },
}
"""The context of the specification."""


@dataclass(frozen=True, slots=True)
class CroissantFile:
    """A single file of the folder.

    Attributes:
        name: Its name in the folder.
        description: What it is.
        media_type: Its format.
        sha256: Its checksum.
        size: Bytes.
    """

    name: str
    description: str
    media_type: str
    sha256: str
    size: int


def croissant_document(
    title: str,
    description: str,
    licences: Sequence[str],
    tables: Sequence[PublishedTable],
    files: Sequence[CroissantFile],
    people: Sequence[str] = (),
    organizations: Sequence[str] = (),
    url: str = "",
    citation: str = "",
    published: str = "",
    version: str = FIRST_VERSION,
) -> dict[str, Any]:
    """Returns the content of ``croissant.json``.

    Fields are all columns but those with bytes of meshes, and of structs the fields that are no lists of structs themselves: Croissant
    has no type for them. The files have all columns.

    Args:
        title: Title of the dataset.
        description: A sentence about it.
        licences: Every licence of its content: SPDX identifiers, or words such as ``not known``.
        tables: Its tables, those with rows.
        files: Further files.
        people: Names of the people who made it.
        organizations: Names of the organizations that made it.
        url: Where it is; empty if it is not known.
        citation: How to cite it; empty if nobody says.
        published: The day, ``2026-11-27``; empty if it is not known.
        version: Version of the dataset, of three numbers.
    """
    optional = {
        "creator": [
            *({"@type": "sc:Person", "name": name} for name in people),
            *({"@type": "sc:Organization", "name": name} for name in organizations),
        ],
        "url": url,
        "citeAs": citation,
        "datePublished": published,
    }
    found: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": title,
        "description": description,
        "conformsTo": _VERSION,
        "license": [_licence_entry(licence) for licence in licences],
        **{key: value for key, value in optional.items() if value},
        "keywords": list(KEYWORDS),
        "version": version,
        "distribution": [*map(_file_object, files), *map(_file_set, tables)],
        "recordSet": [_record_set(table) for table in tables],
    }
    if any(file.name == LICENCE_FILE for file in files):
        found["recordSet"].append(_licence_records())
    return found


def missing_entries(document: dict[str, Any]) -> list[str]:
    """Returns what Croissant 1.0 requires of a dataset and only its publisher knows, and a document does not have."""
    return [name for name in ("creator", "url") if name not in document]


def _licence_entry(licence: str) -> str | dict[str, str]:
    """The address of a licence at SPDX; without an identifier, or with one that leaves the version open, its name."""
    is_known = normalise_licence(licence) == licence and (not licence.startswith("CC-BY") or licence[-1].isdigit())
    return f"https://spdx.org/licenses/{licence}.html" if is_known else {"@type": "sc:CreativeWork", "name": licence}


def _file_object(file: CroissantFile) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": file.name,
        "name": file.name,
        "description": file.description,
        "contentUrl": file.name,
        "contentSize": f"{file.size} B",
        "encodingFormat": file.media_type,
        "sha256": file.sha256,
    }


def _file_set(table: PublishedTable) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": _files_of(table.name),
        "name": _files_of(table.name),
        "description": f"The files of the table {table.name}; SHA256SUMS has their checksums.",
        "encodingFormat": _PARQUET,
        "includes": f"{table.name}/*.parquet",
    }


def _files_of(table: str) -> str:
    return f"{table}-files"


def _record_set(table: PublishedTable) -> dict[str, Any]:
    name, source = table.name, {"fileSet": {"@id": _files_of(table.name)}}
    columns = KEYS.get(name, ())
    found: dict[str, Any] = {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": ABOUT.get(name, name),
        "field": list(_fields(name, SCHEMAS[name], source)),
    }
    if len(columns) == 1 and name != "textures":
        found["key"] = {"@id": f"{name}/{columns[0]}"}
    return found


def _licence_records() -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": "licences",
        "name": "licences",
        "description": "licences of assets",
        "key": {"@id": "licences/asset_id"},
        "field": list(_fields("licences", LICENCE_SCHEMA, {"fileObject": {"@id": LICENCE_FILE}})),
    }


def _fields(prefix: str, columns: pa.Schema, source: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The fields of a table."""
    for column in columns:
        where = {**source, "extract": {"column": column.name}}
        field = _field(f"{prefix}/{column.name}", column.name, column.type, where, column.metadata)
        if field is not None:
            yield field


def _field(
    name: str, column: str, type_: pa.DataType, source: dict[str, Any], metadata: dict[bytes, bytes] | None
) -> dict[str, Any] | None:
    """The field of a column, or None if Croissant has no type for it."""
    found: dict[str, Any] = {"@type": "cr:Field", "@id": name, "name": name}
    if about := ", ".join(text.decode() for key in (b"meaning", b"unit") if (text := (metadata or {}).get(key))):
        found["description"] = about
    while pa.types.is_list(type_):
        type_, found = type_.value_type, found | {"repeated": True}
    if pa.types.is_struct(type_):
        inner = [
            sub
            for each in type_
            if not _has_structs(each.type)
            and (sub := _field(f"{name}/{each.name}", each.name, each.type, _below(source, each.name), None)) is not None
        ]
        for sub in inner:
            sub.pop("repeated", None)  # the values of a field of repeated structs are repeated with these
        return found | {"subField": inner} if inner else None
    kind = _data_type(type_, column)
    return None if kind is None else found | {"dataType": kind, "source": source}


def _below(source: dict[str, Any], name: str) -> dict[str, Any]:
    return {**source, "transform": {"jsonPath": name}}


def _has_structs(type_: pa.DataType) -> bool:
    while pa.types.is_list(type_):
        type_ = type_.value_type
    return bool(pa.types.is_struct(type_))


def _data_type(type_: pa.DataType, column: str) -> str | None:
    if pa.types.is_boolean(type_):
        return "sc:Boolean"
    if pa.types.is_integer(type_):
        return "sc:Integer"
    if pa.types.is_floating(type_):
        return "sc:Float"
    if pa.types.is_string(type_):
        return "sc:Text"
    return "sc:ImageObject" if column in ("image", "picture") else None
