"""What the trainings share: their manifest, their log, and how they are stopped."""

import json
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from pipelines.execution.code_history import record_code, take_over_code, with_release
from stable_data.config_diff import differences, flat
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder


def event_log(folder: Path, step: int) -> Any:
    """A writer of TensorBoard's files; what an earlier process logged of later steps is hidden."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step + 1, flush_secs=20)


def on_signals(stopped: threading.Event) -> dict[int, Any]:
    """Lets an interrupt or termination end the run after its step; gives the former handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}  # a worker of Ray: its driver passes the end on

    def stop(number: int, frame: object) -> None:
        stopped.set()

    return {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}


def here() -> torch.device:
    """The device of a training in this process."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def refuse_changes(folder: RunFolder, manifest: dict[str, Any], compared: Sequence[str]) -> None:
    """Refuses to go on with a training of other settings, data or version.

    Args:
        folder: The training's folder.
        manifest: Of the training that is to start. Other sources of the same version are not refused, but said, and put into
            its ``code_versions``, see :func:`pipelines.execution.code_history.record_code`.
        compared: Keys of it that must be as they were, beside ``settings``.

    Raises:
        ConfigError: Something differs, or the manifest there is none.
    """
    content = folder.read_bytes("manifest.json")
    if content is None:
        return
    try:
        was = dict(json.loads(content))
        was_settings = dict(was.get("settings", {}))
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"{folder.uri}/manifest.json: not a JSON object ({error}); is this the folder of a run?", "manifest_invalid"
        ) from error
    before, now = with_release(was), with_release(manifest)
    changed = differences({k: before.get(k) for k in compared}, {k: now[k] for k in compared})
    changed += differences(flat(was_settings), flat(manifest["settings"]))
    if changed:
        raise ConfigError(
            f"{folder.uri}: was made with another configuration ({'; '.join(changed)}); choose a new folder or restore it",
            "config_changed",
        )
    take_over_code(was, manifest)
    if was.get("status") != "complete":
        record_code(folder.uri, manifest)


def as_json(document: dict[str, Any]) -> bytes:
    """A document as the text of a file."""
    return (json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode()
