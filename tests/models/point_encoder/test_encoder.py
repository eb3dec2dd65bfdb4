from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.point_encoder.cloud import MODELNET, SCANNET, SONATA, PointCloud, Preprocessing, voxelise
from models.point_encoder.encoder import FEATURE_CHANNELS, PointEncoder
from models.point_encoder.transformer import EMBEDDED
from stable_data.errors import ConfigError, MeshError
from tests.models.point_encoder.clouds import TINY, box_cloud, clouds, shuffled, tiny_encoder
from tests.torch_threads import torch_threads


def far(first: npt.NDArray[np.float32], second: npt.NDArray[np.float32]) -> float:
    return float(np.abs(first - second).max())


@pytest.mark.parametrize("num_threads", [1, 2])
def test_the_last_bits_of_a_feature_depend_on_its_cloud_alone(num_threads: int, rng: np.random.Generator) -> None:
    torch.manual_seed(0)
    encoder = PointEncoder(EMBEDDED, Preprocessing(num_points=700))
    encoder.set_projection(torch.zeros(EMBEDDED.out_channels), torch.randn(FEATURE_CHANNELS, EMBEDDED.out_channels))
    sizes = rng.uniform(0.02, 0.4, (9, 3)).tolist()
    all_clouds = [box_cloud(x, y, z, num_points=700) for x, y, z in sizes]
    alone = np.concatenate([encoder.encode([cloud]).codes for cloud in all_clouds])
    with torch_threads(num_threads):
        together = encoder.encode(all_clouds).codes
    assert together.shape == (9, FEATURE_CHANNELS)
    assert together.tobytes() == alone.tobytes()
    assert far(together[0], together[1]) > 1e-2


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_feature_does_not_depend_on_the_order_of_points(seed: int) -> None:
    encoder, rng = tiny_encoder(), np.random.default_rng(seed)
    mixed = [shuffled(cloud, rng) for cloud in clouds()]
    assert far(encoder.encode(mixed).codes, encoder.encode(clouds()).codes) < 1e-5


def test_a_feature_is_the_same_each_time() -> None:
    first, second = (tiny_encoder().encode(clouds()) for _ in range(2))
    assert first.codes.tobytes() == second.codes.tobytes()
    assert first.fingerprint == second.fingerprint


def test_a_gradient_is_the_same_each_time() -> None:
    found = []
    for _ in range(2):
        encoder = tiny_encoder()
        encoder(clouds()).square().sum().backward()
        found.append([p.grad for p in encoder.parameters()])
    for first, second in zip(*found, strict=True):
        assert first is not None
        assert second is not None
        assert first.equal(second)


def test_size_shows_in_the_extents_alone() -> None:
    encoder = tiny_encoder()
    small, large = box_cloud(0.1, 0.05, 0.02), box_cloud(0.4, 0.2, 0.08)
    found = encoder.encode([small, large])
    assert far(found.codes[0], found.codes[1]) < 1e-4
    assert np.allclose(found.log_extents[1] - found.log_extents[0], np.log(4), atol=1e-5)
    assert np.allclose(np.exp(found.log_extents[0]), (0.1, 0.05, 0.02))


def test_a_turned_object_has_another_code() -> None:
    found = tiny_encoder().encode([box_cloud(0.3, 0.1, 0.05), box_cloud(0.1, 0.3, 0.05)]).codes
    assert far(found[0], found[1]) > 1e-3


def test_a_cloud_of_another_number_of_points_is_refused() -> None:
    with pytest.raises(MeshError, match=r"\[64\] points, expected the 128"):
        tiny_encoder().encode([box_cloud(0.1, 0.1, 0.1, num_points=64)])


def test_points_of_a_voxel_are_averaged() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], np.float32)
    normals = np.eye(3, dtype=np.float32)[[0, 1, 2, 2]]
    found = voxelise([PointCloud(points, normals, np.array([2, 1, 1], np.float32))], Preprocessing(4, "extent", 0.5))
    assert found.coords.tolist() == [[0, 0, 0], [2, 0, 0], [4, 0, 0]]
    assert torch.allclose(found.features[1], torch.tensor([0.05, 0.0, 0.0, 0.5, 0.5, 0.0]))


def test_a_face_at_the_end_of_the_box_falls_into_one_layer_of_voxels(rng: np.random.Generator) -> None:
    points = np.concatenate([np.full((500, 1), 0.15) + rng.normal(0, 1e-8, (500, 1)), rng.uniform(-0.1, 0.1, (500, 2))], axis=1)
    cloud = PointCloud(points.astype(np.float32), np.zeros((500, 3), np.float32), np.full(3, 0.3, np.float32))
    assert len(voxelise([cloud], Preprocessing()).coords[:, 0].bincount()) == 1


@pytest.mark.parametrize("preprocessing", [SCANNET, MODELNET, SONATA])
def test_published_preprocessing_gives_as_many_channels_as_it_says(preprocessing: Preprocessing) -> None:
    found = voxelise(clouds(), preprocessing)
    assert found.features.shape == (len(found.batch), preprocessing.num_channels)


def test_other_channels_than_the_network_takes_are_refused() -> None:
    with pytest.raises(ConfigError, match="takes 6 channels, its preprocessing makes 9"):
        PointEncoder(TINY, SONATA)


@pytest.mark.parametrize(
    ("points", "size"), [(np.zeros((0, 3)), (1, 1, 1)), (np.full((2, 3), np.nan), (1, 1, 1)), (np.zeros((2, 3)), (0, 0, 0))]
)
def test_a_cloud_without_shape_is_refused(points: npt.NDArray[np.float32], size: tuple[int, int, int]) -> None:
    points = points.astype(np.float32)
    with pytest.raises(MeshError, match="cloud has"):
        PointCloud(points, points, np.array(size, np.float32))


def test_other_widths_are_projected_to_whitened_codes() -> None:
    encoder = tiny_encoder(replace(TINY, dec_channels=(80,), dec_heads=(5,)))
    rng = np.random.default_rng(0)
    library = [box_cloud(*rng.uniform(0.02, 0.4, 3).tolist()) for _ in range(90)]
    with pytest.raises(ConfigError, match="80 channels, expected 64"):
        encoder.encode(library)
    with pytest.raises(ConfigError, match="span"):
        encoder.fit_projection(library[:10])
    before = encoder.fingerprint()
    encoder.fit_projection(library)
    codes = encoder.encode(library).codes
    assert codes.shape == (90, 64)
    assert np.allclose(codes.mean(axis=0), 0, atol=0.05)
    assert np.allclose(codes[:, :8].std(axis=0), 1, atol=0.05)
    assert encoder.fingerprint() != before


def test_the_fingerprint_names_weights_configuration_and_preprocessing() -> None:
    known = tiny_encoder().fingerprint()
    assert tiny_encoder(replace(TINY, patch_size=32)).fingerprint() != known
    assert tiny_encoder(preprocessing=Preprocessing(num_points=128, grid_size=1 / 5)).fingerprint() != known
    other = tiny_encoder()
    with torch.no_grad():
        next(other.parameters()).flatten()[0].add_(1e-3)
    assert other.fingerprint() != known


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_gives_the_same_features() -> None:
    encoder = tiny_encoder()
    on_cpu = encoder.encode(clouds()).codes
    assert far(on_cpu, encoder.cuda().encode(clouds()).codes) < 1e-4
