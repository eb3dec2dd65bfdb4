"""Features of pictures, for distances between sets of pictures and their diversity (``stable_data/scores/set_distance.py``).

``extractor_named`` gives an extractor by its name; ``inception`` is the network of FID, ``vision_model`` any local model of Hugging Face,
``gradients`` a feature without weights. ``python -m models.picture_features DIR DIR`` compares two folders of pictures.
"""

from models.picture_features.extractor import FeatureExtractor, Pictures
from models.picture_features.registry import default_name, extractor_named

__all__ = ["FeatureExtractor", "Pictures", "default_name", "extractor_named"]
