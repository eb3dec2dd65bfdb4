"""The names of ``import stable_data``: they are there, imported late, and one that needs an extra says which."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import stable_data
from stable_data.extras import EXTRA_OF_MODULE

ROOT = Path(__file__).resolve().parents[2]
STUB = Path(stable_data.__file__).with_suffix(".pyi").read_text("utf-8")
TYPED = {
    alias.name: str(node.module)
    for node in ast.walk(ast.parse(STUB))
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
"""Name -> module, as a type checker sees them."""

BASE = ("MesaTaskDataset", "RunFolder", "Scene", "SceneIndex", "parse_filter", "scene_from_row")
"""What the base dependencies are enough for."""


def without_extras(code: str) -> subprocess.CompletedProcess[str]:
    """Runs code where no module of an extra can be imported."""
    blocked = f"import sys; sys.modules.update(dict.fromkeys({list(EXTRA_OF_MODULE)})); "
    return subprocess.run([sys.executable, "-c", blocked + code], capture_output=True, text=True, cwd=ROOT)


@pytest.mark.parametrize("name", stable_data.__all__)
def test_a_name_is_what_the_type_checker_sees(name: str) -> None:
    assert getattr(stable_data, name) is getattr(import_module(TYPED[name]), name)


def test_all_names_are_typed_and_listed() -> None:
    assert sorted(TYPED) == sorted(stable_data.__all__)
    assert re.findall(r'^    "(\w+)",$', STUB, re.MULTILINE) == stable_data.__all__
    assert set(stable_data.__all__) <= set(dir(stable_data))


def test_the_base_dependencies_are_enough_for_scenes_and_tables() -> None:
    done = without_extras(f"from stable_data import {', '.join(BASE)}")
    assert done.returncode == 0, done.stderr


def test_every_other_name_says_what_to_install() -> None:
    others = sorted(set(stable_data.__all__) - set(BASE))
    code = (
        f"import stable_data\nfor name in {others}:\n    try:\n        getattr(stable_data, name)\n"
        "    except ModuleNotFoundError as error:\n        print(error)"
    )
    lines = without_extras("\n" + code).stdout.splitlines()
    assert len(lines) == len(others)
    for name, line in zip(others, lines, strict=True):
        assert re.fullmatch(
            rf"stable_data\.{name} needs \w+, which is not installed: pip install 'stable-data\[[a-z,]+\]'", line
        )


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute Nothing, expected one of AssetStore"):
        _ = stable_data.Nothing  # type: ignore[attr-defined]
