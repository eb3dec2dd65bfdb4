"""Sentence embeddings, offline: the packaged all-MiniLM-L6-v2, or any local folder in the sentence-transformers layout.

``folder`` reads the configuration of such a folder; ``encoder`` runs the model with transformers only.
"""

from models.text_encoder.encoder import SentenceEncoder, load_default
from models.text_encoder.folder import SentenceModel, TokenPooling, packaged_folder, read_folder

__all__ = ["SentenceEncoder", "SentenceModel", "TokenPooling", "load_default", "packaged_folder", "read_folder"]
