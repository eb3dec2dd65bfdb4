"""Repairs the scene files of a folder, one after the other, and writes the copies and a table of verdicts."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, Generic, TypeVar, TypeVarTuple

import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure
from pipelines.scene_files.repair import BodyReport, Repair, RepairOptions, repair_states
from stable_data.errors import ConfigError, MeshError, SceneError, StableDataError, cannot_write
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.copies import CopyWriter
from stable_data.importers.scenes.lint import no_scene_error, scene_candidates
from stable_data.limits import LIMITS, at_most

R = TypeVar("R")
Arguments = TypeVarTuple("Arguments")

VERDICTS = "repair.parquet"
"""The table of verdicts in the output folder."""


class RepairStatus(StrEnum):
    """The outcome for a scene file."""

    FINE = "fine"
    """It was clean and at rest, and nothing had fallen."""

    REPAIRED = "repaired"
    """It is clean and at rest now."""

    UNSOLVED = "unsolved"
    """It is still not clean or not at rest; what became better is written."""

    FAILED = "failed"
    """It could not be read or written; ``code`` and ``message`` say why."""


@dataclass(frozen=True, slots=True)
class FileVerdict:
    """A row of the table of verdicts.

    Attributes:
        path: The file, relative to the source folder.
        status: The outcome.
        code: Why it failed, as a short code; else empty.
        message: The same in one line; for an unsolved file what is left.
        clean_before: Whether it was clean by the exact audit; None if unknown.
        clean_after: Whether the repaired file is.
        rest_before: Whether all its free bodies stayed at rest in its physics; None if unknown.
        rest_after: Whether those of the repaired file do.
        bodies: What was done to each free body.
    """

    path: str
    status: RepairStatus
    code: str = ""
    message: str = ""
    clean_before: bool | None = None
    clean_after: bool | None = None
    rest_before: bool | None = None
    rest_after: bool | None = None
    bodies: tuple[BodyReport, ...] = ()

    @classmethod
    def of(cls, repair: Repair) -> "FileVerdict":
        """The row of a repair."""
        solved = repair.is_clean is True and repair.is_at_rest is True
        has_moved = any(body.move or body.turn for body in repair.bodies)
        status = (RepairStatus.REPAIRED if has_moved else RepairStatus.FINE) if solved else RepairStatus.UNSOLVED
        left = [s.reason for s in repair.surfaces if s.reason and s.audit_after.card().clean is not True]
        left += [f"{b.name} does not stay at rest" for b in repair.bodies if b.rest_after is False]
        verdicts = (repair.was_clean, repair.is_clean, repair.was_at_rest, repair.is_at_rest)
        return cls(repair.path, status, "", "" if solved else "; ".join(left), *verdicts, repair.bodies)

    @classmethod
    def failed(cls, path: str, error: StableDataError) -> "FileVerdict":
        """The row of a file that could not be used."""
        return cls(path, RepairStatus.FAILED, error.code, str(error))

    def lines(self) -> list[str]:
        """The verdict as text, with a line for each body that moved or is still at fault."""
        if self.status is RepairStatus.FAILED:
            return [f"{self.path}: failed ({self.code}): {self.message}"]
        before = f"{_said(self.clean_before, 'clean')}, {_said(self.rest_before, 'at rest')}"
        after = f"{_said(self.clean_after, 'clean')}, {_said(self.rest_after, 'at rest')}"
        noun = "body" if len(self.bodies) == 1 else "bodies"
        head = f"{self.path}: {self.status}, {len(self.bodies)} free {noun}; before: {before}; after: {after}"
        lines = [head + (f"; {self.message}" if self.message else "")]
        for body in self.bodies:
            if body.move or body.turn or body.faults_after or body.rest_after is False:
                was = [*body.faults_before, *(["not at rest"] if body.rest_before is False else []), body.uprighted]
                now = [*body.faults_after, *(["not at rest"] if body.rest_after is False else [])]
                moved = f"moved {1e3 * body.move:.1f} mm, turned {body.turn:.1f} degrees"
                said = "; ".join(filter(None, was)) or "made room"
                lines.append(
                    f"  {body.name} on {body.surface}: {moved} ({said})" + (f"; still: {'; '.join(now)}" if now else "")
                )
        return lines


def _said(verdict: bool | None, name: str) -> str:
    return f"{name} not known" if verdict is None else name if verdict else f"not {name}"


def repair_folder(
    root: Path, paths: Sequence[str] | None, out: Path | None, options: RepairOptions, *, progress: bool = False
) -> Iterator[FileVerdict]:
    """Repairs scene files and writes them.

    Args:
        root: The source folder; nothing outside of it is read.
        paths: The files, relative to it; None: all scene files in it.
        out: Folder of the copies, which are complete: each scene with all its files. None: changed files replace the originals.
        options: What the user says about the files.
        progress: Whether to show a progress bar.

    Yields:
        The verdict on each file, or on each of its states with the key ``all``. Files of a folder that hold no free body, or are
        parts of others, are left out.

    Raises:
        ConfigError: The folder does not exist, holds no scene, or the output cannot be written.
    """
    isolates = paths is None
    found = scene_candidates(root) if paths is None else list(paths)
    writer = CopyWriter(root, out)
    used: set[str] = set()
    failures: list[FileVerdict] = []
    num_repaired = 0
    with IsolatedProcess() as process:
        for path in tqdm(found, desc="repair", unit="file", disable=not progress):
            try:
                repairs = call_for_file(process if isolates else None, path, _repair, root, path, options)
                used |= set(repairs[-1].files) - {path}
                writer.write(path, repairs[-1].files, repairs[-1].changed)
            except ConfigError:
                raise
            except StableDataError as error:
                failures.append(FileVerdict.failed(path, error))
                continue
            num_repaired += 1
            yield from map(FileVerdict.of, repairs)
    left = [v for v in failures if not isolates or (v.code != "no_free_body" and v.path not in used)]
    if not num_repaired and not left:
        raise no_scene_error(root, len(found))
    yield from left


def call_for_file(process: IsolatedProcess | None, path: str, function: Callable[[*Arguments], R], *arguments: *Arguments) -> R:
    """Calls a function for a scene file: in a separate process, which a hostile file may crash, or in this one.

    Args:
        process: The separate process; None: this process.
        path: The file or folder, for messages.
        function: The function, picklable.
        arguments: Its arguments.

    Raises:
        StableDataError: The file cannot be used; an unexpected error (``unexpected``) and the end of the process too.
    """
    if process is None:
        return function(*arguments)
    found: _Result[R] | StableDataError | ProcessFailure
    found = process.call(_guarded, path, function, arguments, seconds=LIMITS.item.max_scene_file_seconds)
    if isinstance(found, ProcessFailure):
        seconds = f"took more time, expected {at_most(LIMITS.item, 'max_scene_file_seconds', 's')}"
        how = seconds if found is ProcessFailure.TIMED_OUT else found.told(0.0)
        raise MeshError(f"{path}: {how}; is it hostile?", str(found))
    if isinstance(found, StableDataError):
        raise found
    return found.value


@dataclass(frozen=True, slots=True)
class _Result(Generic[R]):
    """What a function has returned in another process."""

    value: R


def _guarded(path: str, function: Callable[[*Arguments], R], arguments: tuple[*Arguments]) -> "_Result[R] | StableDataError":
    """The result of a function, or its error, which loses less on its way through a pipe than a raised one."""
    try:
        return _Result(function(*arguments))
    except StableDataError as error:
        return error
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - an unexpected error costs one file
        return SceneError(f"{path}: unexpected {type(error).__name__}: {error}; please report it with the file", "unexpected")


def _repair(root: Path, path: str, options: RepairOptions) -> tuple[Repair, ...]:
    return repair_states(Boundary(root), path, options)


_BODY = pa.struct(
    [
        ("name", pa.string()),
        ("surface", pa.string()),
        ("uprighted", pa.string()),
        ("move", pa.float64()),
        ("turn", pa.float64()),
        ("faults_before", pa.list_(pa.string())),
        ("faults_after", pa.list_(pa.string())),
        ("rest_before", pa.bool_()),
        ("rest_after", pa.bool_()),
    ]
)
_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("path", "status", "code", "message")),
        *((name, pa.bool_()) for name in ("clean_before", "clean_after", "rest_before", "rest_after")),
        ("bodies", pa.list_(_BODY)),
    ]
)


def write_verdicts(verdicts: Sequence[FileVerdict], path: Path) -> None:
    """Writes the table of verdicts as Parquet; moves in metres, turns in degrees.

    Raises:
        ConfigError: The file cannot be written.
    """
    rows: list[dict[str, Any]] = []
    for verdict in verdicts:
        row: dict[str, Any] = {f.name: getattr(verdict, f.name) for f in fields(FileVerdict)}
        bodies = [{f.name: getattr(body, f.name) for f in fields(BodyReport)} for body in verdict.bodies]
        rows.append(row | {"status": str(verdict.status), "bodies": bodies})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(rows, schema=_SCHEMA), path)
    except OSError as error:
        raise cannot_write(str(path), error) from error
