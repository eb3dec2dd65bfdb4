"""What a run knows its libraries by: words, boxes and the meshes themselves."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.preprocess.asset import AssetUse
from pipelines.preprocess.plan import file_digest
from pipelines.sources import assets
from pipelines.sources.asset_copies import CopyAssets
from pipelines.sources.assets import REAL, AssetLibraries, absolute_places
from pipelines.sources.generation_tasks import TaskSource
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.errors import ConfigError
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.scene import UPRIGHT, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from tests.pipelines.runs import content
from tests.pipelines.scripts import one_thing_a_stage

ALONE = WorkerPool()
USE_COLUMNS = {"typical_scale", "resting_tilts", "volume", "center_of_mass", "inertia_per_mass"}
DESK = Tabletop("office_table", (1.2, 0.6))
TASKS = TaskSource("tasks", [LayoutTask(f"task_{n}", f"Lift it {n} times.", DESK) for n in range(2)])


def fingerprint(*places: Path | str) -> str:
    """Of the first library of new shelves."""
    return next(iter(AssetLibraries([str(place) for place in places]).fingerprints.values()))


@pytest.fixture
def library(tiny: Path, tmp_path: Path) -> Path:
    """A library of its own, many of whose assets have no mesh."""
    return Path(shutil.copytree(tiny, tmp_path / "library"))


def changed(library: Path, dataset: Path, change: str) -> None:
    """Changes the meshes of a library and nothing else."""
    there, absent = (
        sorted(
            p.name
            for p in (dataset / "Assets_library").glob("*.glb")
            if (library / "Assets_library" / p.name).exists() is is_there
        )
        for is_there in (True, False)
    )
    first = library / "Assets_library" / there[0]
    if change == "replaced":
        shutil.copy(library / "Assets_library" / there[1], first)
    elif change == "one byte":
        data = bytearray(first.read_bytes())
        data[len(data) // 2] ^= 1
        first.write_bytes(data)
    elif change == "added":
        shutil.copy(dataset / "Assets_library" / absent[0], library / "Assets_library")
    else:
        first.unlink()


@pytest.mark.parametrize("change", ["replaced", "one byte", "added", "removed"])
def test_another_mesh_is_another_library(library: Path, dataset: Path, change: str) -> None:
    before = fingerprint(library)
    assert fingerprint(library) == before
    changed(library, dataset, change)
    assert fingerprint(library) != before


def test_the_same_library_in_another_place_at_another_time_is_the_same(library: Path, tmp_path: Path) -> None:
    other = tmp_path / "elsewhere" / "library"
    shutil.copytree(library, other, copy_function=shutil.copyfile)
    assert fingerprint(other) == fingerprint(library)


def test_files_are_read_once_and_only_by_who_asks(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def digest(path: Path) -> str:
        read.append(path)
        return file_digest(path)

    monkeypatch.setattr(assets, "file_digest", digest)
    shelf = AssetLibraries([str(library)])
    assert not read  # no worker needs it
    assert shelf.fingerprints == shelf.fingerprints
    assert sorted(read) == sorted((library / "Assets_library").glob("*.glb"))


def test_another_mesh_or_other_parts_in_a_run_are_another_library(tiny_run: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(tiny_run, tmp_path / "library"))
    run, before = RunFolder(str(out)), fingerprint(out)
    (shard,) = run.shard_ids("meshes")
    rows = run.table("meshes").to_pylist()
    found = {before}
    for change in ({"sha256": "0" * 64}, {"parts_overfill_max": 0.5}):
        run.write_shard("meshes", shard, [rows[0] | change, *rows[1:]])
        found.add(fingerprint(out))
    run.write_shard("meshes", shard, rows[1:])
    found.add(fingerprint(out))
    assert len(found) == 4
    run.write_shard("meshes", shard, rows)
    assert fingerprint(out) == before


def test_the_embedded_library_is_known_by_what_made_it(library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = Path(shutil.copytree(library, tmp_path / "embedded-other"))
    monkeypatch.setattr(assets, "file_digest", None)  # nothing is read
    found = set()
    for root in (library, other, other):
        made = root, library_of_folder(root, EMBEDDED)
        monkeypatch.setattr(assets, "embedded_library", lambda _, made=made: made)
        found.add(fingerprint(EMBEDDED))
    assert len(found) == 2


@pytest.mark.parametrize("change", ["replaced", "added"])
def test_a_run_does_not_go_on_with_other_meshes(library: Path, dataset: Path, tmp_path: Path, change: str) -> None:
    engine = one_thing_a_stage(AssetLibraries([str(library)]).libraries[0].assets[:3])
    script = tmp_path / "script.json"
    script.write_text(json.dumps(engine))
    plain = GenerateSettings(weights="none", scenes_per_shard=1, num_pictures=0, accept="", settle=False)
    settings = replace(plain, engine=EngineSettings(f"scripted:{script}"))
    out = tmp_path / "out"
    generate(TASKS, str(out), settings, ALONE, [str(library)], report=False)
    before = content(out)
    changed(library, dataset, change)
    with pytest.raises(ConfigError, match=r"inputs\.assets\.library: \w+ -> \w+\); choose a new folder") as caught:
        generate(TASKS, str(out), settings, ALONE, [str(library)], report=False)
    assert caught.value.code == "config_changed"
    assert content(out) == before


@pytest.mark.parametrize("lacks", ["", "points", "parts"])
def test_rows_of_a_run_are_copied_and_what_they_lack_is_computed(tiny_run: Path, tmp_path: Path, lacks: str) -> None:
    library = Path(shutil.copytree(tiny_run, tmp_path / "library"))
    run = RunFolder(str(library))
    (shard,) = run.shard_ids("assets")
    kept = {"mass": 0.123, "caption": "Nobody computes this.", "text_embedding": [0.6, 0.8]}
    whole = run.table("assets").to_pylist()
    run.write_shard("assets", shard, [row | kept | ({"points": None} if lacks == "points" else {}) for row in whole])
    if lacks == "parts":
        (parts,) = run.shard_ids("meshes")
        run.write_shard(
            "meshes", parts, [row | {"parts": None, "parts_method": None} for row in run.table("meshes").to_pylist()]
        )
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(library)]).libraries[0].assets[:3])))
    plain = GenerateSettings(weights="none", num_pictures=0, accept="", settle=False)
    settings = replace(plain, engine=EngineSettings(f"scripted:{script}"))
    generate(TASKS, str(tmp_path / "out"), settings, ALONE, [str(library)], report=False)
    made = RunFolder(str(tmp_path / "out"))
    of_library = {row["asset_id"]: row for row in run.table("assets").to_pylist()}
    copies = made.table("assets").to_pylist()
    assert len(copies) == 3
    for copy in copies:
        assert copy["points"]
        row = of_library[copy["asset_id"]]
        changed_columns = {name for name in row if row[name] != copy[name]}
        if lacks == "points":
            assert "points" in changed_columns
        else:
            assert changed_columns <= {*USE_COLUMNS, "text_embedding"}
    of_library = {row["asset_id"]: row for row in run.table("meshes").to_pylist()}
    for copy in made.table("meshes").to_pylist():
        assert copy["parts"]
        assert (copy == of_library[copy["asset_id"]]) is (lacks != "parts")
    assert all(copy["typical_scale"] is not None and copy["volume"] > 0 for copy in made.table("assets").to_pylist())


@pytest.fixture
def weighed(tiny_run: Path, tmp_path: Path) -> Path:
    """A library whose assets are weighed at scales at which no scene uses them."""
    library = Path(shutil.copytree(tiny_run, tmp_path / "library"))
    return weigh(library, mass=0.123)


def weigh(library: Path, **columns: object) -> Path:
    tensor = [2e-4, 1e-5, 0, 1e-5, 3e-4, -1e-5, 0, -1e-5, 2.5e-4]
    known: Row = {"mass_source": "given", "typical_scale": [0.11, 0.13, 0.17], "center_of_mass": [0.001, 0.002, -0.01]}
    known |= {"inertia": tensor, "friction": [0.4, 0.005, 0.0001], "volume": 1e-4} | columns
    run = RunFolder(str(library))
    (shard,) = run.shard_ids("assets")
    run.write_shard("assets", shard, [row | known for row in run.table("assets").to_pylist()])
    return library


def test_what_is_known_of_an_asset_is_copied_with_the_scale_at_which_it_holds(weighed: Path, tmp_path: Path) -> None:
    """So that its mass in a scene is the same from the library and from the run that has the scene, to the last bit."""
    shelf = AssetLibraries([str(weighed)])
    asset = shelf.libraries[0].assets[0]
    use = AssetUse(asset.asset_id, "", (0.3, 0.3, 0.3), (), ((UPRIGHT, 2),))
    rows = CopyAssets((str(weighed),), "", 60.0).item_rows(use, ItemProgress("assets"))
    run = RunFolder(str(tmp_path / "copy"))
    for table in ("assets", "meshes"):
        run.write_shard(table, "0" * 16, rows[table])
    (copy,) = run.table("assets").to_pylist()
    (row,) = (row for row in RunFolder(str(weighed)).table("assets").to_pylist() if row["asset_id"] == asset.asset_id)
    assert {name for name in row if row[name] != copy[name]} <= {"resting_tilts", "text_embedding"}
    assert copy["resting_tilts"] == [{"tilt_quat_xyzw": list(UPRIGHT), "count": 2}]
    one, other = (store.physics(asset.asset_id) for store in (AssetStore(shelf), run_store(run.uri)))
    assert one is not None
    assert other is not None
    assert (str(one.at((0.3, 0.2, 0.1))), one.mass, one.friction) == (
        str(other.at((0.3, 0.2, 0.1))),
        0.123,
        (0.4, 0.005, 0.0001),
    )


def test_another_mass_centre_inertia_or_friction_is_another_library(tiny_run: Path, tmp_path: Path) -> None:
    library = Path(shutil.copytree(tiny_run, tmp_path / "library"))
    found = {fingerprint(library)}
    weigh(library, mass_source=None)
    found.add(fingerprint(library))  # not used: the same library
    assert len(found) == 1
    for changed in ({}, {"friction": None}, {"center_of_mass": [0.0, 0.0, 0.0]}, {"inertia": None}, {"mass": 0.2}):
        found.add(fingerprint(weigh(library, **({"mass": 0.1} | changed))))
    assert len(found) == 6


def test_libraries_that_are_no_runs_know_no_masses(dataset: Path, weighed: Path) -> None:
    shelf = AssetLibraries([str(weighed), str(dataset)])
    known = {library.name: {shelf.physics(a.asset_id) is not None for a in library.assets} for library in shelf.libraries}
    assert known == {weighed.name: {True}, dataset.name: {False}}


def test_the_first_library_serves_and_a_run_is_one(tiny: Path, tiny_run: Path, dataset: Path) -> None:
    shelf = AssetLibraries([str(dataset)])
    both = AssetLibraries([str(tiny_run), str(dataset)])
    names = [library.name for library in both.libraries]
    assert names == [tiny_run.name, dataset.name]
    first, rest = ({a.asset_id for a in library.assets} for library in both.libraries)
    assert first
    assert not first & rest  # an asset that two have is the earlier one's
    assert first | rest == {a.asset_id for a in shelf.libraries[0].assets}
    for asset in both.libraries[0].assets:
        path = both.asset_path(asset.asset_id)
        assert path is not None
        assert path.read_bytes().startswith(b"glTF")
        ours, theirs = both.annotation(asset.asset_id), shelf.annotation(asset.asset_id)
        assert (ours.category, ours.description, ours.is_container) == (
            theirs.category,
            theirs.description,
            theirs.is_container,
        )
        assert ours.extents_z_up == pytest.approx(theirs.extents_z_up, rel=1e-3)
    (library,) = AssetLibraries([str(tiny), str(dataset)]).libraries  # the second has nothing that the first has not
    assert library.name == str(tiny)  # both folders are called data
    with pytest.raises(ConfigError):
        AssetLibraries([str(tiny / "nowhere")])


def test_the_embedded_library_serves_where_others_have_nothing(dataset: Path) -> None:
    own, rest = AssetLibraries([str(dataset), "embedded"]).libraries
    shelf = AssetLibraries()
    (alone,) = shelf.libraries
    assert {shelf.physics(a.asset_id) for a in alone.assets} == {None}
    first = {a.asset_id for a in own.assets}
    assert {a.asset_id for a in rest.assets} == {a.asset_id for a in alone.assets} - first
    assert rest.name == alone.name == "embedded"


def test_a_folder_of_assets_alone_is_a_library(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "assets", ignore=shutil.ignore_patterns("Layout_info"))
    assert len(AssetLibraries([str(tmp_path / "assets")]).libraries[0])


def test_licences_are_told_once_for_each_library(library: Path) -> None:
    shelf = AssetLibraries([str(library), EMBEDDED])
    (own,) = (found for found in shelf.libraries if found.name != EMBEDDED)
    count = sum(a.is_offered for a in own.assets)
    annotations = library / "Asset_annotation.json"
    raw = json.loads(annotations.read_text("utf-8"))
    for k, asset in enumerate(a for a in own.assets if a.is_offered):
        raw[asset.asset_id]["licence"] = "CC BY-NC 4.0" if k else "some words"
    annotations.write_text(json.dumps(raw), "utf-8")
    shelf = AssetLibraries([str(library), EMBEDDED])
    (notice,) = shelf.licence_notices(RetrievalSettings())
    assert (notice.item_id, notice.code) == (own.name, "licence_unknown")
    assert notice.message.startswith(f"library {own.name}: of {count} assets 1 state no known licence")
    first, _ = shelf.licence_notices(RetrievalSettings(licences=frozenset({"CC0"})))
    assert first.code == "licence_barred"
    assert f"of {count} assets {count} are left out" in first.message
    assert f"CC BY-NC 4.0 ({count - 1}), some words (1)" in first.message


def test_what_is_served_is_what_libraries_of_others_have(library: Path) -> None:
    shelf = AssetLibraries([str(library), EMBEDDED])
    (own,) = (found for found in shelf.libraries if found.name != EMBEDDED)
    serves = shelf.serves(RetrievalSettings())
    assert all(serves(a.category) for a in own.assets if a.is_offered)
    assert not serves("grand_piano")
    missing = {a.category for a in AssetLibraries().libraries[0].assets} - {a.category for a in own.assets}
    assert not all(map(serves, missing))
    assert not AssetLibraries().serves(RetrievalSettings())("mug")


def test_the_real_meshes_of_the_repository_are_a_library() -> None:
    real = AssetLibraries((REAL,))
    assert absolute_places((REAL,)) == (REAL,)
    assets = [asset for library in real.libraries for asset in library.assets]
    assert len(assets) == 93
    assert {asset.licence for asset in assets} == {"CC0-1.0", "CC-BY-4.0"}
    store = AssetStore(real)
    for name in ("bowl", "ycb_025_mug"):
        assert store.physics(name) is not None
        look, notices = store.look(name)
        assert look
        assert any(surface.image for surface in look)
        assert not notices
    mug = next(asset for asset in assets if asset.asset_id == "ycb_025_mug")
    assert mug.size_range == pytest.approx((0.117, 0.117), abs=0.001)
