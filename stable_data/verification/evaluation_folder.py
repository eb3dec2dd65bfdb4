"""Verifies the folder of an evaluation, ``pipelines evaluate``: every run in it, and that none of those of its systems is missing."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import PurePosixPath

import pyarrow.fs as pafs

from stable_data.json_text import document_of, quote_value
from stable_data.limits import LIMITS
from stable_data.storage.manifest import DIGEST, MANIFEST, manifest_digest
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.findings import Finding, Findings
from stable_data.verification.verifier import Progress, Tell, Verification, VerifyOptions, verify_run

EVALUATION = "evaluation.json"
"""The file that says that a folder is one of an evaluation."""

_DEPTH = 3  # seed_0/stable/scenes


def is_evaluation(folder: RunFolder) -> bool:
    """Whether a folder is one of an evaluation.

    Raises:
        ConfigError: The folder cannot be read.
    """
    return folder.has_file(EVALUATION)


def verify_evaluation(
    folder: RunFolder, tell: Tell, options: VerifyOptions, progress: Progress | None = None
) -> Iterator[Verification]:
    """Verifies each run of an evaluation, the folder itself first; the arguments are those of :func:`verify_run`.

    Raises:
        ConfigError: A folder cannot be read.
    """
    runs = _runs_in(folder)
    yield _verify_folder(folder, runs, tell)
    for name in runs:
        run = RunFolder(_below(folder, name))
        scenes = f"{name.rpartition('/')[0]}/scenes"
        source = RunFolder(_below(folder, scenes)) if scenes in runs and scenes != name else options.source

        def tell_of_run(finding: Finding, name: str = name) -> None:
            tell(replace(finding, where=f"{name}/{finding.where}"))

        yield verify_run(run, tell_of_run, replace(options, source=source), progress)


def _verify_folder(folder: RunFolder, runs: list[str], tell: Tell) -> Verification:
    """Verifies ``evaluation.json``."""
    findings, systems = Findings(tell), dict[str, object]()
    try:
        document = document_of(folder.read_bytes(EVALUATION, LIMITS.text.max_document_bytes + 1) or b"")
        systems = {str(label): entry["repetitions"] for label, entry in document["systems"].items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        findings.damage(EVALUATION, f"is no evaluation ({type(error).__name__}: {error})")
        document = {}
    if document and document.get(DIGEST) is None:
        findings.cannot_know("evaluation.json has no digest: it is older, and its figures may have been edited")
    elif document and document[DIGEST] != manifest_digest(document):
        findings.damage(EVALUATION, f"its digest is {document[DIGEST]!r:.70}, expected another: a figure was edited")
    for label, repetitions in systems.items():
        found = sum(name.endswith(f"/{label}/scenes") for name in runs)
        if not isinstance(repetitions, int) or found < repetitions:
            named = f"{quote_value(repetitions)} repetitions of {quote_value(label)}"
            findings.damage(EVALUATION, f"names {named}, but {found} runs of it are there")
    return Verification(
        folder.uri, "evaluate", True, dict(findings.num_damaged), tuple(findings.unknown), 0, 0, {}, 0, 0, 0, 0.0
    )


def _runs_in(folder: RunFolder) -> list[str]:
    """The names of the runs in a folder, sorted."""
    found, level = list[str](), [""]
    for _ in range(_DEPTH):
        below = list[str]()
        for name in level:
            infos = folder.filesystem.get_file_info(
                pafs.FileSelector(f"{folder.root}/{name}".rstrip("/"), allow_not_found=True)
            )
            for info in infos:
                if info.type == pafs.FileType.Directory and not info.base_name.startswith("."):
                    below.append(f"{name}/{PurePosixPath(info.path).name}".lstrip("/"))
        runs = [name for name in below if folder.has_file(f"{name}/{MANIFEST}")]
        found += runs
        level = [name for name in below if name not in runs]
    return sorted(found)


def _below(folder: RunFolder, name: str) -> str:
    """The address of a folder in another one; options of a URI stay at its end."""
    place, mark, options = folder.uri.partition("?")
    return f"{place.rstrip('/')}/{name}{mark}{options}"
