"""The audit and the slow reference beside the checkout agree on every pair and object, but for what is explained here.

The reference runs in a process of its own. It says whether an object meets anything when lowered, which is less than to be
carried, and it knows depths by eight levels.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from stable_data.assets.store import AssetStore
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import BOUNDS_SLACK, PosedScene, audit_posed_scene

TOLERANCES = (5e-4, 1e-3, 3e-3)
Difference = tuple[str, str, str, float]
"""Scene, verdict, object or pair, tolerance in metres."""

# Objects that touch nothing but what lies on them or beside them: the faces that they meet do not look up.
_NOT_CARRIED = {
    ("bathroom_vanity_0399", "12_toy_brick_1"): (5e-4,),
    ("bathroom_vanity_1105", "3_toy_airplane_0"): (5e-4,),
    ("bathroom_vanity_1258", "4_sponge_0"): (5e-4, 1e-3),
    ("coffee_table_1774", "2_toy_brick_0"): (5e-4, 1e-3),
    ("coffee_table_1978", "6_orange_0"): (5e-4, 1e-3, 3e-3),
    ("dining_table_1969", "5_fork_0"): (5e-4, 1e-3, 3e-3),
    ("dressing_table_0534", "3_dice_0"): (5e-4, 1e-3),
    ("dressing_table_0906", "17_toy_brick_4"): (5e-4,),
    ("dressing_table_0988", "6_marble_1"): (5e-4, 1e-3),
    ("dressing_table_0988", "8_toy_brick_3"): (5e-4,),
    ("dressing_table_1079", "9_toy_airplane_1"): (5e-4, 1e-3),
    ("kitchen_counter_0504", "1_knife_0"): (1e-3,),
    ("kitchen_counter_1193", "11_gelatin_box_2"): (5e-4,),
    ("kitchen_counter_1830", "2_bun_bottom_0"): (5e-4, 1e-3, 3e-3),
    ("office_table_2022", "12_toy_brick_1"): (5e-4, 1e-3),
}
EXPLAINED: set[Difference] = {
    *((scene, "floats", name, tolerance) for (scene, name), tolerances in _NOT_CARRIED.items() for tolerance in tolerances),
    # 2.24 mm deep: the reference has no level between 2 and 5 mm.
    ("dining_table_1187", "collides", "14_pudding_box_2 5_gelatin_box_0", 3e-3),
}

FEW = ("coffee_table_1978", "dining_table_1187", "kitchen_counter_0504", "office_table_0036")

_REFERENCE = """
import json, pathlib, sys
from scipy.spatial.transform import Rotation
import geometry as judge

tolerances, found = json.loads(sys.argv[1]), {}
for path in map(pathlib.Path, sys.argv[2:]):
    layout = json.loads(path.read_text())
    geometries, poses = [], []
    for item in layout["objects"]:
        yaw = item["z_rotation"]
        tilt = Rotation.from_euler("z", -yaw) * Rotation.from_quat(item["rotation"])
        geometries.append(judge.geometry(item["selected_uid"], item["scale_factor"], tilt.as_quat()))
        poses.append([*(x / 100 for x in item["position"]), yaw])
    scene, name, zone = judge.Scene(geometries, poses), [o["instance"] for o in layout["objects"]], layout["item_placement_zone"]
    depths = [[sorted((name[i], name[j])), depth] for (i, j), depth in scene.penetrations().items()]
    verdicts = [("leaves", name[i], 0.0) for i in scene.outside((zone[1] / 100, zone[3] / 100))]
    for t in tolerances:
        verdicts += [("collides", " ".join(pair), t) for pair, depth in depths if depth > t]
        verdicts += [("floats", name[i], t) for i in scene.floating(t)]
        verdicts += [("sinks", name[i], t) for i in range(len(scene)) if scene.low[i, 2] < -t]
    found[path.parent.name] = verdicts
    judge._geometry.cache_clear()
print(json.dumps(found))
"""


def reference(dataset: MesaTaskDataset, scene_ids: tuple[str, ...]) -> set[Difference]:
    """What the reference finds wrong, in a process of its own."""
    folder = dataset.root.parents[1] / "judge"
    if not folder.is_dir():
        pytest.skip("the reference beside the checkout (../shared/judge) is absent")
    paths = [str(dataset.layout_path(scene_id)) for scene_id in scene_ids]
    env = os.environ | {"JUDGE_DATA": str(dataset.root), "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", _REFERENCE, json.dumps(TOLERANCES), *paths]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    found: dict[str, list[Any]] = json.loads(done.stdout)
    return {(scene_id, what, who, tolerance) for scene_id, verdicts in found.items() for what, who, tolerance in verdicts}


def ours(dataset: MesaTaskDataset, scene_ids: tuple[str, ...]) -> set[Difference]:
    """What the audit finds wrong."""
    store = AssetStore(dataset)
    found: set[Difference] = set()
    for scene_id in scene_ids:
        scene, _ = dataset.read(scene_id)
        posed = PosedScene(scene, store.shapes(scene)[0])
        audit = audit_posed_scene(posed)
        found |= {(scene_id, "leaves", o.instance, 0.0) for o in audit.objects if o.leaves_table}
        for t in TOLERANCES:
            pairs = [(sorted((p.first, p.second)), p.penetration) for p in audit.pairs]
            found |= {(scene_id, "collides", " ".join(pair), t) for pair, depth in pairs if depth is not None and depth > t}
            found |= {
                (scene_id, "floats", name, t) for index, name in enumerate(posed.instances) if posed.supports(index, t) == ()
            }
            found |= {(scene_id, "sinks", o.instance, t) for o in audit.objects if o.table_penetration > t}
    return found


@pytest.mark.parametrize("how_many", [pytest.param(FEW, id="few"), pytest.param((), id="all", marks=pytest.mark.slow)])
def test_the_audit_differs_from_the_reference_only_where_it_is_explained(shared_data: Path, how_many: tuple[str, ...]) -> None:
    dataset = MesaTaskDataset(shared_data / "mesa_real")
    scene_ids = how_many or dataset.scene_ids
    assert BOUNDS_SLACK == 1e-3  # the reference's own
    expected = {difference for difference in EXPLAINED if difference[0] in scene_ids}
    assert ours(dataset, scene_ids) ^ reference(dataset, scene_ids) == expected
