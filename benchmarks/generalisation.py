"""Mass generation outside its usual domain: other tables, other assets, instructions that contradict themselves.

``python -m benchmarks.generalisation DATA [--scenes 100] [--workers 2] [--json FILE]``: DATA is a dataset in the MesaTask-10K
format, preferably of real meshes. The figures include scenes that would not be accepted.

- usual tables: sampled tasks on the embedded world's kinds of table, on which the networks were trained;
- unseen tables: tasks on kinds of table that no training has seen;
- other assets: tasks on the usual kinds, with assets from DATA's library first, then from the embedded one;
- contradictory: the instructions of contradictory.jsonl, of which 8 of 20 are physically possible. A claim is followed if the
  finished scene holds it; otherwise a warning or a failure must report it, or the scene counts as silent.
"""

import argparse
import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.alternation import figures_of
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.reports.text_table import align_columns
from pipelines.sources.generation_tasks import TaskSource, sample_tasks, tasks_of_file
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.scene import Relation, Scene
from stable_data.scores.intervals import share_text, wilson_interval
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

CASES = Path(__file__).with_name("contradictory.jsonl")

OF_CLAIMS, OF_THINGS = (
    frozenset({"relation_not_held", "not_as_said", "contradiction"}),
    frozenset({"asset_unmatched", "required_missing"}),
)
"""Codes of notices which report that a claim, or an object, is not as requested."""

UNUSABLE = "reply_unusable"
"""Code of the failure that no proposal could be used."""

_MEASURES = ("clean", "stable", "awt", "aws", "num_objects", "num_stacked", "num_contained")
_HEAD = ("clean %", "rest %", "AwT %", "AwS %", "objects", "on others", "in others")


@contextmanager
def made(tasks: TaskSource, assets: Sequence[str], workers: WorkerPool) -> Iterator[RunFolder]:
    """Generates a temporary run that accepts every scene."""
    with tempfile.TemporaryDirectory(prefix="stable-data-") as out:
        generate(tasks, out, GenerateSettings(accept="", num_pictures=0), workers, assets, report=False)
        yield RunFolder(out)


def figures(tasks: TaskSource, assets: Sequence[str], workers: WorkerPool, own: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Generates scenes for tasks, and returns the means of their figures.

    Args:
        tasks: The tasks.
        assets: The asset libraries to search, in order.
        workers: The workers.
        own: Assets whose share among the objects is measured.
    """
    with made(tasks, assets, workers) as run:
        used = [o["asset_id"] for row in run.table("scenes", ["objects"]).to_pylist() for o in row["objects"]]
        return figures_of(run, len(tasks.tasks), _MEASURES) | {
            "own_assets": 100 * sum(a in own for a in used) / max(1, len(used))
        }


def outcome(case: Mapping[str, Any], scene: Scene | None, notices: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Compares the result of a contradictory instruction with its claims.

    Args:
        case: A line of contradictory.jsonl.
        scene: The finished scene with its relations; None without one.
        notices: Codes and messages of its warnings and failures; one counts if it names what is not as requested.
    """
    category = {} if scene is None else {o.instance: o.category for o in scene.objects}
    relations = frozenset[Relation]() if scene is None else frozenset(scene.relations)
    held = _claims_held(case["claims"], relations, category)
    broken = [claim for claim, is_held in zip(case["claims"], held, strict=True) if not is_held]
    missing = [name for name in case["objects"] if name not in category.values()]

    def names(message: str, category: str) -> bool:
        return category in message or category.replace("_", " ") in message  # as in instances, or in words

    def tells(code: str, message: str) -> bool:
        if code in OF_CLAIMS:
            return any(names(message, one) and names(message, other) for one, _, other in broken)
        return (code == UNUSABLE and scene is None) or (code in OF_THINGS and any(names(message, name) for name in missing))

    return {
        "instruction": case["instruction"],
        "possible": case["possible"],
        "made": scene is not None,
        "objects_there": sum(name in category.values() for name in case["objects"]),
        "objects_named": len(case["objects"]),
        "claims_held": sum(held),
        "claims": len(held),
        "said": sorted({code for code, message in notices if tells(code, message)}),
    }


def _claims_held(claims: Sequence[Sequence[str]], relations: Set[Relation], category: Mapping[str, str]) -> list[bool]:
    """Which claims hold for one object of each category, those of which the most hold; ``in`` also counts as ``on``."""
    there = {(r.subject, str(r.kind), r.target) for r in relations}
    there |= {(one, "on", other) for one, kind, other in there if kind == "in"}
    words = dict.fromkeys(word for one, _, other in claims for word in (one, other))
    choices = ([name for name, of in category.items() if of == word] or [""] for word in words)
    found = (dict(zip(words, names, strict=True)) for names in product(*choices))
    return max(([(at[one], kind, at[other]) in there for one, kind, other in claims] for at in found), key=sum)


def contradictory(num_cases: int, workers: WorkerPool) -> list[dict[str, Any]]:
    """Generates scenes for the contradictory instructions, and compares each with its claims."""
    cases = [json.loads(line) for line in CASES.read_text("utf-8").splitlines()][:num_cases]
    with tempfile.TemporaryDirectory(prefix="stable-data-") as folder:
        file = Path(folder) / "tasks.jsonl"
        keys = ("instruction", "table_type", "table_size_cm")
        lines = [json.dumps({"scene_id": f"case_{k}"} | {key: case[key] for key in keys}) for k, case in enumerate(cases)]
        file.write_text("\n".join(lines) + "\n", "utf-8")
        with made(tasks_of_file(file), (), workers) as run:
            scenes = {row["scene_id"]: scene_from_row(row) for row in run.table("scenes").to_pylist()}
            told = [*run.table("warnings").to_pylist(), *run.table("failures").to_pylist()]
    return [
        outcome(case, scenes.get(f"case_{k}"), [(n["code"], n["message"]) for n in told if n["id"] == f"case_{k}"])
        for k, case in enumerate(cases)
    ]


def measure(data: str, num_scenes: int, num_cases: int, workers: WorkerPool) -> dict[str, Any]:
    """Measures all figures."""
    usual, unseen = (sample_tasks(num_scenes, 1, list(kinds)) for kinds in (TABLES, UNSEEN_TABLES))
    own = frozenset(asset.asset_id for asset in library_of_folder(Path(data), "own").assets)
    return {
        "usual tables": figures(usual, (), workers),
        "unseen tables": figures(unseen, (), workers),
        "other assets": figures(usual, (data, EMBEDDED), workers, own),
        "contradictory": contradictory(num_cases, workers),
    }


def show(found: dict[str, Any]) -> Iterable[str]:
    """Yields the lines of tables of the figures."""
    rows = [["", "made", *_HEAD, "left out", "own assets %"]]
    for name, one in found.items():
        if name != "contradictory":
            shown = (_shown(one, key) for key in _MEASURES)
            rows.append([name, share_text(one["made"], one["tasks"]), *shown, str(one["dropped"]), f"{one['own_assets']:.1f}"])
    yield from align_columns(rows, 1).splitlines()
    yield "one draw of tasks; brackets: 95 % intervals (Wilson), in %"
    yield "left out: objects of all scenes for which the corrector found no place, although the layout had them"
    yield ""
    yield f"{'made':6}{'objects':>8}{'claims':>8}  {'':12}instruction; reported codes"
    for one in found["contradictory"]:
        objects, claims = (f"{one[a]}/{one[b]}" for a, b in (("objects_there", "objects_named"), ("claims_held", "claims")))
        can = "possible" if one["possible"] else "impossible"
        said = f"; {', '.join(one['said'])}" if one["said"] else ""
        yield f"{'yes' if one['made'] else 'no':6}{objects:>8}{claims:>8}  {can:12}{one['instruction']}{said}"
    possible = [one for one in found["contradictory"] if one["possible"]]
    followed = sum(one["claims_held"] == one["claims"] for one in possible)
    yield f"followed, of the physically possible: {share_text(followed, len(possible))}"
    broken = [one for one in found["contradictory"] if one["claims_held"] < one["claims"]]
    yield f"reported, of those not followed: {share_text(sum(bool(one['said']) for one in broken), len(broken))}"


def _shown(one: dict[str, Any], key: str) -> str:
    if one[key] is None:
        return "unknown"
    if key not in ("clean", "stable"):
        return f"{one[key]:.1f}"
    low, high = wilson_interval(round(one[key] * one["made"] / 100), one["made"])
    return f"{one[key]:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="a dataset in the MesaTask-10K format, whose library is searched first")
    parser.add_argument("--scenes", type=int, default=100, help="scenes of each kind")
    parser.add_argument("--cases", type=int, default=20, help="number of contradictory instructions")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = measure(arguments.data, arguments.scenes, arguments.cases, WorkerPool(arguments.workers))
    print("\n".join(show(found)))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
