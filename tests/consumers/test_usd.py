"""Exports in OpenUSD, opened by MuJoCo and Newton, and judged by the validators of SimReady and NVIDIA."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.consumers.comparison import differences, expected, stays
from benchmarks.consumers.environment import CONSUMERS
from stable_data.assets.run_assets import run_store
from stable_data.export.usd import UsdFormat
from stable_data.simulation.run_reader import RunScenes
from stable_data.simulation.scene_geometry import SceneGeometry
from tests import textured_assets
from tests.stable_data.export.runs import EMPTY, at_rest, falling, write_run

pytestmark = [pytest.mark.slow, pytest.mark.sim, pytest.mark.timeout(1200)]


@pytest.fixture(scope="module")
def geometries(tmp_path_factory: pytest.TempPathFactory) -> list[SceneGeometry]:
    """Scenes at rest and not, with odd names, boxes, a fixed object and textures."""
    root = tmp_path_factory.mktemp("runs")
    store = run_store(write_run(root / "plain").uri)
    fixed = replace(at_rest(), scene_id="fixed", fixed=frozenset({"2_plate_0"}))
    look = textured_assets.textured("box", textured_assets.picture_box())
    dressed = textured_assets.scene_of(textured_assets.thing("0_box_0", "box", 0.4, 0.3, 0.5, 1.5))
    scenes = RunScenes(textured_assets.write_run(root / "dressed", [look], dressed))
    found = [SceneGeometry.of(scene, store) for scene in (at_rest(), falling(), EMPTY, fixed)]
    return [*found, *(scenes.geometry(scene) for scene in scenes)]


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
    at_rest = {g.scene.scene_id: stays(found) for g, found in zip(geometries, seen, strict=True)}
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
    assert stays(seen) is None
    assert differences({}, seen)
