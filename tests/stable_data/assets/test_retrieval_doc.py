"""docs/retrieval.md: its example runs as it is written."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS

DOC = Path(__file__).resolve().parents[3] / "docs" / "retrieval.md"


def test_the_example_finds_assets_for_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tilts = [{"tilt_quat_xyzw": [0.0, 0.0, 0.0, 1.0], "count": 1}]
    row = {"asset_id": "plate", "category": "plate", "description": "a white dinner plate", "extents": [2, 2, 0.2]}
    RunFolder("run").write_shard("assets", "0", [dict.fromkeys(SCHEMAS["assets"].names) | row | {"resting_tilts": tilts}])
    Path("data").mkdir()
    mug = {"category": "mug", "description": "a red mug with a handle", "bbox": {"x": 1.2, "y": 1.5, "z": 1.0}}
    Path("data/Asset_annotation.json").write_text(json.dumps({"mug": mug}), "utf-8")
    objects = (
        SceneObject("0_plate_0", "plate", (0.3, 0.3, 0.01), 0.0, (0.2, 0.2, 0.02), description="a plate", support="table"),
        SceneObject(
            "1_cup_0", "cup", (0.3, 0.3, 0.07), 0.0, (0.1, 0.1, 0.1), description="a red coffee mug", support="0_plate_0"
        ),
        SceneObject("2_elephant_0", "elephant", (0.6, 0.3, 0.1), 0.0, (0.2, 0.2, 0.2), description="a live elephant"),
    )
    names: dict[str, Any] = {"RUN": "run", "DATASET": "data", "scene": Scene("s", Tabletop("desk", (1.0, 1.0)), objects)}
    example = re.search(r"```python\n(.*?)```", DOC.read_text("utf-8"), re.DOTALL)
    assert example
    exec(example[1], names)  # noqa: S102 - our own page
    assert {name: match.library for name, match in names["found"].items()} == {"0_plate_0": "usual", "1_cup_0": "unseen"}
    (reason,) = names["missing"]
    assert "no asset is similar to 'elephant, a live elephant'" in reason
    plate, cup, elephant = names["objects"]
    assert (plate.asset_id, cup.asset_id, elephant.asset_id) == ("plate", "mug", None)
    assert cup.position[2] - cup.size[2] / 2 == pytest.approx(plate.position[2] + plate.size[2] / 2)
    assert Path("usual.parquet").is_file()
