"""Exports in OpenUSD, opened by MuJoCo and Newton, and judged by the validators of SimReady and NVIDIA."""

from pathlib import Path

import pytest

from benchmarks.consumers.comparison import differences, expected, stays
from benchmarks.consumers.environment import CONSUMERS
from stable_data.export.usd import UsdFormat
from stable_data.simulation.scene_geometry import SceneGeometry

pytestmark = [pytest.mark.slow, pytest.mark.sim, pytest.mark.timeout(1200)]


def exported(geometries: list[SceneGeometry], flavour: str, out: Path) -> list[Path]:
    usd = UsdFormat("isaaclab") if flavour == "isaaclab" else UsdFormat()
    for geometry in geometries:
        usd.export_scene(geometry, out)
    return [usd.scene_path(geometry.scene, out) for geometry in geometries]


@pytest.mark.parametrize("name", ["mujoco_usd", "newton_usd"])
def test_an_engine_sees_the_bodies_of_the_scene(name: str, geometries: list[SceneGeometry], tmp_path: Path) -> None:
    consumer = CONSUMERS[name]
    if not consumer.is_there:
        pytest.skip(consumer.missing)
    files = exported(geometries, "neutral", tmp_path)
    seen = consumer.open(files, seconds=2.0)
    for geometry, found in zip(geometries, seen, strict=True):
        bodies = {
            k: b for k, b in expected(geometry, "usd").items() if not b.is_fixed
        }  # fixed ones are shapes of the world there
        assert differences(bodies, found) == [], geometry.scene.scene_id
    at_rest = {g.scene.scene_id: stays(expected(g, "usd"), found) for g, found in zip(geometries, seen, strict=True)}
    assert at_rest.pop("falling") is False
    assert set(at_rest.values()) == {True}, at_rest


@pytest.mark.parametrize("flavour", ["neutral", "isaaclab"])
def test_validators_find_nothing(flavour: str, geometries: list[SceneGeometry], tmp_path: Path) -> None:
    if not CONSUMERS["simready"].is_there:
        pytest.skip(CONSUMERS["simready"].missing)
    stages = exported(geometries, flavour, tmp_path)
    packages = sorted((tmp_path / "props").glob("*/usd/*.usd"))
    furniture = sorted((tmp_path / "furniture").glob("*.usd"))
    for name, files in (("simready", packages), ("nvidia_usd", [*packages, *furniture, *stages])):
        assert files
        for file, found in zip(files, CONSUMERS[name].open(files), strict=True):
            assert found == {"error": None, "problems": []}, file


def test_a_broken_stage_is_an_error_and_not_a_scene_at_rest(tmp_path: Path) -> None:
    consumer = CONSUMERS["mujoco_usd"]
    if not consumer.is_there:
        pytest.skip(consumer.missing)
    (tmp_path / "broken.usda").write_text("#usda 1.0\ndef Xform {")
    [seen] = consumer.open([tmp_path / "broken.usda"], seconds=1.0)
    assert seen["error"]
    assert stays({}, seen) is None
    assert differences({}, seen)
