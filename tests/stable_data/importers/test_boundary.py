"""Nothing outside of a source folder is read, whatever its files say."""

import os
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import ConfigError, MeshError
from stable_data.importers.boundary import Boundary, asset_id_of, renamed_notice
from stable_data.limits import FileLimits, ImageLimits


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A source folder with a secret beside it."""
    (tmp_path / "secret.txt").write_text("secret")
    root = tmp_path / "in"
    (root / "model" / "meshes").mkdir(parents=True)
    (root / "model" / "textures").mkdir()
    (root / "model" / "meshes" / "a.obj").write_text("mesh")
    (root / "model" / "textures" / "a b.png").write_text("image")
    return root


def code_of(root: Path, reference: str, base: str = "model/meshes") -> str:
    with pytest.raises(MeshError) as caught:
        Boundary(root).resolve(reference, base)
    assert "\n" not in str(caught.value)
    return caught.value.code


@pytest.mark.parametrize(
    "reference",
    [
        "../textures/a b.png",
        "..\\textures\\a b.png",
        "../textures/a%20b.png",
        " ../textures/a b.png ",
        "model://model/textures/a b.png",
        "package://model/textures/a b.png",
        "model://renamed/textures/a b.png",
        "../../model/./textures/../textures/a b.png",
        "../TEXTURES/A B.PNG",
    ],
)
def test_files_inside_are_found(folder: Path, reference: str) -> None:
    assert Boundary(folder).resolve(reference, "model/meshes") == "model/textures/a b.png"


@pytest.mark.parametrize(
    "reference",
    [
        "../../../secret.txt",
        "..\\..\\..\\secret.txt",
        "%2e%2e/%2e%2e/%2e%2e/secret.txt",
        "model://model/../../secret.txt",
        "package://../../../secret.txt/x",
        "/etc/passwd",
        "~/secret.txt",
        "C:\\textures\\a.png",
        "c:/textures/a.png",
        "\\\\server\\share\\a.png",
        "http://example.org/a.png",
        "file:///etc/passwd",
        "data:image/png;base64,AAAA",
    ],
)
def test_what_leaves_the_folder_is_refused(folder: Path, reference: str) -> None:
    assert code_of(folder, reference) in ("path_outside", "file_missing")
    with pytest.raises(MeshError):
        Boundary(folder).read_bytes(reference)


@pytest.mark.parametrize("reference", ["", " ", "a\0b", "none.obj", "..", ".", "a.obj/x", "x" * 5000, "model://other/none.obj"])
def test_what_is_not_there_is_missing(folder: Path, reference: str) -> None:
    assert code_of(folder, reference) == "file_missing"


@pytest.mark.parametrize("reference", ["a/" * 2_049, "./" * 2_046 + "a.obj", "model://other/" + "a/" * 2_049, "%2e/" * 1_025])
def test_a_path_longer_than_any_file_has_is_not_looked_up(
    folder: Path, monkeypatch: pytest.MonkeyPatch, reference: str
) -> None:
    """The time grew with the square of the length: 1 MB took a minute."""
    assert Boundary(folder).resolve("./" * 2_045 + "a.obj", "model/meshes") == "model/meshes/a.obj"

    def look_up(*_: object) -> None:
        raise AssertionError("it was looked up")

    monkeypatch.setattr(Boundary, "_inside", look_up)
    with pytest.raises(MeshError, match="is no path, expected the name of a file, at most 4,096 characters") as caught:
        Boundary(folder).resolve(reference, "model/meshes")
    assert caught.value.code == "file_missing"


def test_absolute_paths_are_refused_even_into_the_folder(folder: Path) -> None:
    assert code_of(folder, str(folder / "model" / "meshes" / "a.obj")) == "path_outside"


def test_links_are_followed_inside_only(folder: Path) -> None:
    (folder / "good.obj").symlink_to(folder / "model" / "meshes" / "a.obj")
    (folder / "bad.txt").symlink_to(folder.parent / "secret.txt")
    (folder / "out").symlink_to(folder.parent)
    (folder / "deep").symlink_to(folder / "model" / "meshes")
    assert Boundary(folder).resolve("good.obj") == "model/meshes/a.obj"
    assert Boundary(folder).read_bytes("good.obj") == b"mesh"
    assert code_of(folder, "bad.txt", "") == "path_outside"
    assert code_of(folder, "out/secret.txt", "") == "path_outside"
    assert code_of(folder, "out/SECRET.TXT", "") == "path_outside"
    assert code_of(folder, "deep/../../../secret.txt", "") == "path_outside"
    # Lexically outside, physically inside: the second counts, and nothing outside is listed for another case.
    assert code_of(folder, "deep/../../SECRET.TXT", "") == "file_missing"
    assert list(Boundary(folder).files({".obj", ".txt"})) == ["model/meshes/a.obj"]


def test_circles_of_links_end(folder: Path) -> None:
    (folder / "round").symlink_to(folder)
    (folder / "one").symlink_to(folder / "two")
    (folder / "two").symlink_to(folder / "one")
    assert list(Boundary(folder).files({".obj"})) == ["model/meshes/a.obj"]
    assert code_of(folder, "one", "") == "file_missing"
    assert Boundary(folder).resolve("round/round/model/meshes/a.obj") == "model/meshes/a.obj"


def test_two_names_that_differ_in_case_are_never_taken_for_each_other(folder: Path) -> None:
    (folder / "Mug.obj").write_text("1")
    (folder / "mug.obj").write_text("2")
    assert Boundary(folder).read_bytes("Mug.obj") == b"1"
    assert Boundary(folder).read_bytes("mug.obj") == b"2"
    assert code_of(folder, "MUG.obj", "") == "file_missing"


def test_the_composition_of_letters_does_not_matter(folder: Path) -> None:
    name = unicodedata.normalize("NFC", "tasse_é_猫.obj")
    (folder / name).write_text("cup")
    assert Boundary(folder).read_bytes(Boundary(folder).resolve(unicodedata.normalize("NFD", name))) == b"cup"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_pipes_and_devices_are_no_files(folder: Path) -> None:
    os.mkfifo(folder / "pipe.obj")
    assert code_of(folder, "pipe.obj", "") == "file_missing"
    assert "pipe.obj" not in list(Boundary(folder).files({".obj"}))
    (folder / "null.obj").symlink_to("/dev/null")
    assert code_of(folder, "null.obj", "") == "path_outside"


def test_sizes_are_limited_for_a_file_and_for_an_asset(folder: Path) -> None:
    for k in range(4):
        (folder / f"{k}.bin").write_bytes(bytes(100))
    with pytest.raises(MeshError, match=r"is larger, expected at most 50 bytes \(max_file_bytes\)") as caught:
        Boundary(folder, FileLimits(max_file_bytes=50)).read_bytes("0.bin")
    assert caught.value.code == "file_too_large"
    with pytest.raises(MeshError, match="at most 99 bytes"):
        Boundary(folder).read_bytes("0.bin", "max_bytes", ImageLimits(max_bytes=99))
    for limits in (FileLimits(max_bytes=250), FileLimits(max_files=2)):
        root = Boundary(folder, limits)
        root.read_bytes("0.bin")
        root.read_bytes("0.bin")  # the same file counts once
        root.read_bytes("1.bin")
        with pytest.raises(MeshError, match="is one of 3 files") as caught:
            root.read_bytes("2.bin")
        assert caught.value.code == "file_too_large"
    root = Boundary(folder)
    root.read_bytes("0.bin")
    assert root.opened == {"0.bin"}


def test_the_head_of_a_file_is_bounded_and_not_counted(folder: Path) -> None:
    root = Boundary(folder)
    assert root.read_head("model/meshes/a.obj", 2) == b"me"
    assert root.read_head("../secret.txt", 9) == b""
    assert root.read_head("none", 9) == b""
    assert not root.opened


def test_files_come_in_a_fixed_order_folder_by_folder(folder: Path) -> None:
    for name in ("b.obj", "a.obj", "sub/c.OBJ", ".hidden/d.obj", "z.txt"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("")
    assert list(Boundary(folder).files({".obj"})) == ["a.obj", "b.obj", "model/meshes/a.obj", "sub/c.OBJ"]


def test_a_source_that_is_no_folder_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no folder"):
        Boundary(tmp_path / "none")


@given(st.text(max_size=200))
def test_identifiers_are_names_of_files_everywhere(name: str) -> None:
    asset_id = asset_id_of(name)
    assert asset_id
    assert asset_id.isascii()
    assert not set(asset_id) - set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-")
    assert asset_id_of(asset_id) == asset_id
    notice = renamed_notice(asset_id, name)
    assert (notice is None) == (name == asset_id)


@given(
    st.lists(st.sampled_from(["..", ".", "a", "model", "A", "link", "model:", "/", "\\", "%2e%2e", "\0"]), max_size=8),
    st.booleans(),
)
def test_no_reference_reaches_outside(tmp_path_factory: pytest.TempPathFactory, parts: list[str], is_named: bool) -> None:
    root = tmp_path_factory.getbasetemp() / "any" / "in"
    if not root.exists():
        (root / "model").mkdir(parents=True)
        (root / "model" / "a").write_text("in")
        (root.parent / "a").write_text("out")
        (root / "link").symlink_to(root.parent)
    reference = ("model://" if is_named else "") + "/".join(parts)
    try:
        path = Boundary(root).resolve(reference, "model")
    except MeshError:
        return
    assert Boundary(root).read_bytes(path) == b"in"
