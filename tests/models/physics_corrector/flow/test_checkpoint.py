"""Weights carry their settings: they come back as they were, or are refused with the reason."""

import json
import os
import stat
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from models.physics_corrector.flow.checkpoint import load_corrector, save_corrector
from models.physics_corrector.flow.flow_matching import FlowSettings
from models.physics_corrector.flow.presets import PRESETS, CorrectorSettings, preset
from stable_data.errors import ConfigError
from tests.models.physics_corrector.flow.conditions import awake_network, condition, small_settings


@pytest.fixture(params=["unet1d", "set_transformer"])
def settings(request: pytest.FixtureRequest) -> CorrectorSettings:
    return small_settings(request.param)


@pytest.fixture
def file(settings: CorrectorSettings, tmp_path: Path) -> Path:
    path = tmp_path / "weights" / "corrector.safetensors"
    save_corrector(path, settings, awake_network(settings).state_dict(), {"encoder": "abc"})
    return path


def rewritten(file: Path, settings: CorrectorSettings | str | None) -> Path:
    """The same tensors under other settings."""
    text = settings.to_json() if isinstance(settings, CorrectorSettings) else settings
    save_file(load_file(file), file, None if text is None else {"settings": text})
    return file


def test_a_corrector_comes_back_as_it_was(settings: CorrectorSettings, file: Path) -> None:
    network, scenes = awake_network(settings), condition(2, 4)
    read = load_corrector(file, settings)
    assert (read.settings, read.notes) == (settings, {"encoder": "abc"})
    assert not read.network.training
    assert torch.equal(read.flow.sample(read.network, scenes), read.flow.sample(network, scenes))
    assert [p.name for p in file.parent.iterdir()] == [file.name]


def test_weights_that_are_not_finite_are_refused(settings: CorrectorSettings, file: Path) -> None:
    tensors = load_file(file)
    first = min(tensors)
    save_file({**tensors, first: torch.full_like(tensors[first], torch.nan)}, file, {"settings": settings.to_json()})
    with pytest.raises(ConfigError, match=f"{first} and 0 more tensors have values that are not finite"):
        load_corrector(file)


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_who_may_read_a_corrector_is_the_umask_to_say(umask: int, mode: int, tmp_path: Path) -> None:
    settings, path = small_settings("unet1d"), tmp_path / "corrector.safetensors"
    before = os.umask(umask)
    try:
        save_corrector(path, settings, awake_network(settings).state_dict())
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == mode


def test_without_expectations_the_file_says_what_it_is(settings: CorrectorSettings, file: Path) -> None:
    assert load_corrector(file).settings == settings


def test_another_configuration_is_refused_with_what_differs(settings: CorrectorSettings, file: Path) -> None:
    wanted = replace(settings, network=replace(settings.network, channels=64), flow=FlowSettings(sigma=0.5))
    with pytest.raises(ConfigError, match=r"flow\.sigma: 0\.2 -> 0\.5; network\.channels: 32 -> 64") as error:
        load_corrector(file, wanted)
    assert error.value.code == "checkpoint_mismatch"


def test_tensors_that_do_not_fit_the_settings_are_refused(settings: CorrectorSettings, file: Path) -> None:
    rewritten(file, replace(settings, network=replace(settings.network, code_channels=9)))
    with pytest.raises(ConfigError, match=r"codes\.weight: found \(64, 8\), expected \(64, 9\)"):
        load_corrector(file)


@pytest.mark.parametrize("text", [None, "{", "[]", '{"network": {}, "flow": {}}'])
def test_a_file_that_says_nothing_usable_of_its_settings_is_refused(file: Path, text: str | None) -> None:
    with pytest.raises(ConfigError, match="settings"):
        load_corrector(rewritten(file, text))


@pytest.mark.parametrize(
    "wrong", [{"channels": "32"}, {"channels": True}, {"channels": 2**40}, {"backbone": "mlp"}, {"extra": 1}]
)
def test_settings_of_the_wrong_kind_are_refused(settings: CorrectorSettings, file: Path, wrong: dict[str, object]) -> None:
    values = json.loads(settings.to_json())
    values["network"] |= wrong
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        load_corrector(rewritten(file, json.dumps(values)))


def test_what_is_no_safetensors_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.safetensors").write_bytes(b"not a tensor in sight")
    for name in ("x.safetensors", "absent.safetensors"):
        with pytest.raises(ConfigError, match="safetensors"):
            load_corrector(tmp_path / name)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_settings_survive_json(name: str) -> None:
    settings = preset(name)
    assert CorrectorSettings.from_json(settings.to_json()) == settings


def test_the_papers_coordinates_are_absolute_metres_and_radians() -> None:
    changed = preset("paper_tuned").differences(preset("paper"))
    assert changed[:3] == [
        "flow.coordinates.form: residual -> absolute",
        "flow.coordinates.length_unit: 0.05 -> 1.0",
        "flow.coordinates.yaw_unit: 0.5 -> 1.0",
    ]


def test_a_preset_that_is_not_known_is_refused() -> None:
    with pytest.raises(ConfigError, match="paper"):
        preset("papre")


def test_the_same_weights_give_the_same_bytes(tmp_path: Path) -> None:
    """What the file says of itself too, whatever the order that the library would write it in."""
    settings = small_settings()
    network, _ = settings.build()
    notes = {f"note {n}": "§" * n for n in range(9)}
    for n in range(4):
        save_corrector(tmp_path / str(n), settings, network.state_dict(), notes)
    assert len({(tmp_path / str(n)).read_bytes() for n in range(4)}) == 1
    assert load_corrector(tmp_path / "0").notes == notes
