"""Features of local models of Hugging Face: pooled output, prepared as the folder says, offline."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from transformers import (
    CLIPConfig,
    CLIPImageProcessor,
    CLIPModel,
    CLIPTextConfig,
    CLIPVisionConfig,
    ViTConfig,
    ViTForImageClassification,
    ViTImageProcessor,
    ViTMAEConfig,
    ViTMAEModel,
    ViTModel,
)

from models.picture_features.vision_model import VisionModelFeatures
from stable_data.errors import ConfigError

PICTURES = np.random.default_rng(0).integers(0, 256, (11, 30, 40, 3), np.uint8)
SMALL = {
    "hidden_size": 16,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "intermediate_size": 32,
    "image_size": 32,
    "patch_size": 8,
}


def vit(folder: Path) -> Path:
    torch.manual_seed(0)
    ViTModel(ViTConfig(**SMALL)).save_pretrained(folder)
    ViTImageProcessor(size={"height": 32, "width": 32}).save_pretrained(folder)
    return folder


def test_rows_are_the_pooled_output(tmp_path: Path) -> None:
    folder = vit(tmp_path)
    extractor = VisionModelFeatures(folder)
    rows = extractor(PICTURES)
    assert rows.shape == (11, 16)
    assert rows.dtype == np.float32
    inputs = ViTImageProcessor.from_pretrained(folder)(images=list(PICTURES), return_tensors="pt")
    with torch.inference_mode():
        expected = ViTModel.from_pretrained(folder).eval()(**inputs).pooler_output.numpy()
    np.testing.assert_allclose(rows, expected, atol=1e-5)
    np.testing.assert_array_equal(extractor(PICTURES[9:10]), rows[9:10])
    assert extractor(PICTURES[:0]).shape == (0, 16)
    assert extractor.name == f"transformers:{folder}"
    assert extractor.distance_name == f"Frechet distance (transformers:{folder})"
    assert len(extractor.fingerprint) == 16


def test_a_model_of_pictures_and_text_gives_the_picture(tmp_path: Path) -> None:
    text = CLIPTextConfig(hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=32, vocab_size=40)
    CLIPModel(
        CLIPConfig(text_config=text.to_dict(), vision_config=CLIPVisionConfig(**SMALL).to_dict(), projection_dim=12)
    ).save_pretrained(tmp_path)
    CLIPImageProcessor(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}).save_pretrained(tmp_path)
    assert VisionModelFeatures(tmp_path)(PICTURES[:2]).shape == (2, 12)


def test_a_model_without_pooled_output_is_refused(tmp_path: Path) -> None:
    ViTMAEModel(ViTMAEConfig(**SMALL)).save_pretrained(tmp_path)
    ViTImageProcessor(size={"height": 32, "width": 32}).save_pretrained(tmp_path)
    with pytest.raises(ConfigError, match="no pooled output") as error:
        VisionModelFeatures(tmp_path)(PICTURES[:2])
    assert error.value.code == "model_invalid"


def test_weights_that_would_be_random_are_refused(tmp_path: Path) -> None:
    """A classifier is published without the pooler."""
    ViTForImageClassification(ViTConfig(**SMALL)).save_pretrained(tmp_path)
    ViTImageProcessor(size={"height": 32, "width": 32}).save_pretrained(tmp_path)
    with pytest.raises(ConfigError, match=r"lacks 2 weights, pooler\.dense\.bias first") as error:
        VisionModelFeatures(tmp_path)(PICTURES[:2])
    assert error.value.code == "model_invalid"


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"has no config\.json") as error:
        VisionModelFeatures(tmp_path)
    assert error.value.code == "model_invalid"
    folder = vit(tmp_path / "vit")
    (folder / "config.json").write_text(json.dumps({"model_type": "no such type"}))
    with pytest.raises(ConfigError, match="cannot be loaded") as error:
        VisionModelFeatures(folder)(PICTURES)
    assert error.value.code == "model_invalid"
