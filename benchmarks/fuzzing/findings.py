"""Findings on disk: those of a campaign, and the stored inputs of what once broke."""

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.cases import Case
from benchmarks.fuzzing.watching import ROOT, Finding
from stable_data.code_version import code_version, digest_of

_ABOUT = "finding.json"
_NO_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_MOST_NAME = 120  # characters: a name of a file has at most 255 bytes
_FUZZER = ("benchmarks/fuzzing",)


@dataclass(slots=True)
class KnownFinding:
    """A finding of a target; of several inputs with the same one, the first.

    Attributes:
        target: The target.
        number: The number of the input.
        base: Its base.
        path: The file that it changes.
        finding: What is wrong.
        count: How many inputs had it.
        is_reduced: Whether it was tried to make the input smaller.
        is_mended: Whether the input ended well when it was run again with other code.
        code: The code with which an input last had it, :func:`code_of_campaign`; empty if it is not known.
        not_again: How often the input ended well when it was run again with the same code: it depends on something else, too.
    """

    target: str
    number: int
    base: str
    path: str
    finding: Finding
    count: int = 1
    is_reduced: bool = False
    is_mended: bool = False
    code: str = ""
    not_again: int = 0

    @property
    def folder(self) -> str:
        """Its folder below the folder of findings: ``target/base/what-hash``; the hash is of the whole key, of which names show a part."""
        what = _NO_NAME.sub("_", f"{self.finding.kind} {self.finding.type} {self.finding.frame}").strip("_")
        return f"{self.target}/{self.base}/{what[:_MOST_NAME]}-{hashlib.sha256(self.finding.key.encode()).hexdigest()[:8]}"


@cache
def code_of_campaign() -> str:
    """Returns the version of the code of the toolkit and of the fuzzer: a finding can be mended by a change of either."""
    return f"{code_version()}+{digest_of(ROOT, _FUZZER)}"


def write_finding(out: Path, known: KnownFinding, content: bytes) -> None:
    """Writes the changed file of a finding, and what is known about it."""
    folder = out / known.folder
    place = folder / known.path
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(content)
    (folder / _ABOUT).write_text(json.dumps(about(known), indent=1) + "\n", "utf-8")


def read_finding(out: Path, known: KnownFinding) -> Case:
    """Reads the input of a finding."""
    return Case(known.base, known.path, (out / known.folder / known.path).read_bytes())


def about(known: KnownFinding) -> dict[str, Any]:
    """Returns a finding as values of JSON."""
    found = asdict(known)
    found["finding"]["kind"] = str(known.finding.kind)
    return found


def stored_cases(root: Path) -> Iterator[tuple[str, str, Case]]:
    """Yields the inputs in a folder, each ``target/base/name/path of the changed file``, as target, name and case, sorted."""
    for place in sorted(path for path in root.rglob("*") if path.is_file() and path.name not in (_ABOUT, "README.md")):
        target, base, name, *path = place.relative_to(root).parts
        if path:
            yield target, name, Case(base, "/".join(path), place.read_bytes())
