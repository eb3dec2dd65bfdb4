"""Which code a run was made with, where it is stopped and goes on with other sources."""

import sys
from collections.abc import Mapping
from typing import Any

from tqdm import tqdm

from stable_data.code_version import code_version, release_of


def with_release(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest for comparing: of its ``code_version`` the version alone, without the hash of the sources."""
    return {**manifest, "code_version": release_of(str(manifest.get("code_version")))}


def record_code(where: str, was: Mapping[str, Any], manifest: dict[str, Any]) -> None:
    """Puts ``code_versions`` into the manifest of a run that goes on: all that it was started with, that of now last.

    Where they are several, that is said.

    Other sources of the same version do not stop a run: what mends it is often a change of them, and its rows must not be lost for it.
    But it is no longer one program's, which must be seen.

    Args:
        where: The run's folder.
        was: Its former manifest.
        manifest: That of the run that goes on.
    """
    former = dict.fromkeys(map(str, was.get("code_versions") or [was.get("code_version")]))
    versions = [*(code for code in former if code != code_version()), code_version()]
    manifest["code_versions"] = versions
    if len(versions) > 1:
        tqdm.write(
            f"{where}: was begun with other code ({', '.join(versions[:-1])}), what is missing is done with {versions[-1]}; if all is "
            "to be of one, go back to that code or choose a new folder",
            file=sys.stderr,
        )
