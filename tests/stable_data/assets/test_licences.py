"""Licences in the spellings of many sources."""

from importlib.metadata import distributions
from pathlib import Path

import pytest

from stable_data.assets.licences import (
    KNOWN_LICENCES,
    LicenceTerms,
    is_licence_allowed,
    is_restricted,
    licence_terms,
    normalise_licence,
)


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


GRANT = (
    "Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated documentation "
    'files (the "Software"), to deal in the Software without restriction, including without limitation the rights to use, copy, '
    "modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit persons to whom the Software "
    "is furnished to do so"
)
NOTICE = (
    ", subject to the following conditions:\n\nThe above copyright notice and this permission notice shall be included in all "
)
NOTICE += "copies or substantial portions of the Software."
WARRANTY = (
    '\n\nTHE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE '
    "WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT "
    "HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, "
    "OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.\n"
)
MIT = "MIT License\n\nCopyright (c) 2020 A. All rights reserved.\n\n" + GRANT + NOTICE + WARRANTY
DEED = (
    '{} International\n\n====\n\nCreative Commons Corporation ("Creative Commons") is not a law firm and does not provide legal services '
    "or legal advice. Distribution of Creative Commons public licenses does not create a lawyer-client or other relationship."
)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (MIT, "MIT"),
        (MIT[:1000], "MIT"),
        ("Copyright 2019 A\n" + GRANT + NOTICE + WARRANTY, "MIT"),
        ("Copyright 2019 A. All Rights Reserved.\n" + GRANT + "." + WARRANTY, "MIT-0"),
        (MIT + "The meshes are for non-commercial use only.", None),
        (MIT + "The textures must not be passed on.", None),
        (DEED.format("Attribution 4.0"), "CC-BY-4.0"),
        (DEED.format("Attribution-NonCommercial-ShareAlike 4.0"), "CC-BY-NC-SA-4.0"),
        (DEED.format("Attribution-NoDerivatives 4.0"), "CC-BY-ND-4.0"),
        (
            "Creative Commons Legal Code\n\nCC0 1.0 Universal\n\n    CREATIVE COMMONS CORPORATION IS NOT A LAW FIRM AND DOES NOT PROVIDE "
            "LEGAL SERVICES.",
            "CC0-1.0",
        ),
        (
            "License: (Creative Commons Zero, CC0)\nhttp://creativecommons.org/publicdomain/zero/1.0/\n\nThis content is free to use in "
            "personal, educational and commercial projects.\n\nSupport me by crediting A, www.a.com (this is not mandatory)",
            "CC0-1.0",
        ),
        (
            "This model has been converted from Yale-CMU-Berkeley(YCB) Object and Model set. Distributed under Creative Commons "
            "Attribution 4.0 International (CC BY 4.0) license.",
            "CC-BY-4.0",
        ),
        ("This content is free to use in personal projects.", None),
        ("All rights reserved.", None),
        ("x" * 100_000, None),
    ],
)
def test_texts_of_licences(text: str, name: str | None) -> None:
    assert normalise_licence(text) == name


def test_the_licence_of_this_project_is_known_whole_and_by_its_beginning() -> None:
    text = (Path(__file__).resolve().parents[3] / "LICENSE").read_text("utf-8")
    assert normalise_licence(text) == normalise_licence(text[:1000]) == "Apache-2.0"


@pytest.mark.parametrize(
    ("package", "name"), [("attrs", "MIT"), ("click", "BSD-3-Clause"), ("pygments", "BSD-2-Clause"), ("packaging", None)]
)
def test_licence_files_of_packages(package: str, name: str | None) -> None:
    found = [f for d in distributions(name=package) for f in d.files or [] if f.name in ("LICENSE", "LICENSE.txt")]
    if not found:
        pytest.skip(f"{package} is not installed with a licence file")
    assert normalise_licence(Path(str(found[0].locate())).read_text("utf-8")) == name


def test_restrictions_of_texts_that_name_no_licence() -> None:
    assert is_restricted("for research only")
    assert is_restricted("(c) A. All rights reserved.")
    assert not is_restricted("see the page of the author")


def test_known_licences_are_their_own_names() -> None:
    assert [normalise_licence(name) for name in KNOWN_LICENCES] == list(KNOWN_LICENCES)
    assert len(set(KNOWN_LICENCES)) == len(KNOWN_LICENCES)
