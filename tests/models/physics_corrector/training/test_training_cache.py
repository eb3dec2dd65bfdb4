"""A cached training set that is none is made again."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from models.physics_corrector.training.dataset import read_cache


@pytest.mark.parametrize(
    "notes",
    [None, {}, {"other": "{}"}, {"about": "{"}, {"about": "{}"}, {"about": "[]"}, {"about": "null"}, {"about": "[" * 100_000}],
)
def test_a_file_of_others_is_no_cache(notes: dict[str, str] | None, tmp_path: Path) -> None:
    path = tmp_path / "scenes.safetensors"
    save_file({"stage": torch.zeros(3)}, path, notes)
    assert read_cache(path) is None


@pytest.mark.parametrize("content", [b"", b"no safetensors", b"\xff" * 64])
def test_a_damaged_file_is_no_cache(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "scenes.safetensors"
    path.write_bytes(content)
    assert read_cache(path) is None
