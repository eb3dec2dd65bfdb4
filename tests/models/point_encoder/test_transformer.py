from dataclasses import replace

import pytest
import torch

from models.point_encoder.transformer import BASE, EMBEDDED, PointTransformer, TransformerConfig
from stable_data.errors import ConfigError
from tests.models.point_encoder.clouds import TINY, random_voxels

VARIANTS = {
    "first generation": replace(TINY, norm="bn", legacy_stale_cpe=True),
    "ours": TINY,
    "second generation": replace(TINY, stem="linear", pool="grid", enc_mode=True, layer_scale=0.1),
}


def count(config: TransformerConfig) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in PointTransformer(config).parameters())


def test_the_published_network_has_its_published_size() -> None:
    assert count(BASE) == 46_166_272  # 46.17 M
    with torch.device("meta"):
        assert len(PointTransformer(BASE).state_dict()) == 486
    assert 38.6e6 < count(replace(BASE, enc_mode=True)) < 38.7e6


def test_the_embedded_network_is_small() -> None:
    assert 1e6 < count(EMBEDDED) < 2e6
    assert EMBEDDED.enc_mode  # one code a cloud needs no decoder


@pytest.mark.parametrize("name", VARIANTS)
def test_gradients_reach_every_parameter(name: str) -> None:
    torch.manual_seed(0)
    network = PointTransformer(VARIANTS[name])
    coords, batch = random_voxels((60, 30, 1), 6)
    features, level = network(coords, batch, torch.randn(len(batch), 6))
    assert features.shape == (len(level), VARIANTS[name].out_channels)
    (features * torch.randn_like(features)).sum().backward()
    without = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all() or not p.grad.any()]
    assert not without


@pytest.mark.parametrize("name", VARIANTS)
def test_a_cloud_does_not_see_the_others(name: str) -> None:
    torch.manual_seed(0)
    network = PointTransformer(VARIANTS[name]).eval()
    coords, batch = random_voxels((70, 1, 33), 7)
    features = torch.randn(len(batch), 6)
    together, level = network(coords, batch, features)
    for cloud in range(3):
        rows = batch == cloud
        alone, _ = network(coords[rows], torch.zeros_like(batch[rows]), features[rows])
        assert torch.allclose(alone, together[level.batch == cloud], atol=1e-5)


def test_the_stale_convolution_is_another_network() -> None:
    torch.manual_seed(0)
    fresh, stale = PointTransformer(TINY), PointTransformer(replace(TINY, legacy_stale_cpe=True))
    stale.load_state_dict(fresh.state_dict())
    coords, batch = random_voxels((50,), 6)
    features = torch.randn(len(batch), 6)
    assert not torch.allclose(fresh(coords, batch, features)[0], stale(coords, batch, features)[0], atol=1e-4)


@pytest.mark.parametrize(
    ("change", "said"),
    [({"stem": "mlp"}, "stem is 'mlp'"), ({"curves": ("peano",)}, "peano"), ({"enc_heads": (3, 2)}, "whole heads")],
)
def test_a_configuration_that_makes_no_network_is_refused(change: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        replace(TINY, **change)  # type: ignore[arg-type]
