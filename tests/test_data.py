"""The small dataset of the tests: every mesh is attributed and free, the folder is small, and its kinds of shapes are there."""

import json
import re
from pathlib import Path

import pytest

from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.mesh_colors import load_paint
from stable_data.mesatask import MesaTaskDataset

FREE = {"CC0-1.0", "CC-BY-4.0"}
MAX_BYTES = 6_000_000
TEXTURED = ("tomato", "menu_card", "chopped_lettuce")


@pytest.fixture(scope="module")
def dataset(real_data: Path) -> MesaTaskDataset:
    return MesaTaskDataset(real_data)


def test_every_asset_is_attributed_under_a_free_licence(dataset: MesaTaskDataset) -> None:
    text = (dataset.root / "LICENSES.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\S+)` +\| (.+?) +\| (\S+) +\| (\S+) +\|$", text, re.MULTILINE)
    licences = {asset_id: licence for asset_id, _, _, licence in rows}
    files = {path.stem for path in (dataset.root / "Assets_library").iterdir()}
    assert len(rows) == len(licences)
    assert set(licences) == files
    assert set(licences.values()) <= FREE
    for asset_id, annotation in dataset.annotations.items():
        assert annotation.licence == licences[asset_id]
    for source in {source for _, _, source, _ in rows}:
        assert f"**{source}** — " in text


def test_the_folder_is_small_and_holds_nothing_else(real_data: Path) -> None:
    files = [path for path in real_data.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < MAX_BYTES
    files = [path for path in files if "fuzz" not in path.relative_to(real_data).parts]  # of any form, most of them broken
    sources = [path for path in files if "import" in path.parts]  # as their authors ship them
    assert {path.suffix for path in files if path not in sources} == {".glb", ".json", ".md", ".parquet", ".png"}
    text = (real_data / "LICENSES.md").read_text("utf-8")
    for name in {path.relative_to(real_data).parts[1] for path in sources}:
        assert f"`{name}`" in text


def test_scenes_use_the_meshes_and_have_their_truth(dataset: MesaTaskDataset) -> None:
    truth = json.loads((dataset.root / "truth.json").read_bytes())
    assert set(truth) == set(dataset.scene_ids)
    for scene_id in dataset.scene_ids:
        scene, notices = dataset.read(scene_id)
        assert not notices
        assert [o.instance for o in scene.objects] == list(truth[scene_id]["objects"])
        assert truth[scene_id]["clean"] == (not truth[scene_id]["defects"])
    kinds = {defect["kind"] for scene in truth.values() for defect in scene["defects"]}
    assert kinds == {"interpenetrate", "float", "sink", "outside_zone", "in_restricted_zone"}
    relations = {o["relation"] for scene in truth.values() for o in scene["objects"].values()}
    assert relations == {"on", "in", "table"}


@pytest.mark.parametrize("category", TEXTURED)
def test_textures_give_colours(dataset: MesaTaskDataset, category: str) -> None:
    asset_id = next(uid for uid, note in dataset.annotations.items() if note.category == category)
    path = dataset.asset_path(asset_id)
    assert path is not None
    mesh = load_glb(path, asset_id)[0]
    paint = load_paint(path, asset_id, mesh)
    assert len(paint) > 1
    assert sorted(face for _, faces in paint for face in faces.tolist()) == list(range(len(mesh.faces)))
