"""The tables of an evaluation as text, and its report page with the scenes of the systems side by side."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

import pyarrow.compute as pc

from pipelines.evaluate.evaluation import Evaluation, SystemResult
from pipelines.evaluate.figures import FIGURES, RULES, TABLE_1_COLUMNS, Estimate, Figure
from pipelines.evaluate.published import SOURCE, TABLE_1, TABLE_3B
from pipelines.evaluate.settings import EvaluateSettings
from pipelines.reports.html import page, table
from pipelines.reports.text_table import align_columns
from stable_data.diversity.pictures import VIEW
from stable_data.rating.criteria import CRITERIA
from stable_data.storage.run_folder import RunFolder

_BY_KEY = {figure.key: figure for figure in FIGURES}
_NOT_RUN = "not run"


def evaluation_text(evaluation: Evaluation) -> str:
    """Returns all figures as text: a row for each figure, a column for each system that was run; then the notes."""
    run = [result for result in evaluation.results if result.repetitions]
    rows = [["", *(result.system.label for result in run)]]
    for figure in FIGURES:
        found = [evaluation.estimates[result.system.label][figure.key] for result in run]
        if any(one.value is not None for one in found):
            rows.append([_label(figure, evaluation), *(one.text(figure.digits) for one in found)])
    lines = [align_columns(rows, 1)] if run else []
    unknown = [
        _label(f, evaluation)
        for f in FIGURES
        if run and all(evaluation.estimates[r.system.label][f.key].value is None for r in run)
    ]
    if unknown:
        lines.append(f"unknown for all: {'; '.join(unknown)}")
    lines += [f"{name}: {note}" for name, note in _notes(evaluation)]
    return "\n".join(lines)


def write_evaluation_report(folder: RunFolder, evaluation: Evaluation, settings: EvaluateSettings) -> None:
    """Writes ``report/index.html``."""
    repetitions = f"{settings.repetitions} repetition" + ("s" if settings.repetitions > 1 else "")
    about = (
        f"{evaluation.num_tasks} tasks, {repetitions}, seeds from {settings.generate.seed}. Engine: {settings.generate.engine.engine}, if "
        f"a system names no other. Ratings: {evaluation.names['judge']}. Pictures: {evaluation.names['frechet']}, from the {VIEW}. "
        "Brackets are 95 % intervals: Wilson's for verdicts, else Student's t for the mean over repetitions, or over the scenes of a "
        "single one."
    )
    body = [
        f'<h1>Systems on the same tasks</h1><p class="note">{escape(about)}</p>',
        "<h2>The paper's Table 1</h2>",
        *_paper_table(evaluation),
        "<h2>The paper's Table 3 (b): one request or stages</h2>",
        *_ablation_table(evaluation),
        "<h2>All figures</h2>",
        _all_figures(evaluation),
        "<h2>Notes</h2>",
        table(("system", "note"), _notes(evaluation)),
        "<h2>Scenes side by side</h2>",
        *_pictures(evaluation, settings.num_pictures),
    ]
    folder.write_bytes("report/index.html", page("Evaluation", body))


def _label(figure: Figure, evaluation: Evaluation) -> str:
    """The name of a figure; pictures by what their features are called, ratings with who rated."""
    if figure.key in ("frechet", "kernel"):
        return evaluation.names[figure.key]
    if figure.key in (*(c.key for c in CRITERIA), "average", "quality_pass"):
        return f"{figure.label} ({evaluation.names['judge']})"
    return figure.label


def _notes(evaluation: Evaluation) -> list[tuple[str, str]]:
    of_all = [("all", note) for note in evaluation.notes]
    return of_all + [(result.system.label, note) for result in evaluation.results for note in result.notes]


def _text(result: SystemResult, estimate: Estimate, figure: Figure) -> str:
    return estimate.text(figure.digits) if result.repetitions else _NOT_RUN


def _paper_table(evaluation: Evaluation) -> Iterable[str]:
    """Measured and published figures in the paper's layout, in columns of their own."""
    figures = [_BY_KEY[key] for key in ("frechet", *TABLE_1_COLUMNS)]
    criteria = [c.key.upper() for c in CRITERIA]
    head = ["system", evaluation.names["frechet"], *TABLE_1_COLUMNS.values()]
    rows = [
        [
            f"{r.system.label} ({r.row})",
            *(_text(r, evaluation.estimates[r.system.label][f.key], f) for f in figures),
        ]
        for r in evaluation.results
    ]
    yield f'<p class="note">Measured here. {escape(", ".join(criteria))}: 1 to 10, by {escape(evaluation.names["judge"])}. '
    yield f"{escape(RULES)}.</p>"
    yield table(head, rows)
    yield (
        f'<p class="note">Published: {escape(SOURCE)}, Table 1, with MesaTask-10K, Qwen3-8B, GPT-4o as judge and the paper\'s renderer. '
        "Nothing in this table was measured here, and none of its figures can be compared with one above that has another judge, other "
        "features, other assets or another rule.</p>"
    )
    head = ["row of the paper", "FID", *criteria, "average", "OC", "AwT", "AwS"]
    yield table(
        head,
        [
            [
                row.name,
                f"{row.fid:.1f}",
                *(f"{x:.1f}" for x in row.criteria),
                *(f"{x:.1f}" for x in (row.average, row.oc, row.awt, row.aws)),
            ]
            for row in TABLE_1.values()
        ],
    )


def _ablation_table(evaluation: Evaluation) -> Iterable[str]:
    rows = []
    for name, (awt, distractors) in TABLE_3B.items():
        published = [f"{awt:.1f}", f"{distractors:.1f}"]
        own = [result for result in evaluation.results if result.system.name == name]
        for result in own:
            of = evaluation.estimates[result.system.label]
            measured = [_text(result, of[key], _BY_KEY[key]) for key in ("awt", "distractor_rate")]
            rows.append([result.system.label, *measured, *published])
        if not own:
            rows.append([name, "not asked for", "not asked for", *published])
    yield table(("system", "AwT, %", "distractors, %", f"AwT, published ({SOURCE})", "distractors, published"), rows)


def _all_figures(evaluation: Evaluation) -> str:
    """A row for each figure, a column for each system that was run."""
    run = [result for result in evaluation.results if result.repetitions]
    rows = [
        [
            _label(figure, evaluation),
            {"higher": "↑", "lower": "↓", "": ""}[figure.better],
            *(evaluation.estimates[r.system.label][figure.key].text(figure.digits) for r in run),
        ]
        for figure in FIGURES
    ]
    return table(("", "better", *(result.system.label for result in run)), rows)


def _pictures(evaluation: Evaluation, count: int) -> Iterable[str]:
    """For some tasks of the first repetition, the scene of each system from the front."""
    run = [result for result in evaluation.results if result.repetitions]
    if not run or not count:
        return
    tasks = run[0].repetitions[0].tasks
    chosen = tasks[:: max(1, len(tasks) // count)][:count]
    shown = {result.system.label: _fronts(result.runs[0].views, chosen) for result in run}
    asked = _instructions([result.runs[0].scenes for result in run], chosen)
    for task in chosen:
        yield f'<h3>{escape(task)}</h3><p class="note">{escape(asked.get(task, ""))}</p><div class="grid">'
        for label, pictures in shown.items():
            image = f'<img alt="{escape(label)}" src="{pictures[task]}">' if task in pictures else ""
            missing = "" if task in pictures else ": no scene, or no picture of it"
            yield f"<figure>{image}<figcaption>{escape(label)}{missing}</figcaption></figure>"
        yield "</div>"


def _fronts(views: str, tasks: Sequence[str]) -> dict[str, str]:
    """Pictures as data URIs by task; none if they could not be made."""
    if not views or not RunFolder(views).shard_ids("views"):
        return {}
    rows = RunFolder(views).table("views", ["scene_id", "views"], pc.field("scene_id").isin(list(tasks))).to_pylist()
    found = {}
    for row in rows:
        picture = next(view["picture"] for view in row["views"] if view["view"] == VIEW)
        found[row["scene_id"]] = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
    return found


def _instructions(runs: Sequence[str], tasks: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for run in runs:
        for row in RunFolder(run).table("scenes", ["scene_id", "task"], pc.field("scene_id").isin(list(tasks))).to_pylist():
            found.setdefault(row["scene_id"], "" if row["task"] is None else row["task"]["task"])
    return found
