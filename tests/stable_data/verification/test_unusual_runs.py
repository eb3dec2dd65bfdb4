"""Sound runs of preprocess of unusual assets and scenes are whole: flat meshes, very many tilts, scenes that fail at different steps."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.mesatask import AssetAnnotation, write_annotations, write_asset, write_scene
from stable_data.rotations import tilt_key
from stable_data.scene import Relation, Scene, SceneObject, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.findings import Finding
from stable_data.verification.verifier import VerifyOptions, verify_run
from tests.pipelines.runs import SMALL
from tests.scenes import box, sheet
from tests.stable_data.verification.damages import rescaled
from tests.stable_data.verification.editing import rows

SCALE = (1.0, 0.8, 0.6)
NUM_TILTS = 10  # more than the job keeps
LOST = ("office_table_0001", "office_table_0019")
"""Scenes for which the model that writes tasks gives none."""


def write_task(scene: Scene, _: Sequence[Relation]) -> TaskInfo:
    """Writes the task of a scene, or fails."""
    if scene.scene_id in LOST:
        raise RuntimeError("the model is down")
    return TaskInfo("An office.", "Tidy up.", task_objects=(scene.objects[0].instance,))


def quaternion(number: int, shift: float) -> tuple[float, float, float, float]:
    """One of some tilts; those of one number and of small shifts are rounded to the same key."""
    x, y, z, w = (Rotation.from_euler("y", 0.11 + 0.1 * number) * Rotation.from_euler("x", 0.2 + shift)).as_quat().tolist()
    return x, y, z, w


@pytest.fixture(scope="module")
def unusual(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset in which each of ten tilts is used twice, and a sheet without thickness; one scene cannot be read."""
    root = tmp_path_factory.mktemp("unusual") / "data"
    block = box(0.1, 0.1, 0.1)
    write_annotations(root, {name: AssetAnnotation(name, "thing", caption="A thing.") for name in ("block", "sheet")})
    for name, shape in (("block", block), ("sheet", sheet(0.2, 0.3))):
        write_asset(root, name, write_glb(Mesh(shape.vertices, shape.faces)))
    mat = SceneObject("2_mat_0", "mat", (0.3, 0.3, 0.0), 0.0, (0.2, 0.3, 0.0), "sheet", (1.0, 1.0, 1.0))
    for number in range(2 * NUM_TILTS):
        # The first of two nearly equal tilts, by which those of equal counts are ordered, is another one in each order of the scenes.
        shift = 2e-4 * (-1) ** (number % NUM_TILTS + number // NUM_TILTS)
        tilt = quaternion(number % NUM_TILTS, shift)
        assert tilt_key(tilt) == tilt_key(quaternion(number % NUM_TILTS, -shift))
        turned = (block.vertices * SCALE) @ Rotation.from_quat(tilt).as_matrix().T
        x, y, z = np.ptp(turned, axis=0).tolist()
        o = SceneObject("1_thing_0", "thing", (0.7, 0.3, z / 2), 0.0, (x, y, z), "block", SCALE, tilt)
        write_scene(root, Scene(f"office_table_{number:04}", Tabletop("office_table", (1.2, 0.66)), (o, mat)))
    broken = root / "Layout_info" / "office_table" / "office_table_9999"
    broken.mkdir()
    (broken / "layout.json").write_text("{")
    return root


@pytest.mark.parametrize("writer", ["", pytest.param(f"{__name__}:write_task", marks=pytest.mark.slow)])
def test_a_sound_run_of_unusual_scenes_is_whole(writer: str, unusual: Path, tmp_path: Path) -> None:
    settings = replace(SMALL, features="auto", scenes_per_shard=1, task_writer=writer, task_cache=str(tmp_path / "cache"))
    counts = preprocess(str(unusual), str(tmp_path / "run"), settings, WorkerPool())
    run, found = RunFolder(str(tmp_path / "run")), list[Finding]()
    assert run.num_rows("scenes") == 2 * NUM_TILTS - (len(LOST) if writer else 0), counts
    assert min(row["log_extents"][2] for row in run.table("features").to_pylist()) == pytest.approx(math.log(1e-4))
    result = verify_run(run, found.append, VerifyOptions(sample=3, verdicts="audit"))
    assert (result.is_whole, found) == (True, []), list(map(str, found))
    rows("assets", rescaled)(tmp_path / "run")
    verify_run(run, found.append, VerifyOptions(verdicts="none"))
    # How a scene used an asset is known if it was read, and if it cannot be read by the job either.
    assert any("the median of its scales" in each.what for each in found) is (not writer)
