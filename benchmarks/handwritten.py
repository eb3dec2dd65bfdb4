"""The Semantic Reasoner on instructions as people write them.

``python -m benchmarks.handwritten [--file FILE.jsonl] [--engine embedded] [--cases N] [--one-shot] [--json OUT.json]``. Without
``--file`` the instructions and their requirements are the forty of tests/models/semantic_reasoner/handwritten.jsonl. No layout is
corrected, and objects are judged by their boxes.

- right: every object of the instruction is present, and all its relations hold;
- failed: no answer could be used, and this was reported;
- fall back: an unknown word was read as another one, and this was reported;
- unknown things reported: of the objects to which no asset of the embedded world is similar;
- nonsense: a layout was accepted although an object is missing, or an unknown object was requested, without a report.

Run with ``OMP_NUM_THREADS=1``.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings, load_reasoner
from models.semantic_reasoner.staged_layout import ONE_SHOT, PROGRESSIVE, LayoutTask, StagedLayout, staged_layouts
from stable_data.metrics.alignment import Alignment, align
from tests.models.semantic_reasoner.handwritten import FILE, Handwritten, read_handwritten

FALL_BACK, UNKNOWN = "word_read_as", ("word_unknown", "word_read_as", "language_unknown")
MISSING = (*UNKNOWN, "required_missing")  # codes that report a missing object


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result of one instruction.

    Attributes:
        case: The instruction.
        alignment: The alignment of the layout with it.
        said: Codes and messages of the reasoner's notices.
        failure: Why there is no layout; empty if there is one.
    """

    case: Handwritten
    alignment: Alignment
    said: tuple[tuple[str, str], ...]
    failure: str

    @property
    def is_right(self) -> bool:
        """Whether all objects are present and all relations hold."""
        return not self.failure and not self.alignment.missing and self.alignment.broken == ()

    @property
    def falls_back(self) -> bool:
        """Whether an unknown word was read as another one."""
        return any(code == FALL_BACK for code, _ in self.said)

    @property
    def reported(self) -> tuple[str, ...]:
        """The unknown objects that the reasoner reported as unknown."""
        messages = " ".join(message.lower() for code, message in self.said if code in UNKNOWN)
        return tuple(thing for thing in self.case.unknown if thing.lower() in messages)

    @property
    def is_nonsense(self) -> bool:
        """Whether a layout was accepted although an object is missing, without a report."""
        if self.failure:
            return False
        is_silent = not any(code in MISSING for code, _ in self.said)
        return bool(self.alignment.missing and is_silent) or len(self.reported) < len(self.case.unknown)

    def __str__(self) -> str:
        """Returns one line with the defects."""
        status = "right" if self.is_right else "failed" if self.failure else "wrong"
        _, _, found = str(self.alignment).partition(": ")
        parts = [f"{status:6} {self.case.reference.scene_id}: {self.case.instruction}"]
        parts += [self.failure] if self.failure else [] if self.is_right else [found]
        parts += [message for _, message in self.said]
        parts += [f"not reported: {thing}" for thing in self.case.unknown if thing not in self.reported and not self.failure]
        return " | ".join(parts + ["NONSENSE"] * self.is_nonsense)


def verdict_of(case: Handwritten, layout: StagedLayout) -> Verdict:
    """Compares a layout with its instruction."""
    proposals = [proposal for _, proposal in layout.proposals]
    notices = [(n.code, n.message.removeprefix(f"{n.item_id}: ")) for p in proposals for n in p.notices]
    faults = [(f.code, f.message) for p in proposals for f in p.faults]
    said = tuple(dict.fromkeys(pair for pair in [*notices, *faults] if pair[0] != "table_unknown"))
    failure = "" if layout.is_whole else proposals[-1].failure
    return Verdict(case, align(layout.scene, case.reference), said, failure)


def summary_of(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Sums up the figures."""
    required = sum(len(v.case.reference.required) for v in verdicts)
    entailed = sum(len(v.case.reference.entailed) for v in verdicts)
    return {
        "cases": len(verdicts),
        "right": sum(v.is_right for v in verdicts),
        "failed": sum(bool(v.failure) for v in verdicts),
        "fall_back": sum(v.falls_back for v in verdicts),
        "nonsense": sum(v.is_nonsense for v in verdicts),
        "unknown_things": sum(len(v.case.unknown) for v in verdicts),
        "unknown_reported": sum(len(v.reported) for v in verdicts),
        "objects_asked": required,
        "objects_there": sum(len(v.alignment.matches) for v in verdicts),
        "relations_asked": entailed,
        "relations_held": sum(
            len(v.case.reference.entailed) - len(v.alignment.broken) for v in verdicts if v.alignment.broken is not None
        ),
        "relations_unknown": sum(len(v.case.reference.entailed) for v in verdicts if v.alignment.broken is None),
    }


def main(
    file: Annotated[Path, typer.Option(help="Instructions with their requirements, one JSON object in a line.")] = FILE,
    engine: Annotated[str, typer.Option(help="Which engine; see models/semantic_reasoner/engines/registry.py.")] = "embedded",
    base_url: Annotated[str, typer.Option(help="URL of the endpoint of openai:MODEL.")] = "",
    key_variable: Annotated[str, typer.Option(help="Environment variable with its key.")] = "",
    statistics: Annotated[str, typer.Option(help="Category statistics, for engines without their own.")] = "",
    one_shot: Annotated[bool, typer.Option("--one-shot", help="Request whole layouts at once.")] = False,
    tries: Annotated[int, typer.Option(help="Largest number of tries of a question.")] = 4,
    seed: Annotated[int, typer.Option(help="Seed of the sampling.")] = 0,
    cases: Annotated[int, typer.Option(help="Number of instructions, the first ones; 0 takes all.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints one line for each case, and a summary."""
    chosen = EngineSettings(engine)
    if base_url:
        chosen = replace(chosen, http=HttpSettings(base_url, "default", key_variable))
    reasoner, interpret = load_reasoner(chosen, ReasonerSettings(tries=tries, statistics=statistics))
    asked = read_handwritten(file)[: cases or None]
    tasks = [LayoutTask(case.reference.scene_id, case.instruction, case.table) for case in asked]
    began = time.perf_counter()
    seeds = range(seed * 1_000_003, seed * 1_000_003 + len(tasks))
    layouts = staged_layouts(reasoner, tasks, seeds, ONE_SHOT if one_shot else PROGRESSIVE, interpret)
    seconds = time.perf_counter() - began
    verdicts = [verdict_of(case, layout) for case, layout in zip(asked, layouts, strict=True)]
    for verdict in verdicts:
        print(verdict)
    summary = summary_of(verdicts) | {"seconds": round(seconds, 1)}
    print(", ".join(f"{key.replace('_', ' ')} {value}" for key, value in summary.items()))
    if json_file is not None:
        lines = [
            {"instruction": v.case.instruction, "right": v.is_right, "nonsense": v.is_nonsense, "line": str(v)}
            for v in verdicts
        ]
        document = {
            "file": file.name,
            "engine": engine,
            "one_shot": one_shot,
            "tries": tries,
            "seed": seed,
            "summary": summary,
            "cases": lines,
        }
        json_file.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
