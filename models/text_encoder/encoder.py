"""Sentences to unit rows, on transformers and tokenizers alone.

A row depends on its sentence and on nothing else, to the last bit: sentences are grouped by their own length and run in batches
of one fixed shape, because a matrix product adds up in another order when its shape changes.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from logging import CRITICAL
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer
from torch import Tensor

from models.text_encoder.folder import SentenceModel, TokenPooling, packaged_folder, read_folder
from stable_data.assets.text_embeddings import Rows
from stable_data.errors import ConfigError

_BATCH = 8  # sentences: a single one costs as much as eight
_LENGTH_STEP = 8  # tokens
_MAX_CHARACTERS = 1 << 15  # far more than the tokens that are kept, so that no text keeps the tokenizer busy


class SentenceEncoder:
    """A sentence encoder; weights are read when the first sentence comes.

    Args:
        folder: A local folder in the sentence-transformers layout.
        device: Where it runs.

    Attributes:
        model: What the folder says.

    Raises:
        ConfigError: The folder is no such model.
    """

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        self.model: SentenceModel = read_folder(folder)
        self._device = torch.device(device)

    @property
    def fingerprint(self) -> str:
        """Hash of the weights and of all that shapes the rows."""
        return self.model.fingerprint

    def __call__(self, texts: Sequence[str], /) -> Rows:
        """Unit rows of sentences, (N, D) float32; texts that are too long are cut.

        Raises:
            ConfigError: The weights or the tokenizer cannot be read.
        """
        words = [text.lower() if self.model.lowers else text for text in texts]
        # Surrogates that no UTF-8 has would end the tokenizer.
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
        """The transformer, every weight of it from the file."""
        from transformers import AutoModel

        with _quiet():
            try:
                network, found = AutoModel.from_pretrained(
                    self.model.folder,
                    local_files_only=True,
                    trust_remote_code=False,
                    use_safetensors=True,
                    dtype=torch.float32,
                    output_loading_info=True,
                )
            except Exception as error:
                reason = f"{type(error).__name__}: {error}".partition("\n")[0]
                message = f"{self.model.folder}: cannot be loaded ({reason}), expected a transformer; fetch the model again"
                raise ConfigError(message, "model_invalid") from error
        # What is missing would be left at random; a pooler is not used.
        missing = sorted(name for name in found["missing_keys"] if not name.startswith("pooler."))
        if missing:
            message = f"{self.model.folder}: model.safetensors lacks {len(missing)} weights, {missing[0]} first"
            raise ConfigError(f"{message}, expected those of its config.json; fetch the model again", "model_invalid")
        return network.eval().requires_grad_(False).to(self._device)

    @property
    def _width(self) -> int:
        return int(self._network.config.hidden_size)

    def _encode(self, tokens: Sequence[Sequence[int]], length: int) -> Rows:
        """Unit rows of one batch, (8, D) float32; those after its sentences mean nothing.

        Args:
            tokens: At most eight sentences.
            length: What they are padded to.
        """
        padding = self._network.config.pad_token_id or 0
        ids = torch.full((_BATCH, length), padding, dtype=torch.long)  # (8, T)
        mask = torch.zeros((_BATCH, length), dtype=torch.long)
        mask[:, 0] = 1  # a row without any token would be 0 / 0
        for row, sentence in enumerate(tokens):
            ids[row, : len(sentence)] = torch.tensor(sentence)
            mask[row, : len(sentence)] = 1
        ids, mask = ids.to(self._device), mask.to(self._device)
        with torch.inference_mode():
            states = self._network(input_ids=ids, attention_mask=mask).last_hidden_state  # (8, T, D)
            pooled = torch.nn.functional.normalize(_pooled(states, mask, self.model.pooling), dim=-1)
        rows: Rows = pooled.cpu().numpy()
        return rows


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps transformers from drawing bars and reports: what matters of them is an error of ours."""
    from transformers.utils import logging

    verbosity, had_bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if had_bar:
            logging.enable_progress_bar()


def load_default(device: str = "cpu") -> SentenceEncoder:
    """The packaged all-MiniLM-L6-v2: 384 numbers a sentence.

    Raises:
        ConfigError: The package that carries it is not installed.
    """
    return SentenceEncoder(packaged_folder(), device)


def _by_length(tokens: Sequence[Sequence[int]]) -> Iterable[tuple[int, list[int]]]:
    """Sentences grouped by what each is padded to."""
    groups: dict[int, list[int]] = {}
    for index, sentence in enumerate(tokens):
        groups.setdefault(-(-len(sentence) // _LENGTH_STEP) * _LENGTH_STEP, []).append(index)
    return sorted(groups.items())


def _pooled(states: Tensor, mask: Tensor, pooling: TokenPooling) -> Tensor:
    """One vector a sentence, (8, D), of its tokens' (8, T, D)."""
    if pooling is TokenPooling.CLS:
        return states[:, 0]
    weight = mask.unsqueeze(-1).to(states.dtype)  # (8, T, 1)
    if pooling is TokenPooling.MAX:
        return states.masked_fill(weight == 0, -torch.inf).amax(dim=1)
    total, count = (states * weight).sum(dim=1), weight.sum(dim=1)
    return total / (count if pooling is TokenPooling.MEAN else count.sqrt())
