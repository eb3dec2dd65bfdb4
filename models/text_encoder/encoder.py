"""Sentences to unit rows, with transformers and tokenizers only.

A row depends on its sentence alone, to the last bit: sentences are grouped by their padded length and run in batches of one
fixed size, because a matrix product of another shape may sum in another order.
"""

from collections.abc import Iterable, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tokenizers import Tokenizer

from models.hugging_face import load_local
from models.text_encoder.folder import SentenceModel, TokenPooling, packaged_folder, read_folder
from stable_data.assets.text_embeddings import Rows
from stable_data.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

_BATCH = 8  # sentences: one costs as much as eight
_LENGTH_STEP = 8  # tokens
_MAX_CHARACTERS = 1 << 15  # far more than max_tokens need; bounds the time of the tokenizer


class SentenceEncoder:
    """A sentence encoder; the first call reads the weights.

    Args:
        folder: A local folder in the sentence-transformers layout.
        device: The torch device.

    Attributes:
        model: The configuration of the folder.

    Raises:
        ConfigError: The folder does not contain such a model.
    """

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        self.model: SentenceModel = read_folder(folder)
        self._device = device

    @property
    def fingerprint(self) -> str:
        """Hash of the weights and of all settings that determine the rows."""
        return self.model.fingerprint

    def __call__(self, texts: Sequence[str], /) -> Rows:
        """Computes unit rows of sentences, (N, D) float32; texts that are too long are truncated.

        Raises:
            ConfigError: The weights or the tokenizer cannot be read.
        """
        words = [text.lower() if self.model.lowers else text for text in texts]
        # The tokenizer fails on surrogates, which UTF-8 cannot encode.
        words = [text[:_MAX_CHARACTERS].encode("utf-8", "replace").decode() for text in words]
        tokens = [encoding.ids for encoding in self._tokenizer.encode_batch(words)]
        rows = np.zeros((len(texts), self._width), np.float32)
        for length, members in _by_length(tokens):
            for start in range(0, len(members), _BATCH):
                batch = members[start : start + _BATCH]
                rows[batch] = self._encode([tokens[k] for k in batch], length)[: len(batch)]
        return rows

    @cached_property
    def _tokenizer(self) -> Tokenizer:
        path = self.model.folder / "tokenizer.json"
        try:
            tokenizer = Tokenizer.from_file(str(path))
        except Exception as error:
            reason = str(error).partition("\n")[0]
            message = f"{path}: cannot be read ({reason}), expected a tokenizer; fetch the model again"
            raise ConfigError(message, "model_invalid") from error
        tokenizer.no_padding()
        tokenizer.enable_truncation(self.model.max_tokens)
        return tokenizer

    @cached_property
    def _network(self) -> Any:
        """The transformer, with all weights from the file."""
        network, _ = load_local(self.model.folder, "a transformer", unused=("pooler.",))
        return network.to(self._device)

    @property
    def _width(self) -> int:
        return int(self._network.config.hidden_size)

    def _encode(self, tokens: Sequence[Sequence[int]], length: int) -> Rows:
        """Computes unit rows of at most eight sentences, (8, D) float32; rows after the last sentence have no meaning."""
        import torch  # here: a library that is read need not be searched by words

        padding = self._network.config.pad_token_id or 0
        ids = torch.full((_BATCH, length), padding, dtype=torch.long)  # (8, T)
        mask = torch.zeros((_BATCH, length), dtype=torch.long)
        mask[:, 0] = 1  # the mean of a row without tokens would be 0 / 0
        for row, sentence in enumerate(tokens):
            ids[row, : len(sentence)] = torch.tensor(sentence)
            mask[row, : len(sentence)] = 1
        ids, mask = ids.to(self._device), mask.to(self._device)
        with torch.inference_mode():
            states = self._network(input_ids=ids, attention_mask=mask).last_hidden_state  # (8, T, D)
            pooled = torch.nn.functional.normalize(_pooled(states, mask, self.model.pooling), dim=-1)
        rows: Rows = pooled.cpu().numpy()
        return rows


@cache
def load_default(device: str = "cpu") -> SentenceEncoder:
    """Loads the packaged all-MiniLM-L6-v2, with 384 numbers for each sentence; the same one for all that use it in a process.

    Raises:
        ConfigError: The package with the model is not installed.
    """
    return SentenceEncoder(packaged_folder(), device)


def _by_length(tokens: Sequence[Sequence[int]]) -> Iterable[tuple[int, list[int]]]:
    """Groups sentences by their padded length."""
    groups: dict[int, list[int]] = {}
    for index, sentence in enumerate(tokens):
        groups.setdefault(-(-len(sentence) // _LENGTH_STEP) * _LENGTH_STEP, []).append(index)
    return sorted(groups.items())


def _pooled(states: "Tensor", mask: "Tensor", pooling: TokenPooling) -> "Tensor":
    """Pools token vectors (8, T, D) to sentence vectors (8, D)."""
    if pooling is TokenPooling.CLS:
        return states[:, 0]
    weight = mask.unsqueeze(-1).to(states.dtype)  # (8, T, 1)
    if pooling is TokenPooling.MAX:
        return states.masked_fill(weight == 0, float("-inf")).amax(dim=1)
    total, count = (states * weight).sum(dim=1), weight.sum(dim=1)
    return total / (count if pooling is TokenPooling.MEAN else count.sqrt())
