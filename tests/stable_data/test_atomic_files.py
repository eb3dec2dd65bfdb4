import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.cache_folder import user_cache


def test_a_file_is_there_whole_and_nothing_beside_it(tmp_path: Path) -> None:
    for content in (b"first", b"second"):
        write_file_atomically(tmp_path / "a.bin", content)
        assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.bin", content)]


def test_what_cannot_be_put_in_place_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "held").touch()
    with pytest.raises(OSError, match=r".*"):
        write_file_atomically(tmp_path / "a", b"content")
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_writers_with_the_number_of_one_process_do_not_disturb_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getpid", lambda: 1)  # as in two containers that share a folder
    path, contents = tmp_path / "a.bin", [bytes([k]) * 2**20 for k in range(4)]

    def write(content: bytes) -> None:
        for _ in range(10):
            write_file_atomically(path, content)
            assert path.read_bytes() in contents

    with ThreadPoolExecutor(len(contents)) as pool:
        list(pool.map(write, contents))
    assert list(tmp_path.iterdir()) == [path]


@given(st.text())
def test_any_text_becomes_a_plain_name(text: str) -> None:
    name = safe_file_name(text)
    assert safe_file_name(name) == name
    assert name.isascii()
    assert 0 < len(name) < 120
    assert not name.startswith(".")
    assert not set(name) - set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.+-")


@given(st.lists(st.text(alphabet="a_ /."), unique=True, max_size=30))
def test_different_names_stay_different(names: list[str]) -> None:
    assert len({safe_file_name(name) for name in names}) == len(names)


def test_a_reserved_name_is_changed() -> None:
    assert safe_file_name("world") == "world"
    assert safe_file_name("world", {"world"}) != "world"


def test_a_user_without_a_home_has_a_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", fail)
    assert user_cache("kind") == Path(tempfile.gettempdir()) / "stable-data" / "kind"
