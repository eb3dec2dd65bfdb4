"""FID and KID of pytorch-fid and torch-fidelity, and their networks, on the same features and pictures as ours."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.consumers.environment import FID_LIBRARIES
from models.picture_features.extractor import Pictures, Rows
from models.picture_features.inception import InceptionFeatures, InceptionNetwork, inception_network, prepared
from models.picture_features.inception_weights import LayerWeights, layers_of_state_dict, read_layers, state_dict_of_layers
from stable_data.feature_files import fetch_command, inception_file
from stable_data.scores.set_distance import FeatureStatistics, frechet_distance, kernel_distance, kernel_distance_at

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

SIZE, DRAWS, SEED = 40, 7, 2020


@pytest.fixture(scope="module", autouse=True)
def _needs_the_libraries() -> None:
    if not FID_LIBRARIES.is_there:
        pytest.skip(FID_LIBRARIES.missing)


def ask(folder: Path, question: Mapping[str, Any]) -> dict[str, Any]:
    (folder / "question.json").write_text(json.dumps(question))
    [answer] = FID_LIBRARIES.open([folder])
    assert answer["error"] is None
    return answer


@pytest.mark.parametrize(
    ("numbers", "width", "shift"), [((300, 300), 64, 0.05), ((120, 90), 64, 0.5), ((60, 60), 200, 0.2)], ids=str
)
def test_distances_of_features_agree(numbers: tuple[int, int], width: int, shift: float, tmp_path: Path) -> None:
    """To 1e-6 of the value. With 60 samples of 200 dimensions the covariances are singular."""
    random = np.random.default_rng(width)
    mixed = random.normal(size=(width, width)) / np.sqrt(width)
    first, second = (np.abs(random.normal(size=(n, width)) @ mixed) for n in numbers)
    second = second + shift
    np.savez(tmp_path / "features.npz", first=first, second=second)
    found = ask(tmp_path, {"distances": {"size": SIZE, "draws": DRAWS, "seed": SEED}})["distances"]
    ours = frechet_distance(FeatureStatistics.of(first), FeatureStatistics.of(second))
    assert found["pytorch_fid"] == pytest.approx(ours, rel=1e-6)
    assert found["torch_fidelity"] == pytest.approx(ours, rel=1e-6)
    drawn = kernel_distance_at(first, second, SIZE, DRAWS, SEED)  # the same subsets
    assert found["kid_subsets"] == pytest.approx([drawn.mean, drawn.deviation], rel=1e-6)
    if numbers[0] == numbers[1]:
        assert found["kid_whole"][0] == pytest.approx(kernel_distance(first, second), rel=1e-6)


def drawn_layers() -> list[LayerWeights]:
    """Weights of the right shapes: convolutions that keep the size of values, and any batch normalisations."""
    torch.manual_seed(0)
    layers = []
    for module in InceptionNetwork().modules():
        if isinstance(module, torch.nn.Conv2d):
            outputs = module.out_channels
            weight = torch.randn(module.weight.shape) * (2 / module.weight[0].numel()) ** 0.5
            scale, shift, mean = torch.rand(outputs) + 0.5, torch.randn(outputs) / 5, torch.randn(outputs) / 5
            layers.append(LayerWeights(weight, scale, shift, mean, torch.rand(outputs) + 0.5))
    return layers


def smooth_pictures(number: int, height: int, width: int) -> Pictures:
    random = np.random.default_rng(1)
    coarse = torch.from_numpy(random.random((number, 3, 7, 7)))
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    noise = random.normal(0, 0.03, (number, height, width, 3))
    return np.asarray((255 * (fine.permute(0, 2, 3, 1).numpy() + noise).clip(0, 1)).round().astype(np.uint8))


def features_of_ours(layers: list[LayerWeights], pictures: Pictures) -> Rows:
    with torch.inference_mode():
        return np.asarray(inception_network(layers)(prepared(torch.from_numpy(pictures))).numpy())


def test_the_network_is_that_of_pytorch_fid_with_any_weights(tmp_path: Path) -> None:
    """With drawn weights: the names of a state dict, every block and every pool; of another size than the network's."""
    layers, pictures = drawn_layers(), smooth_pictures(3, 180, 240)
    tensors = state_dict_of_layers(layers)
    torch.save(tensors, tmp_path / "weights.pth")
    np.save(tmp_path / "pictures.npy", pictures)
    ask(tmp_path, {"pictures": True})
    with np.load(tmp_path / "answer.npz") as answer:
        theirs = answer["pytorch_fid"]
    ours = features_of_ours(layers_of_state_dict(tensors), pictures)
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * np.abs(theirs).max())


def test_features_are_those_of_pytorch_fid(tmp_path: Path) -> None:
    """With the fetched weights: to 1e-4 at any size, and at 299 x 299 also almost those of torch-fidelity, whose range is TensorFlow's."""
    if not inception_file().is_file():
        pytest.skip(f"the weights of Inception are not on this machine: {fetch_command()}")
    extractor = InceptionFeatures(inception_file())
    for height, width in ((299, 299), (240, 320)):
        folder = tmp_path / f"{height}"
        folder.mkdir()
        pictures = smooth_pictures(4, height, width)
        torch.save(state_dict_of_layers(read_layers(inception_file())), folder / "weights.pth")
        np.save(folder / "pictures.npy", pictures)
        ask(folder, {"pictures": True})
        ours = extractor(pictures)
        with np.load(folder / "answer.npz") as answer:
            np.testing.assert_allclose(ours, answer["pytorch_fid"], atol=1e-4)
            if height == width == 299:
                apart = np.linalg.norm(ours - answer["torch_fidelity"], axis=1) / np.linalg.norm(ours, axis=1)
                assert apart.max() < 0.05
