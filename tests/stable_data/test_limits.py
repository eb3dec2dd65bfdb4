"""The limits: their names and values, how they are changed, what a message says, and the bound on memory."""

import os
import subprocess
import sys
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS, SETTING, ImageLimits, Limits, at_most, list_limits, memory_limited, read_limits


def test_every_limit_has_a_positive_default_and_says_what_it_limits() -> None:
    limits = list_limits()
    assert len(limits) == len({one.name for one in limits}) > 70
    assert [one.name for one in limits if not one.meaning.endswith(".") or one.default <= 0] == []
    assert all(is_dataclass(getattr(LIMITS, group.name)) for group in fields(LIMITS))


def test_limits_are_changed_by_their_names() -> None:
    limits = read_limits(" mesh.max_faces=5_000_000,layout.max_reach = 2.5 ,")
    assert (limits.mesh.max_faces, limits.layout.max_reach) == (5_000_000, 2.5)
    assert limits.changed() == {"mesh.max_faces": 5_000_000, "layout.max_reach": 2.5}
    assert limits.gltf_scene == Limits().gltf_scene
    assert read_limits("") == Limits()


@pytest.mark.parametrize(
    "text",
    [
        "mesh.max_faces",
        "mesh.max_faces=",
        "mesh.max_faces=0",
        "mesh.max_faces=-1",
        "mesh.max_faces=1.5",
        "mesh.max_faces=nan",
        "mesh.max_faces=" + "9" * 5000,
        "mesh.max_faces=١",
        "layout.max_reach=inf",
        "layout.max_reach=.",
        "mesh=1",
        "max_faces=1",
        "mesh.max_faces=1\x1b[31m",
        "x" * 10_000,
    ],
)
def test_what_is_no_limit_ends_the_command_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match=f"{SETTING}: ") as caught:
        read_limits(text)
    assert caught.value.code == "limits_invalid"
    assert len(str(caught.value)) < 300
    assert str(caught.value).isprintable()


def test_a_message_names_the_limit_and_its_setting() -> None:
    assert at_most(LIMITS.mesh, "max_faces", "faces") == f"at most 1,000,000 faces (mesh.max_faces in {SETTING})"
    assert at_most(LIMITS.layout, "max_reach", "m") == f"at most 10 m (layout.max_reach in {SETTING})"
    assert at_most(ImageLimits(max_scans=7), "max_scans") == "at most 7 (max_scans)"  # chosen by a caller


def test_the_variable_holds_for_a_command() -> None:
    command = [sys.executable, "-m", "stable_data", "limits"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, SETTING: "json.max_levels=7"}, check=True)
    assert "json.max_levels = 7 (default 64)\n    Nesting of lists and objects" in done.stdout
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, SETTING: "json.levels=7"}, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: {SETTING}: 'json.levels=7' names no limit")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")
def test_memory_is_bounded_in_the_body_alone() -> None:
    code = """
import numpy as np
from stable_data.limits import memory_limited
for allocate in (lambda: np.ones(2**28, np.uint8), lambda: bytearray(2**28), lambda: "x" * 2**28):
    with memory_limited(2**26):
        np.ones(2**24, np.uint8)
        try:
            allocate()
            print("allocated")
        except MemoryError:
            print("refused")
    allocate()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["refused"] * 3


def test_a_bound_that_is_far_away_changes_nothing() -> None:
    with memory_limited(2**34), memory_limited(2**33):
        assert np.ones(2**20).sum() == 2**20
