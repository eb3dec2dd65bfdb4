"""Licences in the spellings of many sources."""

import pytest

from stable_data.assets.licences import LicenceTerms, is_licence_allowed, licence_terms, normalise_licence


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("CC0", "CC0-1.0"),
        ("cc0-1.0", "CC0-1.0"),
        ("CC0 1.0 Universal", "CC0-1.0"),
        ("Creative Commons Zero v1.0 Universal", "CC0-1.0"),
        ("https://creativecommons.org/publicdomain/zero/1.0/", "CC0-1.0"),
        ("CC-BY-4.0", "CC-BY-4.0"),
        ("CC BY 4.0", "CC-BY-4.0"),
        ("cc_by_4.0", "CC-BY-4.0"),
        ("CC BY", "CC-BY"),
        ("CC Attribution", "CC-BY"),
        ("CC Attribution-NonCommercial-ShareAlike", "CC-BY-NC-SA"),
        ("CC-BY-NC-SA 4.0", "CC-BY-NC-SA-4.0"),
        ("CC BY-SA 3.0", "CC-BY-SA-3.0"),
        ("Creative Commons Attribution 4.0 International", "CC-BY-4.0"),
        ("Creative Commons Attribution-NonCommercial 4.0", "CC-BY-NC-4.0"),
        ("Creative Commons - Attribution - No Derivatives", "CC-BY-ND"),
        ("Creative Commons - Attribution - Non-Commercial - Share Alike", "CC-BY-NC-SA"),
        ("http://creativecommons.org/licenses/by-nc-nd/3.0/us/", "CC-BY-NC-ND-3.0"),
        ("Licensed under https://creativecommons.org/licenses/by/4.0/legalcode .", "CC-BY-4.0"),
        ("MIT", "MIT"),
        ("The MIT License", "MIT"),
        ("MIT-0", "MIT-0"),
        ("MIT No Attribution", "MIT-0"),
        ("Apache License, Version 2.0", "Apache-2.0"),
        ("apache-2.0", "Apache-2.0"),
        ("BSD-3-Clause", "BSD-3-Clause"),
        ("BSD 2-Clause", "BSD-2-Clause"),
        ("zlib", "Zlib"),
        ("ODC-By-1.0", "ODC-By-1.0"),
        ("by-nc", "CC-BY-NC"),
        ("by", "CC-BY"),
        ("BY-NC-SA 4.0", "CC-BY-NC-SA-4.0"),
        ("Attribution-NonCommercial-ShareAlike 4.0 International", "CC-BY-NC-SA-4.0"),
        ("Creative Commons Attribution Non Commercial Share Alike", "CC-BY-NC-SA"),
        ("CC Attribution-NonCommercial (http://creativecommons.org/licenses/by-nc/4.0/)", "CC-BY-NC-4.0"),
        ("Creative Commons Attribution (CC BY 4.0)", "CC-BY-4.0"),
        (
            '"Mug" by A is licensed under Creative Commons Attribution (http://creativecommons.org/licenses/by/4.0/).',
            "CC-BY-4.0",
        ),
        ("CC BY 4.0 (non-commercial)", "CC-BY-NC-4.0"),
        ("CC-BY-4.0-NC", "CC-BY-NC-4.0"),
        ("CC BY/NC", "CC-BY-NC"),
        ("CC BY, NC", "CC-BY-NC"),
        ("Attribution\u2013NonCommercial 4.0", "CC-BY-NC-4.0"),
        ("CC BY\u2011NC 4.0", "CC-BY-NC-4.0"),
        ("CC-BY4.0", "CC-BY-4.0"),
        ("CC BYNC", None),
        ("https://www.apache.org/licenses/LICENSE-2.0", "Apache-2.0"),
        ("Apache Software License 2.0", "Apache-2.0"),
        ("3-Clause BSD", "BSD-3-Clause"),
        ("License: MIT", "MIT"),
        ("", None),
        (None, None),
        ("free", None),
        ("public domain", None),
        ("Emits light", None),
        ("all rights reserved", None),
        ("MIT and CC BY-NC 4.0", None),
        ("Code: Apache 2.0. Models: CC BY 4.0.", None),
        ("CC BY 3.0 and CC BY 4.0", None),
        ("MIT License (non-commercial)", None),
        ("CC0, free for non-commercial use", None),
        ("CC BY 4.0, non-commercial use only", None),
        ("GPL-2.0 and CC BY 4.0", None),
        ("Apache 2.0 (code), models proprietary", None),
        ("not CC0", None),
        ("MIT CSAIL dataset", None),
        ("frei mit Namensnennung", None),
        ("CC BY 4.0 " + 1000 * ",/-", None),
    ],
)
def test_the_usual_spellings_are_understood(text: str | None, name: str | None) -> None:
    assert normalise_licence(text) == name
    assert name is None or normalise_licence(name) == name


def test_terms_follow_from_the_name() -> None:
    assert licence_terms("CC0") == licence_terms("MIT-0") == LicenceTerms(is_credited=False)
    assert licence_terms("CC BY 3.0") == licence_terms("MIT") == LicenceTerms(is_credited=True)
    assert licence_terms("CC-BY-NC-SA-4.0") == LicenceTerms(True, is_share_alike=True, is_non_commercial=True)
    assert licence_terms("CC BY-ND 4.0") == LicenceTerms(True, is_unchanged=True)
    assert licence_terms("ask the author") is licence_terms(None) is None


def test_without_a_list_all_are_allowed() -> None:
    assert all(is_licence_allowed(licence, None) for licence in (None, "", "ask the author", "CC BY-NC 4.0"))


@pytest.mark.parametrize(
    ("licence", "allowed", "may"),
    [
        ("CC BY 4.0", {"CC-BY-4.0"}, True),
        ("CC-BY-3.0", {"CC-BY-4.0"}, False),
        ("CC-BY-3.0", {"cc by"}, True),
        ("CC-BY", {"CC-BY-4.0"}, False),
        ("CC-BY-NC-4.0", {"CC-BY"}, False),
        ("CC-BY-NC-4.0", {"CC BY-NC 4.0"}, True),
        ("MIT-0", {"MIT"}, False),
        ("TurboSquid standard", {"TurboSquid standard"}, True),
        ("TurboSquid standard", {"CC0", "MIT"}, False),
        (None, {"CC0"}, False),
        ("free", {"public domain"}, False),  # two unknown licences are not the same
        ("CC0", set(), False),
    ],
)
def test_a_list_allows_what_it_names_in_any_spelling(licence: str | None, allowed: set[str], may: bool) -> None:
    assert is_licence_allowed(licence, allowed) is may
