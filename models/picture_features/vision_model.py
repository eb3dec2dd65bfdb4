"""Features of a vision model of Hugging Face in a local folder, such as ViT, DINOv2, CLIP, SigLIP or ResNet: its pooled output.

Models of pictures and text, such as CLIP, give the features of the picture in the space that both share. Nothing is downloaded, and no code
of the folder is run.
"""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from models.hugging_face import load_local
from models.picture_features.extractor import BATCH, Pictures, Rows, check_pictures
from stable_data.errors import ConfigError
from stable_data.feature_files import TRANSFORMERS

_FILES = ("config.json", "preprocessor_config.json", "model.safetensors")


class VisionModelFeatures:
    """An extractor whose model is in a folder; the first call reads the weights.

    Args:
        folder: Folder with config.json, preprocessor_config.json and model.safetensors.
        device: The torch device.

    Raises:
        ConfigError: The folder lacks a file (``model_invalid``).
    """

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        missing = [name for name in _FILES if not (folder / name).is_file()]
        if missing:
            raise ConfigError(
                f"{folder}: has no {missing[0]}, expected a vision model of Hugging Face: {', '.join(_FILES)}", "model_invalid"
            )
        self._folder, self._device = folder, torch.device(device)

    @property
    def name(self) -> str:
        """``transformers:FOLDER``."""
        return f"{TRANSFORMERS}:{self._folder}"

    @property
    def distance_name(self) -> str:
        """The Fréchet distance of these features, which is not FID."""
        return f"Frechet distance ({self.name})"

    @property
    def kernel_distance_name(self) -> str:
        """The kernel distance of these features, which is not KID."""
        return f"kernel distance ({self.name})"

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the configuration, the preparation of pictures and the weights."""
        digest = hashlib.sha256()
        for name in _FILES:
            with (self._folder / name).open("rb") as stream:
                hashlib.file_digest(stream, lambda: digest)  # continues this one
        return digest.hexdigest()[:16]

    def __call__(self, pictures: Pictures, /) -> Rows:
        """Computes the features of pictures of one size, (N, D) float32.

        Raises:
            ConfigError: They are no pictures (``pictures_invalid``), or the model cannot be loaded or has no pooled output
                (``model_invalid``).
        """
        check_pictures(pictures)
        parts = [self._rows(pictures[start : start + BATCH]) for start in range(0, len(pictures), BATCH)]
        if parts:
            return np.concatenate(parts)
        return self._rows(np.zeros((1, 8, 8, 3), np.uint8))[:0]

    def _rows(self, pictures: Pictures) -> Rows:
        processor, model = self._parts
        filled = [*pictures, *[np.zeros_like(pictures[0])] * (BATCH - len(pictures))]
        # The layout of the channels is given, because a picture of 3 pixels could be read in two ways.
        inputs = processor(images=filled, return_tensors="pt", input_data_format="channels_last").to(self._device)
        with torch.inference_mode():
            pooled = self._pooled(model, inputs["pixel_values"])
        rows: Rows = pooled.flatten(1)[: len(pictures)].float().cpu().numpy()
        return rows

    def _pooled(self, model: Any, pixels: Tensor) -> Tensor:
        found = (
            model.get_image_features(pixel_values=pixels)
            if hasattr(model, "get_image_features")
            else model(pixel_values=pixels)
        )
        pooled = found if isinstance(found, Tensor) else getattr(found, "pooler_output", None)
        if pooled is None:
            raise ConfigError(
                f"{self._folder}: the model has no pooled output, expected one such as ViT, DINOv2 or CLIP", "model_invalid"
            )
        return pooled

    @cached_property
    def _parts(self) -> tuple[Any, Any]:
        """What prepares pictures, and the model with all weights from the file."""
        model, processor = load_local(self._folder, "a vision model of Hugging Face", with_processor=True)
        return processor, model.to(self._device)
