"""Licences of assets: what their many spellings mean, what they ask for, and which may be used."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

_VERSION = r"(?:[ ,/-]*(?:v|version|international)?[ ,/-]*(?P<version>\d\.\d))?"
_MODIFIERS = r"(?P<more>(?:[ -]+(?:nc|nd|sa|non ?-?commercial|no ?-?deriv\w*|share ?-?alike))*)"
_PATTERNS = tuple(
    (re.compile(pattern, re.IGNORECASE), name)
    for pattern, name in (
        (r"creativecommons\.org/publicdomain/zero(?:/\d\.\d)?|\bcc[ -]?0\b(?:[ -]1\.0)?(?: universal)?", "CC0-1.0"),
        (r"creative commons zero(?:[ ,]*(?:v|version)?[ ]?1\.0)?(?: universal)?", "CC0-1.0"),
        (rf"creativecommons\.org/licenses/by(?P<more>(?:-(?:nc|nd|sa))*){_VERSION}", "CC-BY"),
        (rf"\bcc[ -]+(?:by|attribution)\b{_MODIFIERS}{_VERSION}", "CC-BY"),
        (rf"creative commons[ :-]+(?:attribution|by)\b{_MODIFIERS}{_VERSION}", "CC-BY"),
        (r"\bmit[ -]+(?:0|no attribution)\b", "MIT-0"),
        (r"\bmit\b(?: licen[cs]e)?", "MIT"),
        (r"\bapache\b(?:[ -]+licen[cs]e)?[ ,-]*(?:v|version)?[ -]*2(?:\.0)?\b", "Apache-2.0"),
        (r"\bbsd[ -]+2[ -]+clause\b", "BSD-2-Clause"),
        (r"\bbsd[ -]+3[ -]+clause\b", "BSD-3-Clause"),
        (r"\bzlib\b", "Zlib"),
        (r"\bodc[ -]by\b(?:[ -]1\.0)?|open data commons attribution", "ODC-By-1.0"),
        (r"\bunlicense\b", "Unlicense"),
    )
)
_NON_COMMERCIAL = re.compile(r"non[ -]?commercial|\bnc\b", re.IGNORECASE)
_NO_DERIVATIVES = re.compile(r"no[ -]?deriv|\bnd\b", re.IGNORECASE)
_SHARE_ALIKE = re.compile(r"share[ -]?alike|\bsa\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class LicenceTerms:
    """What a licence asks of who uses an asset.

    Attributes:
        is_credited: The author must be named.
        is_share_alike: Changed assets must have the same licence.
        is_non_commercial: Commercial use is not allowed.
        is_unchanged: Changed assets must not be passed on.
    """

    is_credited: bool
    is_share_alike: bool = False
    is_non_commercial: bool = False
    is_unchanged: bool = False


_WITHOUT_CREDIT = frozenset({"CC0-1.0", "MIT-0", "Unlicense"})


@lru_cache(maxsize=4096)
def normalise_licence(text: str | None) -> str | None:
    """Returns the SPDX identifier of a licence, such as ``CC-BY-4.0``.

    Args:
        text: A name, an identifier or an address, in any of the usual spellings.

    Returns:
        The identifier, without a version where a Creative Commons licence states none, such as ``CC-BY-NC``; None if the text names
        no known licence, or several.
    """
    left = " ".join((text or "").replace("_", " ").split())
    found: set[str] = set()
    for pattern, name in _PATTERNS:
        for match in pattern.finditer(left):
            found.add(name if "more" not in match.groupdict() else _creative_commons(match["more"], match["version"]))
        left = pattern.sub(" ; ", left)  # so that MIT-0 is not found as MIT too
    return found.pop() if len(found) == 1 else None


def _creative_commons(more: str, version: str | None) -> str:
    parts = [
        "CC-BY",
        "NC" if _NON_COMMERCIAL.search(more) else "",
        "ND" if _NO_DERIVATIVES.search(more) else "",
        "SA" if _SHARE_ALIKE.search(more) else "",
        version or "",
    ]
    return "-".join(filter(None, parts))


def licence_terms(text: str | None) -> LicenceTerms | None:
    """Returns the terms of a licence; None if it is not known (:func:`normalise_licence`)."""
    name = normalise_licence(text)
    if name is None:
        return None
    parts = name.split("-")
    return LicenceTerms(name not in _WITHOUT_CREDIT, "SA" in parts, "NC" in parts, "ND" in parts)


def is_licence_allowed(licence: str | None, allowed: Collection[str] | None) -> bool:
    """Whether assets under a licence may be used.

    Args:
        licence: The licence that the asset states, None if it states none.
        allowed: The allowed licences in any spelling; one without a version allows all its versions. None allows all but those
            that are known to forbid commercial use or changes: scenes scale assets and move them.
    """
    if allowed is None:
        terms = licence_terms(licence)
        return terms is None or not (terms.is_non_commercial or terms.is_unchanged)
    if licence is None:
        return False
    name = normalise_licence(licence)
    versions = {name, re.sub(r"-\d\.\d$", "", name) if name is not None and name.startswith("CC-BY") else name}
    return licence in allowed or any(one is not None and one in versions for one in map(normalise_licence, allowed))
