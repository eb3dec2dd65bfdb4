"""Which code a run was made with, where it is stopped and goes on with other sources."""

import sys
from collections.abc import Mapping
from typing import Any

from tqdm import tqdm

from stable_data.code_version import code_version, release_of


def with_release(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest for comparing: of its ``code_version`` the version alone, without the hash of the sources."""
    return {**manifest, "code_version": release_of(str(manifest.get("code_version")))}


def take_over_code(was: Mapping[str, Any], manifest: dict[str, Any]) -> None:
    """Puts into the manifest of a run that goes on which code made what is there.

    Args:
        was: Its former manifest.
        manifest: That of the run that goes on; :func:`record_code` adds to it.
    """
    former = [str(code) for code in was.get("code_versions") or [was.get("code_version")]]
    manifest |= {"code_version": former[-1], "code_versions": former}


def record_code(where: str, manifest: dict[str, Any]) -> bool:
    """Puts the code of now into a run's manifest, last of ``code_versions``; where that makes them another list, it is said.

    To be called before anything is made, and not where nothing is missing: then no row is of the code of now.

    Other sources of the same version do not stop a run: what mends it is often a change of them, and its rows must not be lost for it.
    But it is no longer one program's, which must be seen.

    Args:
        where: The run's folder.
        manifest: Its manifest.

    Returns:
        Whether the manifest is another now.
    """
    was, now = list(manifest["code_versions"]), code_version()
    versions = [*(code for code in was if code != now), now]
    manifest |= {"code_version": now, "code_versions": versions}
    if versions != was:
        tqdm.write(
            f"{where}: was worked on with other code ({', '.join(versions[:-1])}), what is missing is done with {now}; if all is "
            "to be of one, go back to that code or choose a new folder",
            file=sys.stderr,
        )
    return versions != was
