"""Licences of assets: what their many spellings mean, and what they ask for."""

import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache

from stable_data.assets.annotation import AssetAnnotation
from stable_data.errors import plain_markdown

_MOST_CHARACTERS = 1000  # a longer text, without the texts of licences that are known, is no name of a licence
_MOST_READ = 1 << 16  # characters: no licence is longer

# The texts of licences, which say in many words what their names say: each sentence or text is replaced by a name. A text may be cut
# off at its end. What stands around it still counts.
_LEGAL_TEXTS = tuple(
    (re.compile(pattern, re.DOTALL), name)
    for pattern, name in (
        (
            r"permission is hereby granted, free of charge, to any person obtaining a copy of this software(?=.*the above copyright "
            r"notice and this permission notice).{0,700}?subject to the following conditions:? *the above copyright notice and this "
            r"permission notice (?:\(including the next paragraph\) )?shall be included in all copies or substantial portions of the "
            r"software\.?",
            " mit license ",
        ),
        (
            r"permission is hereby granted, free of charge, to any person obtaining a copy of this software.{0,600}?to permit persons to "
            r"whom the software is furnished to do so\.(?! *subject)",
            " mit no attribution ",
        ),
        (
            r"the software is provided [\"'`“”]*as is[\"'`“”]*, without warranty of any kind.{0,700}?(?:dealings in the software\.?|$)",
            " ",
        ),
        (r"apache license,? version 2\.0, january 2004.*?(?:end of terms and conditions|$)", " apache license 2.0 "),
        (
            r"licensed under the apache license, version 2\.0 \(the [\"'`“”]*license[\"'`“”]*\);? you may not use.{0,700}?(?:limitations "
            r"under the license\.?|$)",
            " apache license 2.0 ",
        ),
        (
            r"(?:creative commons legal code )?cc0 1\.0 universal.*?(?:no duty or obligation with respect to this cc0 or use of the "
            r"work\.?|$)",
            " cc0 ",
        ),
        (
            r"(?:creative commons legal code )?(?=attribution)((?:attribution|noncommercial|sharealike|noderivatives|noderivs|-)+) "
            r"(\d\.\d) (?:international|unported|generic|united states).{0,40}?creative commons corporation.*?(?:creative commons may be "
            r"contacted at \S*|$)",
            r" cc \1 \2 ",
        ),
        (
            r"redistribution and use in source and binary forms, with or without modification, are permitted provided that the following "
            r"conditions are met:?(?=.{0,900}(?:neither the name|may not be used to endorse)).*?(?:possibility of such damage\.?|$)",
            " bsd-3 ",
        ),
        (
            r"redistribution and use in source and binary forms, with or without modification, are permitted provided that the following "
            r"conditions are met:?.*?possibility of such damage\.?",
            " bsd-2 ",
        ),
        # What authors write beside a licence, and what does not restrict it.
        (r"(?:this is |is )?not (?:mandatory|required|necessary)", " "),
        (
            r"(?:for|in) (?:both )?(?:personal(?:, educational)?,? and commercial|commercial and personal)(?: projects| use| purposes)?",
            " ",
        ),
        (
            r"(?:for|in) (?:both )?(?:commercial and non-?commercial|non-?commercial and commercial)(?: projects| use| purposes)?",
            " ",
        ),
    )
)
_ALL_RIGHTS = re.compile(r"(?:copyright|\(c\)|©)[^;]{0,120}?all rights reserved\.?")

_CREATIVE_COMMONS = re.compile(
    r"creativecommons\.org/licenses/by(?:-\w\w)*"
    r"|(?:\bcc\b|\bcreative commons\b)[ :-]{0,3}(?:by|attribution)\b|\bcc-?by(?=[\d -]|nc|nd|sa|$)"
    r"|^(?:by|attribution)(?=(?:[ -]+(?:nc|nd|sa|non[ -]?commercial|no[ -]?deriv\w*|share[ -]?alike))*(?:[ -]+\d\.\d)?"
    r"(?: international)?$)"
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
KNOWN_LICENCES = (
    *("CC0-1.0", "CC-BY", "CC-BY-SA", "CC-BY-NC", "CC-BY-ND", "CC-BY-NC-SA", "CC-BY-NC-ND"),
    *(name for _, name in _OTHERS if name != "CC0-1.0"),
)
"""All identifiers that :func:`normalise_licence` returns, those of Creative Commons without their versions."""

_NON_COMMERCIAL = re.compile(r"(?:non?|not(?: for)?)[ -]*commercial|(?<![a-z])nc(?![a-z])|by-?nc|\bnicht[ -]?kommerziell")
_NO_DERIVATIVES = re.compile(r"no[ -]*deriv|(?<![a-z])nd(?![a-z])|(?:by|nc)-?nd")
_SHARE_ALIKE = re.compile(r"share[ -]*alike|(?<![a-z])sa(?![a-z])|(?:by|nc)-?sa")
_UNKNOWN = re.compile(
    r"\b(?:only|research|academic|educational|personal|editorial|proprietary|reserved|not|except|royalty|gpl\w*|lgpl\w*|agpl\w*|mpl|"
    r"odbl|eula|prohibited|forbidden|unless|without permission|required)\b"
)

_SPEAKS_OF_ONE = re.compile(r"licen[cs]|public domain|copyleft|creative ?commons|\bcc[ -]?by")


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
        text: A name, an identifier or an address, in any of the usual spellings, in a sentence or alone; or the text of a licence,
            whole or its beginning.

    Returns:
        The identifier, without a version where a Creative Commons licence states none, such as ``CC-BY-NC``. A restriction anywhere
        in the text counts. None if the text names no known licence, several, or one with conditions that are not its own.
    """
    left = None if text is None else _plain(text)
    if left is None:
        return None
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


def names_licence(text: str) -> bool:
    """Whether a text speaks of a licence, known or not, or of several; also if it is too long to be read."""
    left = _plain(text)
    if left is None:
        return True
    return any(pattern.search(left) for pattern in (_CREATIVE_COMMONS, _SPEAKS_OF_ONE, *(pattern for pattern, _ in _OTHERS)))


def is_restricted(text: str) -> bool:
    """Whether a text that names no known licence speaks of a restriction, such as ``for research only``."""
    left = _plain(text)
    patterns = (_UNKNOWN, _NON_COMMERCIAL, _NO_DERIVATIVES)
    return left is None or any(pattern.search(left) for pattern in patterns)


def _plain(text: str) -> str | None:
    """A text in lower case on one line, with names in place of the texts of licences; None if it is too long."""
    if len(text) > _MOST_READ:
        return None
    folded = unicodedata.normalize("NFKC", text).lower().replace("_", " ")
    left = " ".join(re.sub("[\u2010-\u2015]", "-", folded).split())
    whole = left
    for pattern, name in _LEGAL_TEXTS:
        left = pattern.sub(name, left)
    if left != whole:  # a copyright line belongs to the text of a licence; alone it reserves all rights
        left = _ALL_RIGHTS.sub(" ", left)
    return left if len(left) <= _MOST_CHARACTERS else None


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


def attribution_text(assets: Sequence[AssetAnnotation]) -> str:
    """Returns the page ATTRIBUTION.md: assets by licence, what each licence asks for, and its own words where they are others."""
    of_licence: dict[str, list[AssetAnnotation]] = defaultdict(list)
    for a in assets:
        of_licence[normalise_licence(a.licence) or " ".join((a.licence or "not known").split())].append(a)
    lines = [
        "# Attribution",
        "",
        "The assets of these scenes. Their meshes were repaired, scaled and posed. The texts of licences are with the sources.",
        "",
    ]
    for licence, own in sorted(of_licence.items()):
        lines += [f"## {plain_markdown(licence)}", "", _asked(licence), ""]
        for a in own:
            said = "".join(f"; {a.raw[name]}" for name in ("author", "source_url") if a.raw.get(name))
            if a.licence and " ".join(a.licence.split()) != licence:
                said += f"; stated as {a.licence}"
            text = f"{a.asset_id}: {a.category or 'no category'}; {a.source or 'source not known'}{said}"
            lines.append(f"- {plain_markdown(text)}")
        lines.append("")
    return "\n".join(lines)


def _asked(licence: str) -> str:
    terms = licence_terms(licence)
    if terms is None:
        return "What this licence asks for is not known: ask the source before you pass these assets on."
    asked = {
        "name the author and the licence": terms.is_credited,
        "give changed assets the same licence": terms.is_share_alike,
        "do not use them commercially": terms.is_non_commercial,
        "do not pass changed assets on": terms.is_unchanged,
    }
    return f"Asked: {'; '.join(text for text, is_asked in asked.items() if is_asked) or 'nothing'}."
