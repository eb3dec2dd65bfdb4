"""The words of a licence are found where sources write them."""

from pathlib import Path

import pytest

from stable_data.assets.licences import normalise_licence
from stable_data.importers.boundary import Boundary
from stable_data.importers.stated_licences import (
    LicenceFiles,
    author_of_copyright,
    licence_of_field,
    licence_of_text,
    licences_of_file,
)

APACHE = "                                 Apache License\n                           Version 2.0, January 2004\n" + (
    "   1. Definitions.\n      by such Contributor that are necessarily infringed by their\n"
)
KAYKIT = "KayKit : Bits (1.0)\n\n------\n\nLicense: (Creative Commons Zero, CC0)\nhttp://creativecommons.org/publicdomain/zero/1.0/\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("LICENSE", "MIT License\n\nCopyright (c) 2020 Ann\n", "MIT"),
        ("LICENCE.md", "# The MIT License (MIT)\n", "MIT"),
        ("LICENSE", APACHE, "Apache-2.0"),
        ("License.txt", KAYKIT, "CC0-1.0"),
        ("LICENSE", "Attribution 4.0 International\n\n=====\n\nCreative Commons Corporation is not a law firm\n", "CC-BY-4.0"),
        ("COPYING", "GNU GENERAL PUBLIC LICENSE\nVersion 3\n", None),
        ("LICENSE", "MIT License for code.\nMeshes are for non-commercial use.\n", None),
        ("LICENSE", "Code: MIT License\nData: CC BY 4.0 license\n", {"MIT", "CC-BY-4.0"}),
        ("LICENSE", "All rights reserved.\n", None),
        ("LICENSE", "", None),
    ],
)
def test_licence_files(tmp_path: Path, name: str, text: str, expected: str | set[str] | None) -> None:
    (tmp_path / name).write_text(text)
    (tmp_path / "sub").mkdir()
    root = Boundary(tmp_path)
    assert LicenceFiles(root).nearest("sub/a.obj") == name
    given = licences_of_file(root, name)
    names = {normalise_licence(each.text) for each in given}
    assert names == (expected if isinstance(expected, set) else {expected})
    assert {each.where for each in given} == {name}


def test_a_readme_counts_if_it_names_one_licence(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "README.md").write_text("# Things\n\nThe meshes are licensed under CC BY 4.0.\n")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "README.md").write_text("x is under a CC BY 4.0 license\ny is under the MIT license\n")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "README").write_text("| x | CC BY 4.0 license |\n")
    files = LicenceFiles(Boundary(tmp_path))
    assert [files.nearest(f"{name}/m.obj") for name in "abc"] == ["a/README.md", None, None]


def test_the_nearest_file_counts_and_links_do_not(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "LICENSE").write_text("MIT License")
    (tmp_path / "a" / "LICENSE.txt").write_text("CC0 1.0 Universal")
    (tmp_path / "a" / "b" / "LICENSE").symlink_to("/etc/passwd")
    (tmp_path / "a" / "LICENSE.py").write_text("")
    files = LicenceFiles(Boundary(tmp_path))
    assert files.nearest("a/b/m.obj") == "a/LICENSE.txt"
    assert files.nearest("m.obj") == "LICENSE"


def test_sentences_and_fields() -> None:
    text = "A mug. Converted by Bob.\n Distributed under Creative Commons Attribution 4.0 International (CC BY 4.0) license. Enjoy!"
    given = licence_of_text(text, "model.config")
    assert given is not None
    assert normalise_licence(given.text) == "CC-BY-4.0"
    assert licence_of_text("A mug of coffee.", "model.config") is None
    assert licence_of_field("2019 (c) Company", "a.glb") is None
    assert licence_of_field("MIT", "a.glb") is not None
    assert licence_of_field("by-nc", "a.glb") is not None


@pytest.mark.parametrize(
    ("text", "author"),
    [
        ("© 2017, Ann Nopper, CC BY 4.0", "Ann Nopper"),
        ("(c) 2017-2019 Company. All rights reserved.", "Company"),
        ("Copyright 2020 Ann. Licensed under CC-BY 4.0 International", "Ann"),
        ("CC0 1.0 Universal", ""),
        ("2020", ""),
        ("", ""),
        ("J. R. Müller (https://example.org/ann); MIT License", "J. R. Müller"),
    ],
)
def test_authors_in_lines_of_copyright(text: str, author: str) -> None:
    assert author_of_copyright(text) == author
