"""Which point of a tilted object a dataset calls its position: told apart on real scenes and on things that lean in cups."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stable_data.assets.store import AssetStore
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import SceneError
from stable_data.mesatask import MesaTaskDataset, PositionConvention, to_box_centre, write_annotations, write_scene
from stable_data.mesatask.convention_detection import position_convention
from stable_data.scene import Scene, SceneObject

pytestmark = pytest.mark.sim


def by_mesh_centre(scene: Scene, store: AssetStore) -> Scene:
    """The scene with every position at the turned centre of its mesh's own box."""

    def there(o: SceneObject) -> SceneObject:
        mesh = store.mesh_of(o)
        if mesh is None:
            return o
        shift = np.subtract(to_box_centre(o, mesh.vertices).position, o.position)
        x, y, z = (np.array(o.position) - shift).tolist()
        return replace(o, position=(x, y, z))

    return replace(scene, objects=tuple(there(o) for o in scene.objects))


def written_by_mesh_centre(dataset: MesaTaskDataset, store: AssetStore, out: Path) -> MesaTaskDataset:
    write_annotations(out, dataset.annotations)
    (out / "Assets_library").symlink_to(dataset.root / "Assets_library")
    for scene_id in dataset.scene_ids:
        write_scene(out, by_mesh_centre(dataset.read(scene_id)[0], store))
    return MesaTaskDataset(out)


@pytest.fixture(scope="module")
def leaning(tmp_path_factory: pytest.TempPathFactory) -> MesaTaskDataset:
    """Scenes with things that lean in cups and lie in bowls, where the height above the table says little."""
    out = tmp_path_factory.mktemp("leaning")
    write_world(out, 9, EmbeddedWorld(pictures=False))
    return MesaTaskDataset(out)


@pytest.mark.slow
def test_embedded_scenes_place_box_centres_and_are_told_apart(leaning: MesaTaskDataset, tmp_path: Path) -> None:
    store = AssetStore(leaning)
    assert position_convention(leaning, store) is PositionConvention.BOX_CENTRE
    other = written_by_mesh_centre(leaning, store, tmp_path)
    assert position_convention(other, store) is PositionConvention.MESH_CENTRE  # the meshes are the same


def test_real_scenes_are_told_apart(measured_data: Path, tmp_path: Path) -> None:
    real = MesaTaskDataset(measured_data)
    store = AssetStore(real, max_bytes=2**30)
    assert position_convention(real, store, 16) is PositionConvention.BOX_CENTRE
    other = written_by_mesh_centre(real, store, tmp_path)
    assert position_convention(other, store, 16) is PositionConvention.MESH_CENTRE


@pytest.mark.parametrize(("num_scenes", "looked_at"), [(1, 1), (4, 3), (9, 9), (20, 9)])
def test_so_many_scenes_are_looked_at_at_most(
    leaning: MesaTaskDataset, monkeypatch: pytest.MonkeyPatch, num_scenes: int, looked_at: int
) -> None:
    asked: list[str] = []

    def read(scene_id: str) -> None:
        asked.append(scene_id)
        raise SceneError("not of interest")

    monkeypatch.setattr(leaning, "read", read)
    assert position_convention(leaning, AssetStore(leaning), num_scenes) is PositionConvention.BOX_CENTRE
    assert len(asked) == looked_at
