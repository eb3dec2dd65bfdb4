"""docs/episodes.md as written, on a small run."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stable_data.robot.synthetic_episodes import episode, write_run

DOC = Path(__file__).parents[3] / "docs" / "episodes.md"
EPISODES = [episode(f"scene-{s}", k, steps=20 + s, cameras=("front",), size=(8, 8)) for s in range(2) for k in range(3)]


def code(word: str) -> str:
    [block] = [block for block in re.findall(r"```python\n(.*?)```", DOC.read_text(), re.DOTALL) if word in block]
    return str(block)


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setenv("HF_HOME", str(tmp_path / "cache"))
    return {"RUN": write_run(tmp_path / "run", EPISODES).uri}


def test_our_loaders(names: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    exec(code("EpisodeChunks"), names)  # noqa: S102
    assert capsys.readouterr().out.splitlines() == [f"scene-{s}/2 the object was not lifted ({20 + s}, 8)" for s in range(2)]
    assert len(names["chunks"]) == 20 + 20 + 21 + 21
    assert names["batch"]["actions"].shape == (82, 16, 8)


def test_polars(names: dict[str, Any]) -> None:
    exec(code("import polars"), names)  # noqa: S102
    assert np.array_equal(names["actions"], EPISODES[0].actions)
    assert tuple(names["files"]["front"]) == EPISODES[0].pictures["front"]


def test_hugging_face_datasets(names: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import datasets

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    exec(code("load_dataset"), names)  # noqa: S102
    assert names["names"] == list(EPISODES[0].action_names)
    assert len(names["rows"]) == 6
