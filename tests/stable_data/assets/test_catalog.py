"""Catalogues: of a run, of a folder, and what makes none."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.assets.catalog import AssetLibrary, RestingTilt, asset_sentence, library_of_run
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset, write_text_features
from stable_data.mesatask.asset_catalog import SHOWN_RANGE, library_of_folder
from stable_data.scene import UPRIGHT, QuatXyzw, Scene, SceneObject, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from tests.stable_data.assets.bag_of_words import LAID, BagOfWords, thing

BOX = Mesh(Shape.box((1.0, 2.0, 4.0)).vertices, Shape.box((1.0, 2.0, 4.0)).faces)


def leaning(degrees: float) -> QuatXyzw:
    return (math.sin(math.radians(degrees) / 2), 0.0, 0.0, math.cos(math.radians(degrees) / 2))


def row(asset_id: str, **values: object) -> Row:
    blank: Row = dict.fromkeys(SCHEMAS["assets"].names)
    tilts = [{"tilt_quat_xyzw": UPRIGHT, "count": 3}]
    return blank | {"asset_id": asset_id, "description": "a box", "extents": [1.0, 2.0, 4.0], "resting_tilts": tilts} | values


def run_of(root: Path, *rows: Row) -> RunFolder:
    folder = RunFolder(str(root))
    for number, one in enumerate(rows):
        folder.write_shard("assets", f"{number:016x}", [one])
    return folder


def tilts_of(root: Path, extents: tuple[float, float, float], *seen: QuatXyzw) -> list[RestingTilt]:
    """The tilts of an asset of a run that was seen at some, once each."""
    rows = [{"tilt_quat_xyzw": quat, "count": 1} for quat in seen]
    points = np.asarray(np.meshgrid(*([-e / 2, e / 2] for e in extents))).reshape(3, -1).T.ravel()
    return list(library_of_run(run_of(root, row("a", extents=extents, resting_tilts=rows, points=points))).assets[0].tilts)


def folder_of(root: Path, annotations: dict[str, dict[str, object]], glbs: tuple[str, ...] = ()) -> Path:
    (root / "Assets_library").mkdir(parents=True)
    (root / "Asset_annotation.json").write_text(json.dumps(annotations), "utf-8")
    for uid in glbs:
        (root / "Assets_library" / f"{uid}.glb").write_bytes(write_glb(BOX))
    return root


def test_a_run_becomes_a_catalogue_in_the_order_of_its_uids(tmp_path: Path) -> None:
    one = row("b", category="mug", caption="A mug.", licence="CC0", source="gen", on_table=True, mark_deletion=False)
    library = library_of_run(run_of(tmp_path, one, row("a", on_table=False), row("c", is_composite=True)), "mine")
    assert library.name == "mine"
    assert [asset.asset_id for asset in library.assets] == ["a", "b", "c"]
    assert [asset.is_offered for asset in library.assets] == [False, True, False]
    found = library.assets[1]
    assert (found.category, found.description, found.caption, found.licence) == ("mug", "a box", "A mug.", "CC0")
    assert found.tilts == (RestingTilt(UPRIGHT, (1.0, 2.0, 4.0), 3),)


def test_an_asset_without_an_extent_or_a_tilt_is_left_out(tmp_path: Path) -> None:
    """Rows of a damaged run, of which ``stable-data verify`` tells."""
    lost = row("b", extents=None), row("c", extents=[1.0]), row("d", resting_tilts=[{"tilt_quat_xyzw": None, "count": 1}])
    library = library_of_run(run_of(tmp_path, row("a"), *lost))
    assert [asset.asset_id for asset in library.assets] == ["a"]
    assert dict(library.left_out) == dict.fromkeys("bcd", "without extent or resting tilts")


def test_a_run_that_kept_no_flags_offers_what_its_scenes_put_on_a_table(tmp_path: Path) -> None:
    library = library_of_run(run_of(tmp_path, row("seen"), row("table", resting_tilts=[])))
    assert {asset.asset_id: asset.is_offered for asset in library.assets} == {"seen": True, "table": False}
    assert library.assets[1].tilts == (RestingTilt(UPRIGHT, (1.0, 2.0, 4.0), 0),)


def test_tilts_that_are_nearly_one_are_counted_as_the_more_frequent(tmp_path: Path) -> None:
    tilts = [(leaning(90.0), 2), (leaning(91.5), 4), (UPRIGHT, 5), (tuple(-q for q in leaning(3.0)), 1)]
    rows = [{"tilt_quat_xyzw": quat, "count": count} for quat, count in tilts]
    found = library_of_run(run_of(tmp_path, row("a", resting_tilts=rows, points=BOX.vertices.ravel()))).assets[0].tilts
    assert [(tilt.quat_xyzw, tilt.count) for tilt in found] == [(UPRIGHT, 6), (pytest.approx(leaning(91.5)), 6)]


@pytest.mark.parametrize("degrees", [30.0, 77.0, 90.0])
def test_the_box_of_a_leaning_mesh_is_its_own(degrees: float, tmp_path: Path) -> None:
    tilts = [{"tilt_quat_xyzw": leaning(degrees), "count": 1}]
    points = 0.97 * BOX.vertices  # a sample misses the corners
    tilt = library_of_run(run_of(tmp_path, row("a", resting_tilts=tilts, points=points.ravel()))).assets[0].tilts[0]
    exact = np.ptp(Rotation.from_quat(leaning(degrees)).apply(BOX.vertices), axis=0)
    assert tilt.extents == pytest.approx(exact)


def test_features_that_came_with_a_dataset_are_kept_where_they_are(tmp_path: Path) -> None:
    run = run_of(tmp_path, row("a", text_embedding=[0.6, 0.8]), row("b"))
    library = library_of_run(run, own_features=True)
    assert library.features is not None
    assert library.features == pytest.approx(np.array([[0.6, 0.8]]))
    assert library.left_out == {"b": "without a text feature"}
    assert library_of_run(run).features is None


def test_sentence_features_of_a_run_are_read_instead_of_encoded(tmp_path: Path) -> None:
    encoder = BagOfWords()
    sentences = {"b": "mug, a box", "a": "bowl, a box"}
    rows = [
        row(
            uid,
            category=text.split(",")[0],
            sentence_embedding=encoder([text])[0].astype(np.float16),
            sentence_encoder=encoder.fingerprint,
        )
        for uid, text in sentences.items()
    ]
    stored = library_of_run(run_of(tmp_path / "all", *rows))
    fresh = library_of_run(run_of(tmp_path / "none", *(r | {"sentence_embedding": None} for r in rows)))
    assert fresh.features is None
    asked = len(encoder.asked)
    assert stored.embedded(encoder) is stored
    assert len(encoder.asked) == asked
    assert np.abs(np.asarray(stored.features) - np.asarray(fresh.embedded(encoder).features)).max() < 1e-3
    assert stored.embedded(BagOfWords(1)).encoder_fingerprint == BagOfWords(1).fingerprint  # of another encoder: encoded again
    assert library_of_run(run_of(tmp_path / "some", *rows, row("c", category="fork"))).features is None
    odd = rows[0] | {"asset_id": "c", "sentence_embedding": np.ones(5, np.float16)}
    with pytest.raises(
        ConfigError, match="column sentence_embedding has 261 numbers for 3 assets, expected rows of one length"
    ):
        library_of_run(run_of(tmp_path / "odd", *rows, odd))


def test_the_sizes_of_a_run_are_read(tmp_path: Path) -> None:
    rows = [row("exact", size_low=0.2, size_high=0.2), row("free"), row("odd", size_low=0.3, size_high=0.2)]
    library = library_of_run(run_of(tmp_path, *rows))
    assert {a.asset_id: a.size_range for a in library.assets} == {"exact": (0.2, 0.2), "free": None}
    assert library.left_out == {"odd": "with a size range that is not positive and in order"}


def test_some_assets_of_a_library_keep_their_features() -> None:
    library = AssetLibrary("all", (thing("a", "a mug"), thing("b", "a bowl"))).embedded(BagOfWords())
    assert library.features is not None
    assert library.only({"a", "b"}) is library
    few = library.only({"b"})
    assert [a.asset_id for a in few.assets] == ["b"]
    assert np.array_equal(np.asarray(few.features), library.features[1:])


def test_a_folder_becomes_a_catalogue(tmp_path: Path) -> None:
    root = folder_of(
        tmp_path / "set",
        {
            "a": {"category": "mug", "description": "a mug", "bbox": {"x": 1, "y": 4, "z": 2}, "license": "CC-BY-4.0"},
            "b": {"description": "a thing", "onTable": False, "bbox": [1, 1, 1]},
            "c": {"detailed_caption": "A thing without a box."},
            "d": {"detailed_caption": "A thing with a mesh alone.", "is_composite": True},
            "e": {"bbox": [1, 1, 1]},
        },
        ("d",),
    )
    library = library_of_folder(root)
    assert library.name == "set"
    assert [asset.asset_id for asset in library.assets] == ["a", "b", "d"]
    assert library.left_out == {"c": "without an annotated box or a readable mesh", "e": "without words"}
    a, b, d = library.assets
    assert (a.extents, a.licence, a.is_offered) == ((1.0, 2.0, 4.0), "CC-BY-4.0", True)
    assert (b.is_offered, d.is_offered, d.words) == (False, False, "A thing with a mesh alone.")
    assert d.extents == pytest.approx((1.0, 2.0, 4.0))


def test_scenes_show_how_a_folders_assets_rest(tmp_path: Path) -> None:
    root = folder_of(tmp_path, {"a": {"description": "a box", "bbox": {"x": 1, "y": 4, "z": 2}}}, ("a",))
    lean = leaning(30.0)
    objects = tuple(
        SceneObject(f"{k}_box_0", "box", (0.1, 0.1, 0.1), 0.0, (0.1, 0.1, 0.1), "a", tilt_quat_xyzw=quat)
        for k, quat in enumerate([LAID, lean, LAID, UPRIGHT])
    )
    scene = Scene("s", Tabletop("desk", (1.0, 1.0)), objects)
    tilts = library_of_folder(root, scenes=[scene]).assets[0].tilts
    assert [tilt.count for tilt in tilts] == [2, 1, 1]
    boxes = {tilt.quat_xyzw: tilt.extents for tilt in tilts}
    assert boxes[LAID] == pytest.approx((1.0, 4.0, 2.0))
    assert boxes[lean] == pytest.approx(np.ptp(Rotation.from_quat(lean).apply(BOX.vertices), axis=0))


def test_a_folders_assets_keep_to_the_sizes_of_its_scenes_if_asked(tmp_path: Path) -> None:
    box: dict[str, object] = {"description": "a box", "bbox": {"x": 1.0, "y": 4.0, "z": 2.0}}  # y is up there
    root = folder_of(tmp_path / "folder", {"seen": box, "unseen": box, "unscaled": box})
    objects = [
        SceneObject(f"{k}", "box", (0.0, 0.0, 0.0), 0.0, (0.1, 0.1, 0.1), "seen", scale=(scale, scale, scale))
        for k, scale in enumerate((0.05, 0.1))
    ]
    objects.append(SceneObject("2", "box", (0.0, 0.0, 0.0), 0.0, (0.1, 0.1, 0.1), "unscaled"))
    scene = Scene("s", Tabletop("desk", (1.0, 1.0)), tuple(objects))
    found = {a.asset_id: a.size_range for a in library_of_folder(root, scenes=[scene], keeps_sizes=True).assets}
    assert found["seen"] == pytest.approx((0.2 / SHOWN_RANGE, 0.4 * SHOWN_RANGE))
    assert found["unseen"] is None
    assert found["unscaled"] is None
    assert all(a.size_range is None for a in library_of_folder(root, scenes=[scene]).assets)


def test_a_folders_own_features_are_read_without_pickle(tmp_path: Path) -> None:
    root = folder_of(tmp_path, {uid: {"description": uid, "bbox": [1, 1, 1]} for uid in "abc"})
    write_text_features(root / "sbert_text_features.pkl", ["c", "a"], np.eye(2))
    library = library_of_folder(root, own_features=True)
    assert [asset.asset_id for asset in library.assets] == ["a", "c"]
    assert library.features is not None
    assert np.array_equal(library.features, np.eye(2)[::-1])
    assert (library.encoder_fingerprint, library.names_category) == ("", False)


def test_embedding_names_the_category_and_keeps_the_encoder(tmp_path: Path) -> None:
    encoder = BagOfWords()
    library = AssetLibrary("mine", (thing("a", "a slim one", category="water_bottle"),)).embedded(encoder, tmp_path / "rows")
    assert encoder.asked == ["water bottle, a slim one"] == [asset_sentence("a slim one", "water_bottle")]
    assert library.encoder_fingerprint == encoder.fingerprint
    assert asset_sentence(" ", "") == ""


def test_a_library_without_assets_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="library mine: no assets") as caught:
        AssetLibrary("mine", ())
    assert caught.value.code == "library_empty"
    with pytest.raises(ConfigError, match="library set: 2 without words, expected"):
        library_of_folder(folder_of(tmp_path / "set", {uid: {"bbox": [1, 1, 1]} for uid in "ab"}))
    with pytest.raises(ConfigError, match="is not a folder"):
        library_of_folder(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="no table assets"):
        library_of_run(RunFolder(str(tmp_path)))


def test_two_assets_of_one_uid_are_refused() -> None:
    with pytest.raises(ConfigError, match="asset a is listed twice"):
        AssetLibrary("mine", (thing("a", "a mug"), thing("a", "a bowl")))


def test_features_of_another_number_of_assets_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"library mine: features have shape \(2, 2\)"):
        AssetLibrary("mine", (thing("a", "a mug"),), np.eye(2, dtype=np.float32))


def test_a_real_folder_is_a_library(real_data: Path) -> None:
    dataset = MesaTaskDataset(real_data)
    scenes = [dataset.read(scene_id)[0] for scene_id in dataset.scene_ids]
    library = library_of_folder(dataset.root, scenes=scenes)
    assert len(library) + len(library.left_out) == len(dataset.asset_ids)
    filtered = [a for a in dataset.annotations.values() if a.mark_deletion or a.is_composite or not a.on_table]
    assert sum(not asset.is_offered for asset in library.assets) == len(filtered) > 0
    for asset in library.assets:
        for tilt in asset.tilts:
            assert 0 < max(tilt.extents) <= math.hypot(*asset.extents) * 1.001
    assert any(tilt.quat_xyzw != UPRIGHT for asset in library.assets for tilt in asset.tilts)


@pytest.mark.parametrize(
    ("extents", "lying"),
    [((0.1, 0.2, 2.0), leaning(90.0)), ((0.1, 2.0, 0.2), UPRIGHT), ((2.0, 0.1, 0.2), UPRIGHT)],
)
def test_what_is_long_and_was_only_seen_lying_may_lean(
    tmp_path: Path, extents: tuple[float, float, float], lying: QuatXyzw
) -> None:
    first, *others = tilts_of(tmp_path, extents, lying)
    assert (first.quat_xyzw, first.count) == (lying, 1)
    assert [tilt.count for tilt in others] == [0] * len(others)
    assert len(others) > 3
    axis = np.eye(3)[int(np.argmax(extents))]
    heights = [float((Rotation.from_quat(tilt.quat_xyzw).apply(axis))[2]) for tilt in others]
    assert heights == sorted(heights, reverse=True)  # the steepest first
    assert all(0.2 < height < 1 for height in heights)
    for tilt in others:
        assert tilt.extents == pytest.approx(np.abs(Rotation.from_quat(tilt.quat_xyzw).as_matrix()) @ extents)


def test_what_stands_or_is_short_or_was_seen_to_lean_gets_no_tilt_more(tmp_path: Path) -> None:
    long = (0.1, 0.2, 2.0)
    assert len(tilts_of(tmp_path / "stands", long, UPRIGHT)) == 1
    assert len(tilts_of(tmp_path / "leans", long, leaning(90.0), leaning(20.0))) == 2
    assert len(tilts_of(tmp_path / "short", (1.0, 1.0, 2.0), leaning(90.0))) == 1
    assert len(tilts_of(tmp_path / "unknown", long)) == 1
