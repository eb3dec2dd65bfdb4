"""Text embeddings as unit rows: the protocol of a text encoder, and a cache file for its rows.

The library contains no model; the caller passes one. Rows of different encoders cannot be compared, so each encoder has the
fingerprint of its weights.
"""

import hashlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError, cannot_write
from stable_data.storage.parquet_files import open_parquet

Rows: TypeAlias = npt.NDArray[np.float32]
"""One unit row for each text, (N, D) float32, compared by dot product."""

_UNIT_TOLERANCE = 1e-3
_FINGERPRINT = b"stable_data.encoder_fingerprint"


class TextEncoder(Protocol):
    """Converts sentences to unit rows; the row of a sentence depends on that sentence alone."""

    @property
    def fingerprint(self) -> str:
        """Identifies the weights: encoders with the same fingerprint compute the same rows."""
        ...

    def __call__(self, texts: Sequence[str], /) -> Rows:
        """Computes unit rows, (N, D) float32."""
        ...


def check_rows(rows: npt.ArrayLike, num: int, where: str) -> Rows:
    """Checks that rows can be compared, and returns them as contiguous float32.

    Args:
        rows: Expected to be (N, D), finite and of unit length.
        num: N.
        where: Origin of the rows, for the message.

    Raises:
        ConfigError: The rows are not as expected (``features_invalid``).
    """
    found = np.ascontiguousarray(rows, np.float32)
    if found.ndim != 2 or len(found) != num or (num > 0 and found.shape[1] == 0) or not np.isfinite(found).all():
        message = f"{where}: features have shape {found.shape} or are not finite, expected finite ({num}, D)"
        raise ConfigError(f"{message}; encode the texts again", "features_invalid")
    norms = np.sqrt(np.einsum("nd,nd->n", found, found, dtype=np.float64))
    if num and np.abs(norms - 1).max() > _UNIT_TOLERANCE:
        worst = norms[np.abs(norms - 1).argmax()]
        raise ConfigError(f"{where}: a feature has length {worst:.4g}, expected unit rows; normalise them", "features_invalid")
    return found


def embed_texts(texts: Sequence[str], encoder: TextEncoder, cache: Path | None = None) -> Rows:
    """Computes the rows of texts; equal texts are encoded once.

    Args:
        texts: N sentences.
        encoder: The encoder.
        cache: A Parquet file of texts and their rows from this encoder. Its texts are not encoded again; missing texts are added
            atomically.

    Returns:
        (N, D) float32.

    Raises:
        ConfigError: The file is from another encoder (``features_of_another_encoder``), cannot be read or written; or the
            encoder does not return unit rows.
    """
    distinct = list(dict.fromkeys(texts))
    if not distinct:
        return np.zeros((0, 0), np.float32)
    encoded, known = ([], np.zeros((0, 0), np.float32)) if cache is None else _read(cache, encoder.fingerprint)
    place = {text: k for k, text in enumerate(encoded)}
    missing = [text for text in distinct if text not in place]
    if missing:
        new = check_rows(encoder(missing), len(missing), "the text encoder")
        if encoded and known.shape[1] != new.shape[1]:
            message = f"{cache} contains features of {known.shape[1]} numbers, but the encoder returns {new.shape[1]}"
            raise ConfigError(f"{message}; delete the file or choose another file", "features_of_another_encoder")
        known = np.concatenate([known, new]) if encoded else new
        encoded = [*encoded, *missing]
        place = {text: k for k, text in enumerate(encoded)}
        if cache is not None:
            _write(cache, encoded, known, encoder.fingerprint)
    return np.ascontiguousarray(known[[place[text] for text in texts]])


def share_rows(rows: Rows, folder: Path) -> Rows:
    """Returns the same rows from a file that all processes of a user map into memory; the rows themselves if that is impossible.

    Args:
        rows: (N, D) float32.
        folder: The folder of such files, which are named by their content.
    """
    path = folder / f"{hashlib.sha256(rows.data).hexdigest()[:32]}-{rows.shape[1]}.npy"
    try:
        if not path.exists():
            content = io.BytesIO()
            np.save(content, rows, allow_pickle=False)
            folder.mkdir(parents=True, exist_ok=True)
            write_file_atomically(path, content.getvalue())
        shared = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return rows
    return shared if shared.dtype == rows.dtype and np.array_equal(shared, rows) else rows


def _read(cache: Path, fingerprint: str) -> tuple[list[str], Rows]:
    """Reads the texts and rows of a cache file; both are empty if it does not exist."""
    if not cache.exists():
        return [], np.zeros((0, 0), np.float32)
    try:
        with open_parquet(cache) as file:  # opened once: another process may replace the file
            table = file.read()
        found = (table.schema.metadata or {}).get(_FINGERPRINT, b"").decode()
        texts = table["text"].to_pylist()
        values = table["feature"].combine_chunks()
        rows = values.flatten().to_numpy(zero_copy_only=False).reshape(len(texts), -1)
    except (pa.ArrowException, OSError, KeyError, ValueError, AttributeError) as error:
        reason = str(error).strip().partition("\n")[0]
        message = f"{cache} cannot be read ({reason}), expected a Parquet file of text features; delete the file; it is then written again"
        raise ConfigError(message, "features_invalid") from error
    if found != fingerprint:
        message = f"{cache} contains features of encoder {found or 'unknown'}, expected {fingerprint}"
        raise ConfigError(f"{message}; delete the file or choose another file", "features_of_another_encoder")
    return texts, check_rows(rows, len(texts), str(cache))


def _write(cache: Path, texts: Sequence[str], rows: Rows, fingerprint: str) -> None:
    features = pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), rows.shape[1]).cast(pa.list_(pa.float32()))
    table = pa.table({"text": pa.array(texts, pa.string()), "feature": features})
    sink = pa.BufferOutputStream()
    pq.write_table(table.replace_schema_metadata({_FINGERPRINT: fingerprint}), sink)
    try:
        cache.parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(cache, sink.getvalue().to_pybytes())
    except OSError as error:
        raise cannot_write(str(cache), error) from error
