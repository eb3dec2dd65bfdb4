"""Annotations in every spelling, asset files that never lead elsewhere, categories."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stable_data.errors import ConfigError
from stable_data.mesatask import (
    AssetAnnotation,
    AssetFolder,
    MesaTaskDataset,
    category_of,
    read_annotation,
    write_annotation,
    write_asset,
)
from tests.stable_data.mesatask.layouts import UID, make_dataset


def test_an_asset_is_never_looked_for_outside_of_the_library(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    library = tmp_path / "Assets_library"
    (tmp_path / "secret.glb").write_bytes(b"")
    (library / "link.glb").symlink_to(tmp_path / "secret.glb")
    (library / "mug_red.glb").write_bytes(b"")
    variant = UID.replace("0a", "1b")
    (library / f"{variant}_x_90_y_0.glb").write_bytes(b"")
    dataset = MesaTaskDataset(tmp_path)
    for asset_id in ("../secret", "link", str(tmp_path / "secret"), "", ".", "..", "mug", "x\0", "a" * 500):
        assert dataset.asset_path(asset_id) is None
    assert dataset.asset_path(UID) == dataset.asset_path(f"{UID}_x_-90_y_180") == library / f"{UID}.glb"
    assert dataset.asset_path(variant) == library / f"{variant}_x_90_y_0.glb"
    assert dataset.annotation(f"{UID}_x_90_y_0").category == "Desk-Lamp"
    assert dataset.annotation("mug_red") == AssetAnnotation("mug_red")
    with pytest.raises(KeyError):
        dataset.annotation("nobody")
    for asset_id in ("../x", "", "a/b"):
        with pytest.raises(ConfigError, match="cannot name a file"):
            write_asset(tmp_path, asset_id, b"")


def test_a_link_out_of_the_library_is_refused_and_the_others_are_listed(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    library = tmp_path / "Assets_library"
    sound = (library / f"{UID}.glb").read_bytes()
    (tmp_path / "secret.glb").write_bytes(sound)
    (library / "secret.glb").symlink_to(tmp_path / "secret.glb")
    (library / "nowhere.glb").symlink_to(tmp_path / "nowhere.glb")
    (library / "loop.glb").symlink_to("loop.glb")
    (library / "folder.glb").mkdir()
    (library / "within.glb").symlink_to(f"{UID}.glb")
    folder = AssetFolder(tmp_path)
    assert folder.asset_ids == (UID, "within")
    assert [(n.code, n.message.split(" ")[3]) for n in folder.notices] == [
        ("glb_refused", f"'{name}.glb',") for name in ("folder", "loop", "nowhere", "secret")
    ]
    assert "secret" not in folder
    assert [folder.annotation(asset_id).asset_id for asset_id in folder.asset_ids] == [UID, "within"]
    (library / "within.glb").unlink()
    assert folder.annotation("within") == AssetAnnotation("within")


def test_the_library_itself_may_lie_elsewhere(tmp_path: Path) -> None:
    make_dataset(tmp_path / "a")
    (tmp_path / "a" / "Assets_library").rename(tmp_path / "elsewhere")
    (tmp_path / "a" / "Assets_library").symlink_to(tmp_path / "elsewhere")
    assert MesaTaskDataset(tmp_path / "a").asset_path(UID) is not None


@pytest.mark.parametrize(
    "box",
    [
        {"bbox": {"x": 1.0, "y": 2.0, "z": 3.0}},
        {"bbox": {"size": {"x": 1.0, "y": 2.0, "z": 3.0}}},
        {"bbox": {"min": {"x": 1.0, "y": 1.0, "z": 1.0}, "max": {"x": 2.0, "y": 3.0, "z": 4.0}}},
        {"bbox": {"min": [0, 0, 0], "max": [1.0, 2.0, 3.0]}},
        {"min_point": [0, 0, 0], "max_point": [1.0, 2.0, 3.0]},
    ],
)
@pytest.mark.parametrize("key", ["isContainer", "is_container", "is-container", "IsContainer"])
def test_annotations_are_read_in_every_spelling(box: dict[str, Any], key: str) -> None:
    raw = {**box, key: True, "category": "cup", "mass": "0.2 kg", "frontView": 3, "onTable": False}
    annotation = read_annotation(UID, raw)
    assert annotation.extents_z_up == (1.0, 3.0, 2.0)
    assert (annotation.is_container, annotation.mass, annotation.on_table, annotation.mark_deletion) == (
        True,
        0.2,
        False,
        False,
    )
    assert write_annotation(annotation) == raw
    changed = replace(annotation, category="mug", is_container=False)
    written = write_annotation(changed)
    assert written["frontView"] == 3
    assert read_annotation(UID, written) == changed


@pytest.mark.parametrize(
    "raw", [{}, {"bbox": 5, "mass": -1, "category": None, "isContainer": "?"}, {"bbox": {"x": math.nan, "y": 1, "z": 1}}]
)
def test_annotations_without_sense_get_defaults(raw: dict[str, Any]) -> None:
    assert read_annotation(UID, raw) == AssetAnnotation(UID)


@pytest.mark.parametrize(
    "mass", ["1" + " " * 200_000 + "x", " " * 200_000 + "x", "1" * 200_000 + "x", "1.1" + "1" * 200_000 + "x"]
)
def test_a_long_number_is_read_in_linear_time(mass: str) -> None:
    start = time.process_time()
    assert read_annotation(UID, {"mass": mass}).mass is None
    assert time.process_time() - start < 1  # a quadratic search takes minutes


@pytest.mark.parametrize("mass", ["0.2", "0.2kg", " 0.2\tkg ", "\n0.2 "])
def test_a_mass_may_have_a_unit_and_spaces(mass: str) -> None:
    assert read_annotation(UID, {"mass": mass}).mass == 0.2


@pytest.mark.parametrize(
    ("instance", "category"),
    [
        ("2_desk_lamp_0", "desk_lamp"),
        ("12_paper##clip_3", "paperclip"),
        ("3_##er_clip_0", "er_clip"),
        ("1_Coffee-Cup_0", "coffee_cup"),
        ("pen_0", "pen"),
        ("pen", "pen"),
        ("1_##_0", "object"),
        ("1_cup_0.001", "cup"),
    ],
)
def test_categories_are_cleaned(instance: str, category: str) -> None:
    assert category_of(instance) == category


def test_annotations_of_very_many_values_are_refused_unread(tmp_path: Path) -> None:
    """Each ``{},`` would take twenty times its bytes."""
    (tmp_path / "Asset_annotation.json").write_bytes(b'{"a": [' + b"{}," * 3_000_000 + b"{}]}")
    start = time.process_time()
    with pytest.raises(
        ConfigError, match=r"Asset_annotation.json has more brackets and commas, expected at most 4,194,304"
    ) as caught:
        AssetFolder(tmp_path)
    assert caught.value.code == "json_too_big"
    assert time.process_time() - start < 1
    (tmp_path / "Asset_annotation.json").write_bytes(b'{"a": ' + b"[" * 10**6 + b"]" * 10**6 + b"}")
    with pytest.raises(ConfigError, match="nests deeper, expected at most 64 levels"):
        AssetFolder(tmp_path)


def test_an_asset_annotated_twice_keeps_the_first_and_is_noticed(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    path = tmp_path / "Asset_annotation.json"
    path.write_text('{"a": {"category": "mug"}, "b": {}, "a": {"category": "cup"}}')
    dataset = MesaTaskDataset(tmp_path)
    assert dataset.annotation("a").category == "mug"
    (notice,) = dataset.notices
    assert notice.code == "annotation_duplicate"
    assert "gives key 'a' twice" in notice.message
    path.write_text('{"a": {}, "b": {}, "a": {}, "b": {}}')
    assert "'a' and 1 more keys twice" in MesaTaskDataset(tmp_path).notices[0].message
