"""The mean of correctors."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from models.physics_corrector.flow.checkpoint import load_corrector, save_corrector
from models.physics_corrector.training.averaging import main
from stable_data.errors import ConfigError
from tests.models.physics_corrector.training.training_scenes import TINY


def written(path: Path, seed: int, encoder: str = "one") -> Path:
    torch.manual_seed(seed)
    network, _ = TINY.corrector.build()
    save_corrector(path, TINY.corrector, network.state_dict(), {"encoder_fingerprint": encoder, "steps": str(seed)})
    return path


def test_the_mean_is_between_the_files_and_has_the_notes_of_the_last(tmp_path: Path) -> None:
    first, second = written(tmp_path / "a.safetensors", 1), written(tmp_path / "b.safetensors", 2)
    main(str(tmp_path / "mean.safetensors"), str(first), "1", str(second), "3")
    one, two, mean = (load_corrector(tmp_path / f"{name}.safetensors") for name in ("a", "b", "mean"))
    for name, value in mean.network.state_dict().items():
        expected = 0.25 * one.network.state_dict()[name] + 0.75 * two.network.state_dict()[name]
        assert torch.allclose(value, expected, atol=1e-6)
    assert mean.notes["steps"] == "2"
    assert mean.notes["mean_of"] == "1 3"


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    first, other = written(tmp_path / "a.safetensors", 1), written(tmp_path / "b.safetensors", 2, "two")
    with pytest.raises(ConfigError, match="reads the features of another encoder"):
        main(str(tmp_path / "mean.safetensors"), str(first), "1", str(other), "1")
    settings = replace(TINY.corrector, network=replace(TINY.corrector.network, channels=16))
    network, _ = settings.build()
    save_corrector(tmp_path / "c.safetensors", settings, network.state_dict(), {"encoder_fingerprint": "one"})
    with pytest.raises(ConfigError, match="has another network"):
        main(str(tmp_path / "mean.safetensors"), str(tmp_path / "c.safetensors"), "1", str(first), "1")
    with pytest.raises(ConfigError, match="expected OUT FILE SHARE"):
        main(str(tmp_path / "mean.safetensors"), str(first))
    assert not (tmp_path / "mean.safetensors").exists()
