"""What every test may ask for."""

import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: two threads on a busy machine wait for each other

import numpy as np
import pytest
from hypothesis import settings

from tests.broken_inputs import write_broken_inputs

# A run that fails fails again, and none fails because the machine is busy; `--hypothesis-profile=default` explores.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Twelve scenes over 25 real meshes, with truth.json, in the MesaTask-10K format: ``tests/data/README.md``."""
    return Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def broken_data(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of ``tests.broken_inputs.BROKEN_INPUTS``: one scene for each, which has its name."""
    root = tmp_path_factory.mktemp("broken_inputs") / "data"
    write_broken_inputs(root, real_data)
    return root


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The development sets beside the checkout, larger than ``tests/data``; they are not part of the project."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the development data beside the checkout (../shared/data) are absent")
    return folder


@pytest.fixture(scope="session", params=["small", pytest.param("large", marks=pytest.mark.slow)])
def measured_data(request: pytest.FixtureRequest) -> Path:
    """For tests of a rate: ``tests/data``, and among the slow tests the 120 scenes of ``mesa_real`` beside the checkout."""
    small: Path = request.getfixturevalue("real_data")
    return small if request.param == "small" else Path(request.getfixturevalue("shared_data")) / "mesa_real"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
