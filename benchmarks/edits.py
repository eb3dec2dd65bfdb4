"""The quality of edits, in two modes.

``python -m benchmarks.edits --file FILE.jsonl --scenes FOLDER [--engine embedded] [--name NAME] [--json FILE]`` applies edits in free
words to the scenes of a folder in the MesaTask-10K format, as the edit job does by default, and judges the edited scenes by what a person
expects. A line has ``edit_id``, ``scene_id``, ``kind``, ``instruction`` and ``expected``, see :mod:`benchmarks.edit_verdict`. An edit
that has to ask back (``expected.ambiguous``) is right if it fails with the code ``ambiguous`` and its message names all candidates.
Figures of other engines in the JSON file stay, if they are of the same edits. ``embedded`` plans edits by rules; other engines are asked.

``python -m benchmarks.edits RUN [--engine embedded] [--split test] [--edits N] [--json FILE]`` compares the reasoner's answers with
drafted edits. RUN is a preprocess run. If it has no table ``edits``, edits are drafted as by ``stable-data draft-edits``, which is
possible only for scenes of the embedded world. The reasoner gets each edit's instruction and layout; its answer is compared with
the drafted edit:

- answered: an answer passed the checks;
- right: the same instances are removed, the same ones change, and new objects have the same categories;
- kept: no object is removed or changed that the drafted edit leaves unchanged.
"""

import json
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from benchmarks.edit_verdict import ExpectedEdit, faults_of_edit, read_expected_edits
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings, load_reasoner
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from models.semantic_reasoner.training.examples import TrainingExample, edit_example_of
from pipelines.edit.job import edit
from pipelines.edit.settings import EditSettings
from pipelines.execution.ray_executor import WorkerPool
from stable_data.embedded_world.edit_table import write_edits
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.storage.row_groups import TableFiles, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, scene_from_row


def held_out_edits(run: str, split: str, most: int) -> list[Row]:
    """Returns the first edits of a split by name, the same ones each time."""
    if not RunFolder(run).files("edits"):
        with TemporaryDirectory() as folder:
            drafted = RunFolder(folder)
            if not sum(count for count, _ in write_edits(RunFolder(run), drafted, count=2)):
                return []
            return held_out_edits(folder, split, most)
    files = TableFiles(run, "edits", None, split)
    rows = [row for k in range(len(files.groups)) for row in rows_from_table(files.read([k]))]
    return sorted(rows, key=lambda row: str(row["edit_id"]))[:most]


def what_it_does(layout: Sequence[LayoutObject], reply: LayoutReply) -> tuple[set[str], set[str], Counter[str]]:
    """Returns the removed instances, the changed instances, and the categories of new objects with their counts."""
    there = {o.instance: o for o in layout}
    changed = {o.instance for o in reply.objects if o.instance in there and o != there[o.instance]}
    return set(reply.removed), changed, Counter(o.category for o in reply.objects if o.instance not in there)


def verdict(example: TrainingExample, reply: LayoutReply | None) -> dict[str, bool]:
    """Compares an answer with the edit."""
    layout = example.question.layout
    gone, changed, new = what_it_does(layout, LayoutReply(example.objects, example.removed or ()))
    if reply is None:
        return {"answered": False, "right": False, "kept": True}
    found = what_it_does(layout, reply)
    return {"answered": True, "right": found == (gone, changed, new), "kept": found[0] | found[1] <= gone | changed}


# --- edits in free words ------------------------------------------------------------------------------------------------------


def judge_edits(expected: Sequence[ExpectedEdit], out: RunFolder) -> list[dict[str, Any]]:
    """Returns one row for each expected edit of a finished edit job: its faults, and whether it is right."""
    scenes = {row["scene_id"]: scene_from_row(row) for row in out.table("scenes").to_pylist()}
    before = {row["edit_id"]: row["objects_in"] for row in out.table("edits").to_pylist()}
    failed = {row["id"]: (row["code"], row["message"]) for row in out.table("failures").to_pylist()}
    rows = []
    for one in expected:
        after = scenes.get(one.edit_id)
        code, message = failed.get(one.edit_id, ("no_row", "has neither a scene nor a failure"))
        if one.ambiguous:
            asks = after is None and code == "ambiguous" and all(name in message for name in one.ambiguous)
            faults = [] if asks else [f"does not ask which of {', '.join(one.ambiguous)} is meant"]
        elif after is None:
            faults = [f"{code}: {message}"]
        else:
            was = replace(after, objects=tuple(map(object_from_row, before[one.edit_id])), relations=())
            faults = faults_of_edit(was, after, one.expected)
        rows.append(
            {"edit_id": one.edit_id, "kind": one.kind, "instruction": one.instruction, "faults": faults, "right": not faults}
        )
    return rows


def run_free_edits(file: Path, scenes: str, engine: str, name: str, json_file: Path | None) -> None:
    """Applies and judges the edits of a file, and prints what is wrong with each and a summary."""
    expected, others = read_expected_edits(file), _figures_of_others(json_file, file)
    began = time.perf_counter()
    with TemporaryDirectory() as folder:
        requests = Path(folder) / "edits.jsonl"
        lines = [{"edit_id": one.edit_id, "scene_id": one.scene_id, "instruction": one.instruction} for one in expected]
        requests.write_text("".join(json.dumps(line) + "\n" for line in lines), "utf-8")
        out = str(Path(folder) / "out")
        edit(scenes, requests, out, EditSettings(engine=EngineSettings(engine)), WorkerPool(), [EMBEDDED], report=False)
        rows = judge_edits(expected, RunFolder(out))
    seconds = time.perf_counter() - began
    for row in rows:
        print("right" if row["right"] else "WRONG", row["kind"], row["instruction"], *row["faults"], sep=" | ")
    kinds = sorted({row["kind"] for row in rows})
    summary: dict[str, Any] = {"right": sum(row["right"] for row in rows), "edits": len(rows), "seconds": round(seconds, 1)}
    for key, is_counted in (("right_by_kind", True), ("edits_by_kind", False)):
        summary[key] = {kind: sum(row["right"] or not is_counted for row in rows if row["kind"] == kind) for kind in kinds}
    print(f"{summary['right']} of {summary['edits']} edits right")
    if json_file is not None:
        document = {"file": file.name, "engines": {**others, name or engine: {"summary": summary, "edits": rows}}}
        json_file.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", "utf-8")


def _figures_of_others(json_file: Path | None, file: Path) -> dict[str, Any]:
    """The figures of engines that a JSON file has of the same edits.

    Raises:
        typer.BadParameter: It has other content.
    """
    if json_file is None or not json_file.exists():
        return {}
    try:
        document = json.loads(json_file.read_text("utf-8"))
        of_same = document["file"] == file.name
        return dict(document["engines"]) if of_same else {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise typer.BadParameter(
            f"{json_file}: has other content than figures of edits ({error!r}); choose another file"
        ) from error


# --- drafted edits ------------------------------------------------------------------------------------------------------------


def main(
    run: Annotated[str, typer.Argument(help="Folder of a preprocess run, for drafted edits.")] = "",
    file: Annotated[Path | None, typer.Option(help="Edits in free words, one JSON object in a line.")] = None,
    scenes: Annotated[str, typer.Option(help="Folder of their scenes, in the MesaTask-10K format.")] = "",
    engine: Annotated[str, typer.Option(help="Which engine; see models/semantic_reasoner/engines/registry.py.")] = "embedded",
    name: Annotated[str, typer.Option(help="What the figures call the engine, if not as --engine.")] = "",
    split: Annotated[str, typer.Option(help="Which split.")] = "test",
    edits: Annotated[int, typer.Option(help="Largest number of edits.")] = 500,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints a line for each edit in free words, or for each kind of drafted edit."""
    if (file is None) == (not run) or (file is not None and not scenes):
        raise typer.BadParameter("give a run, or --file and --scenes")
    if file is not None:
        run_free_edits(file, scenes, engine, name, json_file)
        return
    rows = held_out_edits(run, split, edits)
    if not rows:
        print(f"{run}: no edits of the split {split}, expected some; only scenes of the embedded world can be drafted")
        return
    examples = [edit_example_of(row) for row in rows]
    reasoner, _ = load_reasoner(EngineSettings(engine), ReasonerSettings())
    began = time.perf_counter()
    proposals = reasoner.propose([e.question for e in examples], range(len(examples)))
    seconds = time.perf_counter() - began
    of_kind: dict[str, list[dict[str, bool]]] = defaultdict(list)
    for row, example, proposal in zip(rows, examples, proposals, strict=True):
        for kind in (row["kind"], "all"):
            of_kind[kind].append(verdict(example, proposal.reply))
    figures: dict[str, Any] = {}
    print(f"{split:10}{'edits':>8}{'answered':>10}{'right':>8}{'kept':>8}  percent")
    for kind, found in sorted(of_kind.items(), key=lambda item: (item[0] == "all", item[0])):
        shares = {key: round(100 * sum(v[key] for v in found) / len(found), 1) for key in ("answered", "right", "kept")}
        figures[kind] = {"edits": len(found), **shares}
        print(f"{kind:10}{len(found):>8}{shares['answered']:>10}{shares['right']:>8}{shares['kept']:>8}")
    figures["edits_a_minute"] = round(60 * len(rows) / seconds, 1)
    print(f"{figures['edits_a_minute']} edits a minute")
    if json_file is not None:
        json_file.write_text(json.dumps({"engine": engine, "split": split, **figures}, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
