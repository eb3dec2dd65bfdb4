"""The licences of the assets of a run, as a table, and whether the assets may be passed on."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import pyarrow as pa

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.licences import is_restricted, licence_terms, names_licence, normalise_licence
from stable_data.errors import ConfigError
from stable_data.publishing.private_paths import rows_without_folders
from stable_data.storage.run_folder import RunFolder

_COLUMNS = ("asset_id", "category", "licence", "licence_text", "licence_where", "author", "source", "source_url", "source_set")

_text, _truth = pa.string(), pa.bool_()
SCHEMA = pa.schema(
    [
        pa.field("asset_id", _text, metadata={"meaning": "identifier of the asset"}),
        pa.field("category", _text, metadata={"meaning": "category of the asset"}),
        pa.field("licence", _text, metadata={"meaning": "SPDX identifier of the licence; null if it is not known"}),
        pa.field("stated", _text, metadata={"meaning": "licence as the source states it; null if it states none"}),
        pa.field("stated_where", _text, metadata={"meaning": "where the source states it; null if unknown"}),
        pa.field("author", _text, metadata={"meaning": "who made the asset; null if unknown"}),
        pa.field("source", _text, metadata={"meaning": "origin of the asset; null if unknown"}),
        pa.field("source_url", _text, metadata={"meaning": "where the asset comes from; null if unknown"}),
        pa.field("source_set", _text, metadata={"meaning": "set that the asset belongs to; null if unknown"}),
        pa.field("is_credited", _truth, metadata={"meaning": "true if the author must be named; null if unknown"}),
        pa.field(
            "is_share_alike", _truth, metadata={"meaning": "true if changed assets must have this licence; null if unknown"}
        ),
        pa.field("is_non_commercial", _truth, metadata={"meaning": "true if commercial use is not allowed; null if unknown"}),
        pa.field("is_unchanged", _truth, metadata={"meaning": "true if changed assets must not be passed on; null if unknown"}),
    ]
)
"""The table of licences."""


@dataclass(frozen=True, slots=True)
class AssetLicence:
    """The licence of an asset; the attributes are the first columns of :data:`SCHEMA`."""

    asset_id: str
    category: str
    licence: str | None
    stated: str | None
    stated_where: str | None
    author: str | None
    source: str | None
    source_url: str | None
    source_set: str | None

    def annotation(self) -> AssetAnnotation:
        """Returns what a page of attribution says of the asset."""
        raw = {"licence": self.stated, "author": self.author, "source_url": self.source_url}
        return AssetAnnotation(
            self.asset_id,
            category=self.category,
            source=self.source or "",
            raw={key: value for key, value in raw.items() if value},
        )


def asset_licences(run: RunFolder) -> list[AssetLicence]:
    """Returns the licences of the assets of a run, sorted by asset and without private paths; none if it has no assets.

    Raises:
        ConfigError: The table ``assets`` cannot be read, or has a row without an identifier (``table_invalid``).
    """
    return sorted(_licences(run), key=lambda one: one.asset_id) if run.files("assets") else []


def _licences(run: RunFolder) -> Iterator[AssetLicence]:
    for batch in run.batches("assets", _COLUMNS):
        for row in rows_without_folders(pa.Table.from_batches([batch])).to_pylist():
            if row["asset_id"] is None:
                expected = "expected an identifier in each; stable-data verify names the rows"
                raise ConfigError(f"{run.uri}: assets has a row without asset_id, {expected}", "table_invalid")
            stated = row["licence_text"] or row["licence"]
            yield AssetLicence(
                row["asset_id"],
                row["category"] or "",
                _licence_of(row["licence"], row["licence_text"]),
                stated,
                row["licence_where"],
                row["author"],
                row["source"],
                row["source_url"],
                row["source_set"],
            )


def _licence_of(licence: str | None, text: str | None) -> str | None:
    """The licence of an asset; None if it is not known, or if its text names another one, several or a restriction."""
    stated, by_text = normalise_licence(licence), normalise_licence(text)
    if not text or stated == by_text:
        return stated
    if by_text is not None:
        return by_text if stated is None and not is_restricted(licence or "") else None
    return None if names_licence(text) or is_restricted(text) else stated


def licence_table(licences: Sequence[AssetLicence]) -> pa.Table:
    """Returns licences as an Arrow table, with what each asks for."""
    rows = []
    for one in licences:
        terms = licence_terms(one.licence)
        asked = (
            dict.fromkeys(("is_credited", "is_share_alike", "is_non_commercial", "is_unchanged"))
            if terms is None
            else asdict(terms)
        )
        rows.append(asdict(one) | asked)
    return pa.Table.from_pylist(rows, schema=SCHEMA)


def refuse_licences(licences: Sequence[AssetLicence], *, allow_unknown: bool, allow_no_derivatives: bool) -> None:
    """Refuses assets that must not be passed on, or of which it is not known.

    Args:
        licences: The licences.
        allow_unknown: Whether assets without a known licence are allowed.
        allow_no_derivatives: Whether assets are allowed whose licence forbids to pass on changed ones; all meshes are repaired ones.

    Raises:
        ConfigError: There are such assets (``licence_unknown`` or ``licence_forbids``).
    """
    unknown = Counter(one.stated or "none stated" for one in licences if one.licence is None)
    if unknown and not allow_unknown:
        stated = ", ".join(f"{text!r:.60} ({count})" for text, count in unknown.most_common(5))
        raise ConfigError(
            f"{sum(unknown.values())} of {len(licences)} assets have no known licence: {stated}; ask their source, leave them out, or say "
            "--allow-unknown-licences if you may pass them on",
            "licence_unknown",
        )
    forbidden = Counter(
        one.licence for one in licences if (terms := licence_terms(one.licence)) is not None and terms.is_unchanged
    )
    if forbidden and not allow_no_derivatives:
        found = ", ".join(f"{licence} ({count})" for licence, count in forbidden.most_common(5))
        raise ConfigError(
            f"{sum(forbidden.values())} of {len(licences)} assets must not be passed on changed, and meshes of a run are repaired ones: "
            f"{found}; leave them out, or say --allow-no-derivatives if you may pass them on",
            "licence_forbids",
        )
