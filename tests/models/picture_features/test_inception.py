"""Inception v3 of FID: only known weights are read, and the network is the one that they belong to."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from models.picture_features import inception_weights
from models.picture_features.inception import InceptionFeatures, InceptionNetwork, inception_network, prepared
from models.picture_features.inception_weights import (
    LayerWeights,
    layers_of_archive,
    layers_of_state_dict,
    read_layers,
    state_dict_names,
    state_dict_of_layers,
)
from stable_data.errors import ConfigError
from stable_data.feature_files import fetch_command, inception_file


def fetched() -> Path:
    if not inception_file().is_file():
        pytest.skip(f"the weights of Inception are not on this machine: {fetch_command()}")
    return inception_file()


def shapes() -> list[torch.Size]:
    with torch.device("meta"):
        return [m.weight.shape for m in InceptionNetwork().modules() if isinstance(m, torch.nn.Conv2d)]


def state_dict() -> dict[str, torch.Tensor]:
    layers = [LayerWeights(torch.zeros(1).expand(shape), *[torch.ones(shape[0])] * 4) for shape in shapes()]
    return state_dict_of_layers(layers)


def test_the_network_has_the_parts_of_inception_v3() -> None:
    assert len(shapes()) == len(set(state_dict_names())) == 94
    parameters = sum(shape.numel() for shape in shapes())
    outputs = sum(shape[0] for shape in shapes())
    assert (
        parameters + 2 * outputs == 21_785_568
    )  # published, with scale and shift of each batch normalisation, without classes
    with torch.device("meta"):
        assert InceptionNetwork()(torch.zeros(2, 3, 299, 299)).shape == (2, 2048)


def test_a_batch_normalisation_is_folded_in() -> None:
    torch.manual_seed(0)
    convolution, norm = torch.nn.Conv2d(3, 5, 3, bias=False), torch.nn.BatchNorm2d(5, eps=0.001).eval()
    for tensor in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
        assert tensor is not None
        tensor.data.uniform_(0.3, 2)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    layer = LayerWeights(convolution.weight.data, norm.weight.data, norm.bias.data, norm.running_mean, norm.running_var)
    x = torch.randn(2, 3, 8, 8)
    weight, bias = layer.folded()
    torch.testing.assert_close(torch.nn.functional.conv2d(x, weight, bias), norm(convolution(x)), rtol=1e-5, atol=1e-5)


def test_pictures_are_prepared_as_for_fid() -> None:
    pictures = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (2, 299, 299, 3), np.uint8))
    found = prepared(pictures)
    assert (found.shape, found.dtype) == ((2, 3, 299, 299), torch.float32)
    torch.testing.assert_close(found, pictures.permute(0, 3, 1, 2).float() / 127.5 - 1, rtol=0, atol=1e-6)
    assert (prepared(torch.zeros(1, 20, 30, 3, dtype=torch.uint8)) == -1).all()
    white = prepared(torch.full((1, 20, 30, 3), 255, dtype=torch.uint8))
    torch.testing.assert_close(white, torch.ones_like(white), rtol=0, atol=1e-6)


def test_weights_that_lack_a_layer_or_have_another_shape_are_refused() -> None:
    tensors = state_dict()
    inception_network(layers_of_state_dict(tensors))
    less = {name: tensor for name, tensor in tensors.items() if name != "Mixed_7c.branch_pool.bn.bias"}
    with pytest.raises(ConfigError, match=r"no tensor Mixed_7c\.branch_pool\.bn\.bias") as error:
        layers_of_state_dict(less)
    assert error.value.code == "weights_invalid"
    other = tensors | {"Mixed_5b.branch1x1.conv.weight": torch.zeros(63, 192, 1, 1)}
    with pytest.raises(ConfigError, match="94 convolutions") as error:
        inception_network(layers_of_state_dict(other))
    assert error.value.code == "weights_invalid"
    with pytest.raises(ConfigError, match=r"no tensor net\.layers\.conv\.weight"):
        layers_of_archive({})


def test_an_unknown_file_is_refused_and_never_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "pt_inception-2015-12-05-6726825d.pth"
    torch.save(state_dict(), path)
    for name in ("load", "jit.load"):
        monkeypatch.setattr(f"torch.{name}", lambda *given, **named: pytest.fail("the file was opened"))
    with pytest.raises(ConfigError, match=r"SHA-256 is .*stable-data features --fetch inception") as error:
        InceptionFeatures(path)
    assert error.value.code == "hash_mismatch"
    with pytest.raises(ConfigError, match=r"there is no such file.*stable-data features --fetch inception") as error:
        InceptionFeatures(tmp_path / "missing.pth")
    assert error.value.code == "weights_missing"


def test_a_state_dict_with_the_known_hash_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "weights.pth"
    torch.save(state_dict(), path)
    monkeypatch.setattr(inception_weights, "STATE_DICT_SHA256", inception_weights._sha256(path))
    assert [layer.weight.shape for layer in read_layers(path)] == shapes()


@pytest.mark.slow
def test_it_agrees_with_the_published_network() -> None:
    """The archive is itself a network: both see the same prepared pictures."""
    path = fetched()
    random = np.random.default_rng(0)
    coarse = torch.from_numpy(random.random((2, 3, 9, 9), np.float32))
    smooth = torch.nn.functional.interpolate(coarse, (299, 299), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
    pictures = np.concatenate([random.integers(0, 256, (2, 299, 299, 3), np.uint8), (255 * smooth.numpy()).astype(np.uint8)])
    extractor = InceptionFeatures(path)
    found = extractor(pictures)
    assert found.shape == (4, 2048)
    assert found.dtype == np.float32
    with warnings.catch_warnings(), torch.inference_mode():
        warnings.simplefilter("ignore", DeprecationWarning)
        published = torch.jit.load(path).eval()  # type: ignore[no-untyped-call]
        expected = published(prepared(torch.from_numpy(pictures))).numpy()
    assert expected.max() > 1
    np.testing.assert_allclose(found, expected, atol=1e-4)
    # A row depends on its picture alone.
    np.testing.assert_array_equal(extractor(pictures[2:3]), found[2:3])
    assert extractor(pictures[:0]).shape == (0, 2048)
    assert len(extractor.fingerprint) == 16
