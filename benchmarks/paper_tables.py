"""All tables of the paper from figures that were measured before, each with the command that measures it.

``python -m benchmarks.paper_tables [FOLDER] [--page PAGE]``. Without FOLDER, the tables are of the figures in the repository
(benchmarks/results, whose README says how they were measured). With ``--page``, they replace the text blocks of a Markdown file, each in
the section of its title, as in docs/paper_tables.md. FOLDER has the outputs of these commands, under these names:

- ``systems``: ``python -m pipelines evaluate --count 200 --repetitions 3 --reference RUN --out FOLDER/systems`` (Tables 1 and 3 b);
- ``correction.json``: ``python -m benchmarks.correction DATA --json FOLDER/correction.json`` (Table 2);
- ``corrector_ablation.json``: ``python -m benchmarks.corrector_ablation RUN --json FOLDER/corrector_ablation.json`` (Table 3 a);
- ``rearrangement.json``: ``python -m benchmarks.rearrangement RUN --lego-steps 25 --diffusion-steps 50 --json FOLDER/rearrangement.json``;
- ``boxes.json``: ``stable-data score-boxes LABELS BOXES --json FOLDER/boxes.json`` (manipulability);
- ``generalisation.json``: ``python -m benchmarks.generalisation DATA --json FOLDER/generalisation.json`` (unseen tables and assets, and
  conflicting instructions);
- ``edits.json``: ``python -m benchmarks.edits --file FILE --scenes DATA --json FOLDER/edits.json``, and again with ``--engine
  transformers:FOLDER`` for a reasoner that never saw edits, as the paper's (``shares.edit=0``, docs/reasoner.md).

DATA is a folder in the MesaTask-10K format, RUN a preprocess run. What was not measured is named with its command. Published figures stand
below the measured ones, apart from them: they are of other scenes, assets, models and judges.
"""

import argparse
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, TypeAlias

from benchmarks.generalisation import show as generalisation_lines
from pipelines.evaluate.figures import FIGURES, RULES, TABLE_1_COLUMNS, Estimate
from pipelines.evaluate.published import MANIPULABILITY, REARRANGEMENT, SOURCE, TABLE_1, TABLE_2, TABLE_3A, TABLE_3B
from pipelines.reports.text_table import align_columns
from stable_data.atomic_files import write_file_atomically
from stable_data.rating.criteria import CRITERIA
from stable_data.scores.intervals import mean_text, share_text

Rows: TypeAlias = list[list[str]]

RESULTS = Path(__file__).parent / "results"
"""The figures of the repository."""

_UNKNOWN = "unknown"
_BUCKETS = ("0-10", "10-20", "20-30", "30-40")  # collisions at the start, of Table 2
_SYSTEMS_FILE = "systems/evaluation.json"
_SYSTEMS = "python -m pipelines evaluate --count 200 --repetitions 3 --reference RUN --out FOLDER/systems"
_LABELS = {figure.key: figure for figure in FIGURES}
_ARMS = {"no support": "without L_sup", "no table": "without L_obj-table", "no objects": "without L_obj-obj", "full": "full"}


@dataclass(frozen=True, slots=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        title: Its title.
        file: The file of its figures in the folder.
        command: What measures them.
        measured: Makes its lines from the content of the file.
        published: The rows that the paper prints, the first one is the head; empty if it prints none.
    """

    title: str
    file: str
    command: str
    measured: Callable[[Any], Iterable[str]]
    published: Rows

    def command_for(self, folder: Path) -> str:
        """What measures the table for a folder."""
        return self.command.replace("FOLDER", _name(folder))

    def lines(self, folder: Path) -> Iterable[str]:
        """Yields the table as text, without its title."""
        path = folder / self.file
        if not path.is_file():
            yield f"not measured; {self.command_for(folder)}"
        else:
            try:
                found = list(self.measured(json.loads(path.read_text("utf-8"))))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                reason = f"{type(error).__name__}: {error}"
                found = [f"{_name(path)} has other content than expected ({reason}); measure again: {self.command_for(folder)}"]
            yield from found
        if self.published:
            yield f"published ({SOURCE}), not measured here:"
            yield from _aligned(self.published)


def systems_lines(found: Mapping[str, Any]) -> Iterable[str]:
    """Yields Table 1, with who rated and what the distance of pictures is called."""
    names = found["names"]
    rows = [["system", names["frechet"], *TABLE_1_COLUMNS.values()]]
    for label, system in found["systems"].items():
        rows.append([f"{label} ({system['row']})", *(_estimate(system, key) for key in ("frechet", *TABLE_1_COLUMNS))])
    yield from _aligned(rows)
    yield f"{found['num_tasks']} tasks; CWT to average: {names['judge']}, on a scale of 1 to 10; brackets: 95 % intervals"
    yield RULES
    yield from (f"all: {note}" for note in found["notes"])
    yield from (f"{label}: {note}" for label, system in found["systems"].items() for note in system["notes"])


def figures_lines(found: Mapping[str, Any]) -> Iterable[str]:
    """Yields all figures of the systems that were run, a row for each figure that some system has."""
    run = {label: system["figures"] for label, system in found["systems"].items() if system["repetitions"]}
    rows = [["", *run]]
    for figure in FIGURES:
        estimates = [Estimate(**figures[figure.key]) for figures in run.values()]
        if any(one.value is not None for one in estimates):
            rows.append([found["names"].get(figure.key, figure.label), *(one.text(figure.digits) for one in estimates)])
    yield from _aligned(rows)
    yield f"{found['num_tasks']} tasks in each repetition; 1 to 10: rated by {found['names']['judge']}; brackets: 95 % intervals"


def stages_lines(found: Mapping[str, Any]) -> Iterable[str]:
    """Yields Table 3 (b)."""
    rows = [["system", "AwT %", "distractors %"]]
    for name in TABLE_3B:
        own = {label: one for label, one in found["systems"].items() if one["system"] == name}
        rows += [[label, *(_estimate(one, key) for key in ("awt", "distractor_rate"))] for label, one in own.items()]
        rows += [] if own else [[name, "not run", "not run"]]
    yield from _aligned(rows)


def collision_lines(found: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Yields Table 2: layouts that end without a collision, of all with so many at the start."""
    buckets, methods = _BUCKETS, list(dict.fromkeys(row["method"] for row in found))
    rows = [["method", *buckets, "objects left out"]]
    for method in methods:
        own = {bucket: [r for r in found if (r["method"], r["bucket"]) == (method, bucket)] for bucket in buckets}
        left_out, objects = (sum(r[key] for of in own.values() for r in of) for key in ("num_dropped", "num_objects"))
        free = [share_text(sum(r["num_collisions"] == 0 for r in of), len(of)) if of else "no layouts" for of in own.values()]
        rows.append([method, *free, f"{left_out} of {objects}"])
    yield from _aligned(rows)
    if missing := [bucket for bucket in buckets if not any(row["bucket"] == bucket for row in found)]:
        yield (
            f"no layouts with {', '.join(missing)} collisions at the start: more scenes, or --layouts FILE with such ones and "
            "--per-bucket N (make evaluate LAYOUTS=FILE)"
        )
    yield "scenes without a collision of all; a pair that cannot be judged counts as colliding; brackets: 95 % intervals (Wilson), in %"


def ablation_lines(found: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Yields Table 3 (a): raw samples of short trainings without one of the losses."""
    columns = {"oc_sdf": "OC %", "float_gap": "float %", "oc": "exact OC %", "float_rate": "exact float %"}
    rows = [["training", *columns.values(), "seeds"]]
    for name, title in _ARMS.items():
        own = [arm for arm in found if arm["name"] == name]
        cells = [[_percent([row["raw"].get(key) for row in arm["card"].values()]) for arm in own] for key in columns]
        if own:
            rows.append([title, *(mean_text(values, 1) or _UNKNOWN for values in cells), str(len(own))])
    yield from _aligned(rows)
    yield (
        "raw samples of the flow, means over the rows of the validation card and over the seeds, with half of the width of their 95 % "
        "intervals over the seeds"
    )


def rearrangement_lines(found: Mapping[str, Any]) -> Iterable[str]:
    """Yields the table of rearrangement, objects of one category matched as in the paper."""
    columns = {
        "moved_category": "moved m",
        "emd_category": "EMD m",
        "oc_sampled": "OC %",
        "oc": "exact OC %",
        "clean": "clean %",
    }
    rows = [["method", *columns.values(), "layouts", "failed", "seeds"]]
    for method in dict.fromkeys(f["method"] for f in found["figures"]):
        own = [f for f in found["figures"] if f["method"] == method]
        counts = [str(sum(f[key] for f in own)) for key in ("scenes", "failed")]
        cells = [_mean_in_unit([f[key] for f in own], title) for key, title in columns.items()]
        rows.append([method, *cells, *counts, str(len(own))])
    yield from _aligned(rows)
    yield (
        "means over the seeds with half of the width of their 95 % intervals; OC and exact OC: colliding pairs, as in Table 1; the paper "
        "prints its OC without a unit"
    )
    yield "failed: the method gave no layout, and the scene counts as it was at the start"


def _mean_in_unit(values: Sequence[float | None], title: str) -> str:
    """A mean with its interval in the unit that ends the title of its column."""
    if not title.endswith("%"):
        return mean_text(values, 3) or _UNKNOWN
    return mean_text([None if value is None else 100 * value for value in values], 2) or _UNKNOWN


def boxes_lines(found: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Yields the table of manipulability."""
    rows = [["object", "labels", "AP at 0.5", "AP at 0.75"]]
    rows += [
        [one["category"], str(one["labels"]), *(mean_text([x], 2) or _UNKNOWN for x in one["precision"].values())]
        for one in found
    ]
    yield from _aligned(rows)


def edits_lines(found: Mapping[str, Any]) -> Iterable[str]:
    """Yields the edits in free words that are right, by kind and engine."""
    summaries = [one["summary"] for one in found["engines"].values()]
    rows = [
        [kind, *(share_text(one["right_by_kind"][kind], one["edits_by_kind"][kind]) for one in summaries)]
        for kind in summaries[0]["edits_by_kind"]
    ]
    rows.append(["all", *(share_text(one["right"], one["edits"]) for one in summaries)])
    yield from _aligned([["kind", *found["engines"]], *rows])
    yield "right of all; brackets: 95 % intervals (Wilson), in %"


def fill_page(page: str, folder: Path) -> str:
    """Returns a Markdown page with all tables in the first text blocks of the sections of their titles.

    Raises:
        ValueError: If a table has no such section or its section no text block.
    """
    for table in TABLES:
        pattern = rf"(^## {re.escape(table.title)}\n(?:(?!^## ).*\n)*?```text\n)(?:.*\n)*?```$"
        parts = re.split(pattern, page, maxsplit=1, flags=re.MULTILINE)
        if len(parts) == 1:
            raise ValueError(f"no section '## {table.title}' with a block that begins with ```text")
        before, head, after = parts
        page = before + head + "\n".join(table.lines(folder)) + "\n```" + after
    return page


def _name(path: Path) -> str:
    """A path as in commands; in the repository from its root, so that pages are the same wherever it lies."""
    root = RESULTS.parent.parent
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def _estimate(system: Mapping[str, Any], key: str) -> str:
    if not system["repetitions"]:
        return "not run"
    return Estimate(**system["figures"][key]).text(_LABELS[key].digits)


def _percent(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return 100 * mean(known) if known and len(known) == len(values) else None


def _aligned(rows: Rows) -> list[str]:
    return align_columns(rows, 1).splitlines()


def _mark(solved: bool) -> str:
    return "all" if solved else "not all"


TABLES = (
    PaperTable(
        "Table 1: systems",
        _SYSTEMS_FILE,
        _SYSTEMS,
        systems_lines,
        [
            ["system", "FID", *(c.key.upper() for c in CRITERIA), "average", "OC", "AwT", "AwS"],
            *([r.name, *(f"{x:.1f}" for x in (r.fid, *r.criteria, r.average, r.oc, r.awt, r.aws))] for r in TABLE_1.values()),
        ],
    ),
    PaperTable(
        "All figures of the systems (not in the paper)",
        _SYSTEMS_FILE,
        _SYSTEMS,
        figures_lines,
        [],
    ),
    PaperTable(
        "Table 2: layouts without collisions, by collisions at the start",
        "correction.json",
        "python -m benchmarks.correction DATA --json FOLDER/correction.json",
        collision_lines,
        [["method", "0-10", "10-20", "20-30", "30-40"], *([name, *map(_mark, solved)] for name, solved in TABLE_2.items())],
    ),
    PaperTable(
        "Table 3 (a): the losses of the Physics Corrector",
        "corrector_ablation.json",
        "python -m benchmarks.corrector_ablation RUN --out TRAININGS --arm full --arm 'no support' --arm 'no table' --arm 'no objects' "
        "--json FOLDER/corrector_ablation.json",
        ablation_lines,
        [["training", "OC", "float"], *([name, f"{oc:.1f}", f"{floats:.1f}"] for name, (oc, floats) in TABLE_3A.items())],
    ),
    PaperTable(
        "Table 3 (b): one request or stages",
        _SYSTEMS_FILE,
        _SYSTEMS,
        stages_lines,
        [["system", "AwT", "distractors"], *([name, f"{awt:.1f}", f"{rate:.1f}"] for name, (awt, rate) in TABLE_3B.items())],
    ),
    PaperTable(
        "Rearrangement",
        "rearrangement.json",
        "python -m benchmarks.rearrangement RUN --lego-steps 25 --diffusion-steps 50 --json FOLDER/rearrangement.json; for another world, "
        "with --lego-net, --struct-diffusion and --equal-flow: weights of python -m pipelines train-rearranger and train-corrector",
        rearrangement_lines,
        [["method", "moved", "EMD", "OC"], *([name, *(f"{x:g}" for x in values)] for name, values in REARRANGEMENT.items())],
    ),
    PaperTable(
        "Manipulability",
        "boxes.json",
        "stable-data export RUN OUT --format manipvqa, a detector, then stable-data score-boxes OUT/manipvqa.json BOXES --json "
        "FOLDER/boxes.json",
        boxes_lines,
        [
            ["object", "AP at 0.5", "AP at 0.75"],
            *([name, *(f"{x:.2f}" for x in values)] for name, values in MANIPULABILITY.items()),
        ],
    ),
    PaperTable(
        "Generalisation and conflicting instructions (the paper shows pictures)",
        "generalisation.json",
        "python -m benchmarks.generalisation DATA --json FOLDER/generalisation.json",
        generalisation_lines,
        [],
    ),
    PaperTable(
        "Editing (the paper shows pictures)",
        "edits.json",
        "python -m benchmarks.edits --file FILE --scenes DATA --json FOLDER/edits.json",
        edits_lines,
        [],
    ),
)
"""The tables in the order of the paper."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints all tables, or writes them into a page."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper_tables", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", metavar="FOLDER", nargs="?", type=Path, default=RESULTS, help="folder of measured figures")
    parser.add_argument("--page", metavar="PAGE", type=Path, help="Markdown file whose text blocks get the tables")
    options = parser.parse_args(arguments)
    if not options.folder.is_dir():
        parser.error(f"{options.folder}: no such folder, expected one with measured figures")
    if options.page is None:
        for table in TABLES:
            print("\n".join([f"== {table.title}", *table.lines(options.folder), ""]))
        return
    try:
        filled = fill_page(options.page.read_text("utf-8"), options.folder)
    except (OSError, ValueError) as error:
        parser.error(f"{options.page}: {error}")
    write_file_atomically(options.page, filled.encode())


if __name__ == "__main__":
    main()
