"""The input of the edit job: a file with one edit in each line, which becomes a scene or a failure."""

import json
import re
from collections import Counter
from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.json_text import bounded_lines, json_value, quote_value
from stable_data.limits import LIMITS, at_most

KEYS = ("scene_id", "instruction", "edit_id", "reply")

_PLAIN = re.compile(r"[\w.-]+(?:/[\w.-]+)*")


@dataclass(frozen=True, slots=True)
class EditRequest:
    """A requested edit.

    Attributes:
        edit_id: The id of the edited scene.
        scene_id: The scene to edit.
        instruction: The requested change, in words.
        reply: The text of a given reply, or None to ask the reasoner.
    """

    edit_id: str
    scene_id: str
    instruction: str
    reply: str | None = None


@dataclass(frozen=True, slots=True)
class EditFile:
    """A file of edits.

    Attributes:
        edits: The valid edits, in order.
        failures: One notice for each invalid line.
    """

    edits: tuple[EditRequest, ...]
    failures: tuple[Notice, ...]

    @property
    def ids(self) -> list[str]:
        """The ids of all lines, failures last."""
        return [*(edit.edit_id for edit in self.edits), *(notice.item_id for notice in self.failures)]


def read_edits(path: Path, scene_ids: Container[str]) -> EditFile:
    """Reads edits, one JSON object in each line: ``scene_id``, ``instruction``, and optionally ``edit_id`` and ``reply``.

    Args:
        path: The file. Empty lines are skipped; an invalid line becomes a failure.
        scene_ids: The ids of the existing scenes.

    Returns:
        The edits. The default id of the k-th edit of a scene is ``<scene_id>_edit<k>``, counted from 1. A failure is named by
        its line, such as ``line 000002``; the space keeps it apart from ids of edits.

    Raises:
        ConfigError: The file cannot be read, or contains no line (``edits_invalid``); it has too many lines (``too_many_lines``).
    """
    try:
        lines = list(bounded_lines(path))
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}), expected one JSON object in each line", "edits_invalid"
        ) from error
    edits: dict[str, EditRequest] = {}
    failures: list[Notice] = []
    count: Counter[str] = Counter()
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            edit = _edit_of(line, count)
            if edit.edit_id in edits or edit.edit_id in scene_ids:
                raise SceneError(
                    f"edit_id {edit.edit_id} is the id of another edit or of a scene, expected a unique id", "edit_invalid"
                )
            if edit.scene_id not in scene_ids:
                raise SceneError(
                    f"scene {edit.scene_id} is not among the scenes; are these the edits of this folder?", "scene_unknown"
                )
        except SceneError as error:
            failures.append(Notice(f"line {number:06d}", "edits", error.code, f"{path.name}, line {number}: {error}"))
        else:
            edits[edit.edit_id] = edit
    if not edits and not failures:
        raise ConfigError(f"{path}: contains no edits, expected one JSON object in each line", "edits_invalid")
    return EditFile(tuple(edits.values()), tuple(failures))


def _edit_of(line: str, count: Counter[str]) -> EditRequest:
    try:
        data = json_value(line)
    except ValueError as error:
        raise SceneError(f"is not JSON ({error})", "edit_invalid") from error
    if not isinstance(data, dict):
        raise SceneError(f"is {type(data).__name__}, expected an object", "edit_invalid")
    if unknown := sorted(data.keys() - set(KEYS)):
        raise SceneError(f"has {quote_value(unknown[0])}, expected only {', '.join(KEYS)}", "edit_invalid")
    scene_id, instruction = _words(data, "scene_id"), _words(data, "instruction")
    if len(instruction) > LIMITS.text.max_instruction:
        most = at_most(LIMITS.text, "max_instruction", "characters")
        raise SceneError(f"has an instruction of {len(instruction):,} characters, expected {most}", "instruction_invalid")
    count[scene_id] += 1
    edit_id = _words(data, "edit_id") if "edit_id" in data else f"{scene_id}_edit{count[scene_id]}"
    if not _PLAIN.fullmatch(edit_id) or set(edit_id.split("/")) & {".", ".."}:
        raise SceneError(f"edit_id is {quote_value(edit_id)}, expected a plain name", "edit_invalid")
    reply = data.get("reply")
    if reply is not None and not isinstance(reply, str):
        reply = json.dumps(reply, ensure_ascii=False)
    return EditRequest(edit_id, scene_id, instruction, reply)


def _words(data: dict[str, Any], key: str) -> str:
    found = data.get(key)
    if not isinstance(found, str) or not found.strip():
        raise SceneError(
            f"has {key} {quote_value(found)}, expected text", "instruction_invalid" if key == "instruction" else "edit_invalid"
        )
    return found.strip()
