"""Exports to SDFormat, URDF and MJCF objects, opened by Drake, PyBullet, yourdfpy, SAPIEN, robosuite, MuJoCo and libsdformat."""

from pathlib import Path

import pytest

from benchmarks.consumers.comparison import differences, expected, stays
from benchmarks.consumers.environment import CONSUMERS, Consumer
from stable_data.export.formats import format_named
from stable_data.simulation.scene_geometry import SceneGeometry

pytestmark = [pytest.mark.slow, pytest.mark.sim, pytest.mark.timeout(1200)]

READERS = [c for c in CONSUMERS.values() if c.format_name in ("sdformat", "urdf", "mjcf-objects") and not c.judges]


def exported(geometries: list[SceneGeometry], name: str, out: Path) -> list[Path]:
    chosen = format_named(name)
    for geometry in geometries:
        chosen.export_scene(geometry, out)
    return [chosen.scene_path(geometry.scene, out) for geometry in geometries]


@pytest.mark.parametrize("consumer", READERS, ids=lambda consumer: consumer.name)
def test_a_reader_sees_the_bodies_of_the_scene(consumer: Consumer, geometries: list[SceneGeometry], tmp_path: Path) -> None:
    if not consumer.is_there:
        pytest.skip(consumer.missing)
    files = exported(geometries, consumer.format_name, tmp_path)
    seen = consumer.open(files, seconds=2.0 if consumer.engine else 0.0)
    for geometry, found in zip(geometries, seen, strict=True):
        assert differences(expected(geometry, consumer.format_name), found) == [], geometry.scene.scene_id
    if consumer.engine:
        at_rest = {
            g.scene.scene_id: stays(expected(g, consumer.format_name), found) for g, found in zip(geometries, seen, strict=True)
        }
        assert at_rest.pop("falling") is False
        assert set(at_rest.values()) == {True}, at_rest


@pytest.mark.parametrize("consumer", READERS, ids=lambda consumer: consumer.name)
def test_a_mesh_that_is_lost_is_an_error(consumer: Consumer, geometries: list[SceneGeometry], tmp_path: Path) -> None:
    if not consumer.is_there:
        pytest.skip(consumer.missing)
    files = exported(geometries[:1], consumer.format_name, tmp_path)
    for part in tmp_path.rglob("part_0.obj"):
        part.unlink()
    [seen] = consumer.open(files)
    assert differences(expected(geometries[0], consumer.format_name), seen)


def test_the_official_library_finds_nothing_against_worlds_and_models(geometries: list[SceneGeometry], tmp_path: Path) -> None:
    consumer = CONSUMERS["libsdformat"]
    if not consumer.is_there:
        pytest.skip(consumer.missing)
    worlds = exported(geometries, "sdformat", tmp_path)
    models = sorted((tmp_path / "models").glob("*/model.sdf"))
    assert models
    assert consumer.open([*worlds, *models]) == [{"error": None, "problems": []}] * (len(worlds) + len(models))
    broken = worlds[0].read_text("utf-8").replace("<mass>", "<mass>-", 1)
    (tmp_path / "broken.sdf").write_text(broken, "utf-8")
    assert consumer.open([tmp_path / "broken.sdf"])[0]["problems"]
