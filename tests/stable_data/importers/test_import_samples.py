"""Source folders as their authors ship them: the small ones of the tests, and all that lie beside the checkout."""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stable_data.assets.licences import normalise_licence
from stable_data.importers.boundary import Boundary
from stable_data.importers.mesh_files import joined_triangles, transformed, z_up
from stable_data.importers.readers import reader_of
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef

PLAIN = ReaderOptions()
HEIGHTS = {"CoffeeTable": 0.32, "NightStand": 0.68, "ReadingDesk": 0.74}  # m, of their tops


@pytest.fixture(scope="module", params=["small", "shared"])
def samples(request: pytest.FixtureRequest) -> Path:
    if request.param == "small":
        return Path(request.getfixturevalue("real_data")) / "import"
    folder: Path = request.getfixturevalue("shared_data") / "import_samples"
    if not folder.is_dir():
        pytest.skip("the sample folders beside the checkout (../shared/data/import_samples) are absent")
    return folder


def read_all(root: Path, kind: str, options: ReaderOptions = PLAIN) -> list[tuple[SourceRef, SourceAsset]]:
    """All assets of a folder; none may be refused, and no file may be opened that was not planned."""
    read = []
    for ref in reader_of(kind).find(Boundary(root), options):
        assert isinstance(ref, SourceRef)
        boundary = Boundary(root)
        read.append((ref, reader_of(kind).read(boundary, ref, options)))
        assert boundary.opened <= set(ref.files)
    return read


def box_of(asset: SourceAsset) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    points = joined_triangles(asset.surfaces).reshape(-1, 3)
    return np.array([points.min(axis=0), points.max(axis=0)])


def test_ycb_models_have_the_masses_and_boxes_of_their_files(samples: Path) -> None:
    found = read_all(samples / "gazebo", "sdformat")
    assert len(found) == len([p for p in (samples / "gazebo").iterdir() if p.is_dir()])
    for ref, asset in found:
        folder = samples / "gazebo" / Path(ref.path).parent
        inertial = ET.parse(folder / "model-1_4.sdf").getroot().find("model/link/inertial")  # noqa: S314
        assert inertial is not None
        stated = {element.tag: element.text or "" for element in inertial.iter()}
        given = asset.inertial
        assert given is not None
        assert given.mass == float(stated["mass"])
        np.testing.assert_allclose(np.array(given.center_of_mass), np.array(stated["pose"].split()[:3], np.float64), atol=1e-9)
        assert given.inertia is not None
        names = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        np.testing.assert_allclose(given.inertia, [[float(stated[n]) for n in row] for row in names], atol=1e-9)
        mesh = trimesh.load_scene(folder / "meshes" / "textured.dae")  # it applies neither unit nor axis, as Gazebo
        np.testing.assert_allclose(box_of(asset), mesh.bounds, atol=1e-6)
        assert [surface.image for surface in asset.surfaces] == [(folder / "meshes" / "texture_map.png").read_bytes()]
        assert not asset.notices
        assert [normalise_licence(licence.text) for licence in asset.licences] == ["CC-BY-4.0"]
        assert len(asset.colliders) == 1
        assert (asset.unit_m, asset.is_upright, asset.num_joints, asset.is_static) == (1.0, True, 0, False)


def test_tables_have_their_size_and_texture(samples: Path) -> None:
    found = {ref.asset_id.split("_")[3]: asset for ref, asset in read_all(samples / "tables", "sdformat")}
    assert set(found) <= set(HEIGHTS)
    for name, asset in found.items():
        low, high = box_of(asset)
        assert high[2] == pytest.approx(HEIGHTS[name], abs=0.01)
        assert low[2] == pytest.approx(0, abs=0.005)
        assert any(surface.image is not None for surface in asset.surfaces)
        assert asset.inertial is not None
        assert asset.inertial.center_of_mass is None  # the file states none
        assert {notice.code for notice in asset.notices} <= {"collider_refused"}
        for mesh in asset.colliders:
            # Also that of the night stand, whose node is mirrored along two axes.
            np.testing.assert_allclose(mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0), high - low, rtol=0.03)
    assert {name: asset.is_static for name, asset in found.items()}["CoffeeTable"]


def test_the_whole_kit_has_its_texture(samples: Path) -> None:
    found = read_all(samples / "gltf_kit", "mesh", ReaderOptions(preset="kaykit"))
    assert len(found) == len(list((samples / "gltf_kit" / "gltf").glob("*.gltf")))
    image = (samples / "gltf_kit" / "gltf" / "restaurantbits_texture.png").read_bytes()
    for ref, asset in found:
        assert all(surface.image == image for surface in asset.surfaces)
        assert (asset.unit_m, asset.is_upright, asset.author) == (None, True, "Kay Lousberg")
        assert [normalise_licence(licence.text) for licence in asset.licences] == ["CC0-1.0"]
        document = json.loads((samples / "gltf_kit" / ref.path).read_text())
        accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
        stated = np.array([accessor["min"], accessor["max"]])
        turned = np.sort(stated @ z_up("y")[:3, :3].T, axis=0)
        if list(document["nodes"][0]) in (["mesh", "name"], ["name", "mesh"]):  # without a transform
            np.testing.assert_allclose(box_of(asset), turned, atol=1e-6)


def test_a_blob_of_bullet_keeps_its_inertia_as_it_stands(real_data: Path) -> None:
    ((_, asset),) = read_all(real_data / "import" / "urdf", "urdf")
    assert asset.inertial is not None
    assert asset.inertial.inertia is not None
    assert (asset.inertial.mass, np.diag(asset.inertial.inertia).tolist()) == (0.1, [1.0, 1.0, 0.0])
    assert asset.friction == (1.0, 0.005, 0.0001)
    mesh = trimesh.load_scene(real_data / "import" / "urdf" / "007" / "007.obj")
    np.testing.assert_allclose(box_of(asset), mesh.bounds * 0.015, atol=1e-6)


def test_reading_twice_gives_the_same(real_data: Path) -> None:
    for kind in ("sdformat", "urdf", "mesh"):
        once, twice = (read_all(real_data / "import", kind) for _ in range(2))
        assert [ref for ref, _ in once] == [ref for ref, _ in twice]
        for (_, a), (_, b) in zip(once, twice, strict=True):
            np.testing.assert_array_equal(joined_triangles(a.surfaces), joined_triangles(b.surfaces))


def test_a_turn_and_its_inverse_change_nothing(real_data: Path) -> None:
    (_, asset), *_ = read_all(real_data / "import" / "gltf_kit", "mesh")
    back = transformed(transformed(asset.surfaces, z_up("y")), z_up("y").T)
    np.testing.assert_array_equal(joined_triangles(back), joined_triangles(asset.surfaces))
