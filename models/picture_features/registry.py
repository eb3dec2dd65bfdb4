"""Extractors by name."""

from pathlib import Path

from models.picture_features.extractor import FeatureExtractor
from models.picture_features.gradients import GradientFeatures
from stable_data.errors import ConfigError
from stable_data.feature_files import FEATURE_KINDS, GRADIENTS, INCEPTION, TRANSFORMERS, inception_file
from stable_data.json_text import quote_value


def default_name() -> str:
    """Returns the extractor that is used if none is named: Inception if its weights were fetched, else the one without weights."""
    return INCEPTION if inception_file().is_file() else GRADIENTS


def extractor_named(name: str, device: str = "cpu") -> FeatureExtractor:
    """Opens an extractor; weights are read, never downloaded.

    Args:
        name: ``inception``, ``inception:FILE`` with the weights in one of the known files, ``transformers:FOLDER``, or ``gradients``.
        device: The torch device of a network.

    Raises:
        ConfigError: There is no such extractor (``setting_invalid``), or its weights are missing (``weights_missing``), are not the
            known ones (``hash_mismatch``), or are no vision model (``model_invalid``).
    """
    kind, _, place = name.partition(":")
    if name == GRADIENTS:
        return GradientFeatures()
    # Both need torch, whose import takes seconds.
    if kind == INCEPTION and (place or name == INCEPTION):
        from models.picture_features.inception import InceptionFeatures

        return InceptionFeatures(Path(place) if place else inception_file(), device)
    if kind == TRANSFORMERS and place:
        from models.picture_features.vision_model import VisionModelFeatures

        return VisionModelFeatures(Path(place), device)
    known = ", ".join(FEATURE_KINDS)
    raise ConfigError(f"features is {quote_value(name)}, expected one of {known}, {INCEPTION}:FILE", "setting_invalid")
