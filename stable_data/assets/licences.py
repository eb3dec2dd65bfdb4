"""Licences of assets: what their many spellings mean, and what they ask for."""

import re
import unicodedata
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

_MOST_CHARACTERS = 1000  # a longer text is no name of a licence

_CREATIVE_COMMONS = re.compile(
    r"creativecommons\.org/licenses/by(?:-\w\w)*"
    r"|(?:\bcc\b|\bcreative commons\b)[ :-]{0,3}(?:by|attribution)\b|\bcc-?by(?=[\d -]|nc|nd|sa|$)|^(?:by|attribution)\b(?=$|[ \d-])"
)
_VERSION = re.compile(r"(?<![\d.])[1-4]\.\d(?![\d.])")
_OTHERS = tuple(
    (re.compile(pattern), name)
    for pattern, name in (
        (r"creativecommons\.org/publicdomain/zero|\bcc[ -]?0\b|\bcc zero\b|\bcreative commons zero\b", "CC0-1.0"),
        (r"\bmit[ -]+(?:0|no attribution)\b", "MIT-0"),
        (
            r"^(?:the )?mit(?: licen[cs]e)?(?=$| ?[(,.;:]| (?:and|or) )|\bmit licen[cs]e\b|\blicen[cs]es?[:/ ]+(?:the )?mit\b",
            "MIT",
        ),
        (
            r"\bapache\b(?: software)?(?:[ -]+licen[cs]e)?[ ,-]*(?:version|v)?[ -]*2(?:\.0)?\b|apache\.org/licenses/license-2",
            "Apache-2.0",
        ),
        (r"\bbsd[ -]2\b|\b2-clause bsd\b", "BSD-2-Clause"),
        (r"\bbsd[ -]3\b|\b3-clause bsd\b", "BSD-3-Clause"),
        (r"\bzlib\b", "Zlib"),
        (r"\bodc[ -]by\b|\bopen data commons attribution\b", "ODC-By-1.0"),
        (r"\bunlicense\b", "Unlicense"),
    )
)
_NON_COMMERCIAL = re.compile(r"non[ -]*commercial|(?<![a-z])nc(?![a-z])|by-?nc|\bnicht[ -]?kommerziell")
_NO_DERIVATIVES = re.compile(r"no[ -]*deriv|(?<![a-z])nd(?![a-z])|(?:by|nc)-?nd")
_SHARE_ALIKE = re.compile(r"share[ -]*alike|(?<![a-z])sa(?![a-z])|(?:by|nc)-?sa")
_UNKNOWN = re.compile(
    r"\b(?:only|research|academic|educational|personal|editorial|proprietary|reserved|not|except|royalty|gpl\w*|lgpl\w*|agpl\w*|mpl|"
    r"odbl|eula)\b"
)


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
        The identifier, without a version where a Creative Commons licence states none, such as ``CC-BY-NC``. A restriction anywhere
        in the text counts. None if the text names no known licence, several, or one with conditions that are not its own.
    """
    if text is None or len(text) > _MOST_CHARACTERS:
        return None
    plain = unicodedata.normalize("NFKC", text).lower().replace("_", " ")
    left = " ".join(re.sub("[\u2010-\u2015]", "-", plain).split())
    if _UNKNOWN.search(re.sub(r"\S*\.(?:org|com)\S*", "", left)):
        return None
    name, rest = _creative_commons(left)
    found = {name} if name else set()
    for pattern, other in _OTHERS:
        if pattern.search(rest):
            found.add(other)
            rest = pattern.sub(" ; ", rest)  # so that MIT-0 is not found as MIT too
    if len(found) != 1 or (not name and (_NON_COMMERCIAL.search(left) or _NO_DERIVATIVES.search(left))):
        return None
    return found.pop()


def _creative_commons(text: str) -> tuple[str, str]:
    """The licence CC BY and what modifies it, empty without one, and the text without it."""
    if not _CREATIVE_COMMONS.search(text):
        return "", text
    versions = set(_VERSION.findall(text))
    if len(versions) > 1:
        return "", ""
    modifiers = (("NC", _NON_COMMERCIAL), ("ND", _NO_DERIVATIVES), ("SA", _SHARE_ALIKE))
    parts = ["CC-BY", *(letters for letters, pattern in modifiers if pattern.search(text)), *versions]
    return "-".join(parts), _CREATIVE_COMMONS.sub(" ; ", text)


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
        allowed: The allowed licences; known ones in any spelling, and one without a version allows all its versions. None allows
            all assets, a list none without a licence.
    """
    if allowed is None:
        return True
    if licence in allowed:
        return True
    name = normalise_licence(licence)
    if name is None:
        return False
    of_any_version = re.sub(r"-\d\.\d$", "", name)  # a name only for Creative Commons
    return not {name, of_any_version}.isdisjoint(map(normalise_licence, allowed))
