"""How well instructions are read: objects and relations of the start, against labels by hand.

``OMP_NUM_THREADS=1 python -m benchmarks.understanding [--file FILE.jsonl ...] [--drawn N] [--weights FILE] [--errors] [--json
OUT.json]``. A file has the form of tests/models/semantic_reasoner/handwritten.jsonl. Without ``--file`` that set and the
development sets of benchmarks/instructions are read. The frames were written without sight of the development sets; the code was
developed on both. With ``--drawn`` N drawn tasks are compared with the labels of their templates too; frames of these templates are
in the training, so that figure says nothing of foreign words.

- objects: mentioned objects whose category is found;
- relations: stated relations of the start that are read, and how many of those that are read are stated;
- right: no object and no relation is missing, and no unknown object is left out;
- exact: right, and nothing is read that is not there.
"""

import json
import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reader import InstructionReader
from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.instruction_reader.weights import DEFAULT_WEIGHTS
from pipelines.reports.text_table import align_columns
from stable_data.embedded_world.sampling import sample_task
from stable_data.instructions.wording.vocabulary import closeness
from stable_data.metrics.alignment import reference_of
from stable_data.metrics.matching import DesiredRelation, RequiredObject, match
from stable_data.scene import RelationKind
from tests.models.semantic_reasoner.handwritten import FILE, Handwritten, read_handwritten

_FORMS = {
    RelationKind.IN: ("in", False),
    RelationKind.ON: ("on", False),
    RelationKind.LEFT_OF: ("left", False),
    RelationKind.RIGHT_OF: ("left", True),
    RelationKind.IN_FRONT_OF: ("front", False),
    RelationKind.BEHIND: ("front", True),
}
"""The reader's kind for each kind of a label, and whether subject and target change places."""

_DRAWN_SEED = 5
_ANYTHING = "*"

_KINDS = ("in", "on", "left", "front")


@dataclass(frozen=True, slots=True)
class ReadingVerdict:
    """A reading compared with its labels.

    Attributes:
        case: The instruction.
        missing: Required objects that are not read.
        lost: Stated relations that are not read.
        wrong: Relations that are read and not stated.
        excess: Words of known objects that are read and not required.
        unreported: Unknown objects that are not read.
    """

    case: Handwritten
    missing: tuple[str, ...]
    lost: tuple[str, ...]
    wrong: tuple[str, ...]
    excess: tuple[str, ...]
    unreported: tuple[str, ...]

    @property
    def is_right(self) -> bool:
        """Whether nothing is missing."""
        return not (self.missing or self.lost or self.unreported)

    @property
    def is_exact(self) -> bool:
        """Whether it is right and has nothing else."""
        return self.is_right and not (self.wrong or self.excess)


def compare(case: Handwritten, reading: InstructionReading) -> ReadingVerdict:
    """Compares a reading with the labels of its instruction, matched so that the most objects and relations agree."""
    reading = _with_contents(reading)
    known = {str(k): o for k, o in enumerate(reading.objects) if o.categories}
    stated = {(str(r.subject), r.kind, str(r.target)) for r in reading.start}
    found = {form for form in stated if form[1] in _KINDS}
    wanted = [_form(r.subject, r.kind, r.target) for r in case.reference.entailed]
    allowed = {r.instance: _fitting(r, reading) for r in case.reference.required}
    desired = [
        DesiredRelation(1, tuple({a: {one}, b: {other}} for one, kind, other in found if _agrees(kind, wish)))
        for a, wish, b in wanted
    ]
    matches = match(allowed, desired).matches
    held = {(a, kind, b) for a, kind, b in wanted if any((matches.get(a), k, matches.get(b)) in found for k in _agreeing(kind))}
    back = {o: r for r, o in matches.items()}
    wrong = [
        (one, kind, other)
        for one, kind, other in sorted(found)
        if {one, other} <= known.keys()  # the labels say nothing of unknown objects
        and not any((back.get(one), wish, back.get(other)) in held and _agrees(kind, wish) for wish in _KINDS)
    ]
    said = [(o.words, *(case.instruction[slice(*place)] for place in o.mentions)) for o in reading.unknown]
    spoken = [{word for words in one for word in words.lower().split()} for one in said]  # also with typing errors
    return ReadingVerdict(
        case,
        tuple(str(r) for r in case.reference.required if r.instance not in matches),
        tuple(f"{_name(case, a)} {kind} {_name(case, b)}" for a, kind, b in wanted if (a, kind, b) not in held),
        tuple(f"{reading.objects[int(a)].words} {kind} {reading.objects[int(b)].words}" for a, kind, b in wrong),
        tuple(o.words for k, o in known.items() if k not in back and o.categories != (_ANYTHING,)),
        tuple(thing for thing in case.unknown if not any(words & set(thing.lower().split()) for words in spoken)),
    )


def _with_contents(reading: InstructionReading) -> InstructionReading:
    """The reading with an object of any kind in each object that shall be emptied, as a scene must have it."""
    objects, start = list(reading.objects), list(reading.start)
    for k, o in enumerate(reading.objects):
        if o.is_filled and not any(r.target == k and r.kind in ("in", "on") for r in start):
            start.append(MentionedRelation(len(objects), "in", k))
            objects.append(MentionedObject("what is in it", (_ANYTHING,)))
    return replace(reading, objects=tuple(objects), start=tuple(start))


def _form(subject: str, kind: RelationKind, target: str) -> tuple[str, str, str]:
    form, turns = _FORMS[kind]
    return (target, form, subject) if turns else (subject, form, target)


def _agreeing(kind: str) -> tuple[str, ...]:
    """The kinds that make a wish for a kind hold; what is in a thing is accepted as on it."""
    return ("on", "in") if kind == "on" else (kind,)


def _agrees(kind: str, wish: str) -> bool:
    return kind in _agreeing(wish)


def _fitting(required: RequiredObject, reading: InstructionReading) -> dict[str, int]:
    wanted = set(required.categories)
    return {str(k): 1 for k, o in enumerate(reading.objects) if not wanted or set(o.categories) & wanted}


def _name(case: Handwritten, instance: str) -> str:
    return next(str(r) for r in case.reference.required if r.instance == instance)


def drawn_cases(count: int, known: Collection[str]) -> tuple[Handwritten, ...]:
    """Returns drawn tasks with the labels of their templates; tasks whose objects are unknown, and cells of the table, are left out.

    Args:
        count: Number of tasks that are drawn.
        known: The reader's categories; a label that is a wide noun, such as ``cup``, allows all of these that it can mean.
    """
    found = []
    for number in range(count):
        scene = sample_task(number, _DRAWN_SEED)
        if scene.task is not None and scene.task.task_objects:
            reference = reference_of(scene)
            between = tuple(r for r in reference.entailed if r.kind in _FORMS)
            required = tuple(
                replace(r, categories=tuple(c for c in known if any(closeness(c, wanted) for wanted in r.categories)))
                for r in reference.required
            )
            found.append(Handwritten(scene.task.task, scene.table, replace(reference, required=required, entailed=between), ()))
    return tuple(found)


def figures_of(verdicts: Sequence[ReadingVerdict]) -> dict[str, Any]:
    """Returns the figures of a set."""
    counts: Counter[str] = Counter()
    for v in verdicts:
        required, entailed = len(v.case.reference.required), len(v.case.reference.entailed)
        counts.update(
            right=v.is_right,
            exact=v.is_exact,
            objects=required,
            objects_read=required - len(v.missing),
            relations=entailed,
            relations_read=entailed - len(v.lost),
            relations_wrong=len(v.wrong),
            excess=len(v.excess),
            unknown=len(v.case.unknown),
            unknown_read=len(v.case.unknown) - len(v.unreported),
        )
    return {"instructions": len(verdicts), **counts}


def main(
    file: Annotated[list[Path] | None, typer.Option(help="Sets of instructions with labels.")] = None,
    drawn: Annotated[int, typer.Option(help="Number of drawn tasks of the embedded world.")] = 0,
    weights: Annotated[Path, typer.Option(help="Weights of the reader.")] = DEFAULT_WEIGHTS,
    errors: Annotated[bool, typer.Option("--errors", help="Print what is not exact.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints the figures of each set."""
    own = sorted((Path(__file__).parent / "instructions").glob("development_*.jsonl"))
    reader = InstructionReader.load(read_nouns().nouns, weights)
    found = {}
    sets = {path.stem: read_handwritten(path) for path in file or [FILE, *own]}
    if drawn:
        sets[f"drawn {drawn}"] = drawn_cases(drawn, read_nouns().nouns)
    for name, cases in sets.items():
        began = time.perf_counter()
        readings = [reader.read(case.instruction) for case in cases]
        seconds = time.perf_counter() - began
        verdicts = [compare(case, reading) for case, reading in zip(cases, readings, strict=True)]
        for v in verdicts:
            if errors and not v.is_exact:
                parts = {name: list(getattr(v, name)) for name in ("missing", "lost", "wrong", "excess", "unreported")}
                print(v.case.instruction, {name: part for name, part in parts.items() if part}, sep="\n    ")
        found[name] = figures_of(verdicts) | {"milliseconds": round(1000 * seconds / len(cases), 1)}
    header = ["set", *(key.replace("_", " ") for key in next(iter(found.values())))]
    print(align_columns([header, *([name, *map(str, figures.values())] for name, figures in found.items())], 1))
    if json_file is not None:
        json_file.write_text(json.dumps(found, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
