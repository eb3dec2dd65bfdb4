"""The brackets of text layers are counted as USD would read them, fast, and before it does."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import MeshError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.usd_scenes import read_usd_scene
from stable_data.importers.usd.layers import LayerLoader
from stable_data.importers.usd.text_layers import bracket_levels, check_brackets
from stable_data.limits import LIMITS, FileLimits
from tests.bounds import soon

MOST = LIMITS.model.max_bracket_levels


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("", 0),
        ("([{}])", 3),
        ("()[]{}", 1),
        ("))))(", 1),
        ('"(((" (', 1),
        ("'(((' (", 1),
        ('"\\"(((" (', 1),
        ('"""("(\n(""" (', 1),
        ("'''('(\n(''' (", 1),
        ("@(((@ (", 1),
        ("@@@(@(@@@ (", 1),
        ("# ((( \n(", 1),
        ('"(((\n((', 2),  # a text that is not closed ends with its line
        ('"""(((\n((', 0),
    ],
)
def test_brackets_count_outside_of_texts_files_and_comments(text: str, levels: int) -> None:
    assert bracket_levels(text.encode()) == levels


@given(st.text("([{}])", max_size=300))
def test_levels_are_those_of_a_stack(text: str) -> None:
    level = deepest = 0
    for bracket in text:
        level = max(0, level + (1 if bracket in "([{" else -1))
        deepest = max(deepest, level)
    assert bracket_levels(text.encode()) == deepest


def test_levels_go_on_over_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.importers.usd.text_layers._PIECE", 7)
    assert bracket_levels(b"(" * 30 + b")" * 40 + b"((") == 30


@pytest.mark.parametrize("piece", ['"', "'\n", "@@@", '"""\\', '"\\', '"""x', 'x"', "@@ ", "("])
def test_hostile_texts_are_counted_in_linear_time(piece: str) -> None:
    with soon():
        bracket_levels(piece.encode() * 500_001)


def test_binary_layers_packages_and_honest_texts_pass() -> None:
    for start in (b"PXR-USDC", b"PK\x03\x04"):
        check_brackets(start + b"(" * 2 * MOST, "a.usd")
    check_brackets(b"#usda 1.0\n" + b"(" * MOST, "a.usda")


NESTED = ["(" * 2_000_000, "dictionary a = {" * 300_000, 'def Xform "a" {' * 300_000]


@pytest.mark.parametrize("content", NESTED, ids=["tuple", "dictionary", "prims"])
def test_a_layer_that_nests_too_deep_is_refused_before_it_is_parsed(content: str, tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text(f'#usda 1.0\ndef Xform "b" {{\nfloat3 x = {content}\n}}\n')
    for read in (read_usd_scene, lambda boundary, path: LayerLoader(boundary).load(path)):
        with soon(2), pytest.raises(MeshError, match="brackets that nest deeper, expected at most 1,000 levels") as caught:
            read(Boundary(tmp_path, FileLimits()), "a.usda")
        assert caught.value.code == "model_unreadable"
