"""The file ``manifest.json`` of a run: its job, settings, fingerprints, versions and counts."""

import json
from collections.abc import Mapping
from typing import Any

from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder


def read_manifest(folder: RunFolder) -> dict[str, Any] | None:
    """The manifest in a folder, or None if there is none.

    Raises:
        ConfigError: The file is not a manifest (``manifest_invalid``).
    """
    try:
        document = folder.read_document("manifest.json")
        if document is None:
            return None
        found = dict(document)
        return found | {key: dict(found.get(key, {})) for key in ("settings", "inputs")}
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"{folder.uri}/manifest.json: not a JSON object ({error}); is this the folder of a run?", "manifest_invalid"
        ) from error


def write_manifest(folder: RunFolder, manifest: Mapping[str, Any]) -> None:
    """Writes ``manifest.json``."""
    text = json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
    folder.write_bytes("manifest.json", text.encode())
