"""Models of Hugging Face in local folders: nothing is downloaded, no code of a folder is run, and no weight is left to chance."""

from collections.abc import Iterator
from contextlib import contextmanager
from logging import CRITICAL
from pathlib import Path
from typing import Any

from stable_data.errors import ConfigError


def load_local(folder: Path, expected: str, *, unused: tuple[str, ...] = (), with_processor: bool = False) -> tuple[Any, Any]:
    """Loads a model in float32, for inference on the CPU, with all weights from its file.

    Args:
        folder: Its folder, with config.json and model.safetensors.
        expected: What it should be, for messages.
        unused: Beginnings of the names of weights that may be missing, because they are not used.
        with_processor: Whether to load what prepares pictures, too.

    Returns:
        The model, and what prepares pictures for it, or None.

    Raises:
        ConfigError: It cannot be loaded, or weights are missing (``model_invalid``).
    """
    # Imported here: most programs that may need a model do not load one, and what prepares pictures takes seconds to import.
    import torch
    from transformers import AutoModel

    with _quiet():
        try:
            model, found = AutoModel.from_pretrained(
                folder,
                local_files_only=True,
                trust_remote_code=False,
                use_safetensors=True,
                dtype=torch.float32,
                output_loading_info=True,
            )
            processor = None
            if with_processor:
                from transformers import AutoImageProcessor

                processor = AutoImageProcessor.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".partition("\n")[0]
            message = f"{folder}: cannot be loaded ({reason}), expected {expected}; fetch the model again"
            raise ConfigError(message, "model_invalid") from error
    missing = sorted(name for name in found["missing_keys"] if not name.startswith(unused))  # these would be random
    if missing:
        message = f"{folder}: model.safetensors lacks {len(missing)} weights, {missing[0]} first"
        raise ConfigError(f"{message}, expected those of its config.json; fetch the model again", "model_invalid")
    return model.eval().requires_grad_(False), processor


@contextmanager
def _quiet() -> Iterator[None]:
    """Disables progress bars and reports of transformers; missing weights are reported by this module."""
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
