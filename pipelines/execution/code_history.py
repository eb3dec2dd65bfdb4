"""Which versions of the code made a run that was stopped and resumed."""

import sys
from collections.abc import Mapping
from typing import Any

from tqdm import tqdm

from stable_data.code_version import code_version, release_of


def with_release(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest for comparison: its ``code_version`` without the hash of the sources."""
    return {**manifest, "code_version": release_of(str(manifest.get("code_version")))}


def take_over_code(was: Mapping[str, Any], manifest: dict[str, Any]) -> None:
    """Copies the code versions of a former manifest into the manifest of the resumed run.

    Args:
        was: The former manifest.
        manifest: The manifest of the resumed run; :func:`record_code` adds the current version.
    """
    former = [str(code) for code in was.get("code_versions") or [was.get("code_version")]]
    manifest |= {"code_version": former[-1], "code_versions": former}


def record_code(where: str, manifest: dict[str, Any]) -> bool:
    """Adds the current code version to the end of ``code_versions`` in a manifest, and prints a line if that changes the list.

    Call it before the first row is made, and only if rows are missing: otherwise no row is of the current code.

    Changed source code of the same version does not stop a run, because a change of the code is often what repairs the run. The
    rows are then of several versions, so the manifest lists them.

    Args:
        where: The run's folder, for the message.
        manifest: Its manifest; changed in place.

    Returns:
        Whether the manifest has changed.
    """
    was, now = list(manifest["code_versions"]), code_version()
    versions = [*(code for code in was if code != now), now]
    manifest |= {"code_version": now, "code_versions": versions}
    if versions != was:
        tqdm.write(
            f"{where}: earlier rows were made with other code ({', '.join(versions[:-1])}), missing rows are made with {now}; for "
            "rows of one version, return to that code or choose a new folder",
            file=sys.stderr,
        )
    return versions != was
