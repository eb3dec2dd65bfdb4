"""The scenes that consumers open."""

from dataclasses import replace

import pytest

from stable_data.assets.run_assets import run_store
from stable_data.simulation.run_reader import RunScenes
from stable_data.simulation.scene_geometry import SceneGeometry
from tests import textured_assets
from tests.stable_data.export.runs import EMPTY, at_rest, falling, write_run


@pytest.fixture(scope="session")
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
