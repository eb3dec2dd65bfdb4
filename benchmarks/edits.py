"""The quality of the reasoner's edits: ``python -m benchmarks.edits RUN [--engine embedded] [--split test] [--edits N] [--json FILE]``.

RUN is a preprocess run. If it has no table ``edits``, edits are drafted as by ``stable-data draft-edits``, which is possible only
for scenes of the embedded world. The reasoner gets each edit's instruction and layout; its answer is compared with the drafted
edit:

- answered: an answer passed the checks;
- right: the same instances are removed, the same ones change, and new objects have the same categories;
- kept: no object is removed or changed that the drafted edit leaves unchanged.
"""

import json
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings, load_reasoner
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from models.semantic_reasoner.training.examples import TrainingExample, edit_example_of
from stable_data.embedded_world.edit_table import write_edits
from stable_data.storage.row_groups import TableFiles, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row


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


def main(
    run: Annotated[str, typer.Argument(help="Folder of a preprocess run.")],
    engine: Annotated[str, typer.Option(help="Which engine; see models/semantic_reasoner/engines/registry.py.")] = "embedded",
    split: Annotated[str, typer.Option(help="Which split.")] = "test",
    edits: Annotated[int, typer.Option(help="Largest number of edits.")] = 500,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints a line for each kind of edit."""
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
