"""Judges compared: seconds a scene, the share that each finds stable, how often they agree, and the scenes on which they do not.

``python -m benchmarks.judges SCENES [SCENES ...] [--judges mujoco,sapien] [--arbiter drake] [--limit N] [--json FILE]``. SCENES is a
run, or a folder in the MesaTask-10K format. The scenes are judged as they are, also those that are not clean. Times do not
include the reading of meshes. Run with ``OMP_NUM_THREADS=1``.
"""

import argparse
import itertools
import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from pipelines.reports.text_table import align_columns
from stable_data.assets.store import AssetStore
from stable_data.judges.registry import check_judges, disagree, judge
from stable_data.judges.run_verdicts import agreement
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.convention_detection import position_convention
from stable_data.scene import Tabletop
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.run_reader import RunScenes
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, RigidBody, SettleResult
from stable_data.storage.run_folder import RunFolder

WORDS = {True: "stable", False: "not stable", None: "unknown"}


@dataclass(slots=True)
class Comparison:
    """What the judges say.

    Attributes:
        names: The judges, without the arbiter.
        arbiter: The arbiter, or empty.
        seconds: Seconds of each judge, in all.
        verdicts: Scene -> judge -> verdict.
    """

    names: tuple[str, ...]
    arbiter: str = ""
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    verdicts: dict[str, dict[str, SettleResult]] = field(default_factory=dict)

    def ask(self, scene_id: str, bodies: Sequence[RigidBody], table: Tabletop) -> None:
        """Asks all judges about a scene, and the arbiter if they disagree."""
        found = self.verdicts.setdefault(scene_id, {})
        for name in self.names:
            self._ask(found, name, bodies, table)
        if self.arbiter and disagree(found):
            self._ask(found, self.arbiter, bodies, table)

    def _ask(self, found: dict[str, SettleResult], name: str, bodies: Sequence[RigidBody], table: Tabletop) -> None:
        began = time.perf_counter()
        found[name] = judge(name, bodies, table)
        self.seconds[name] += time.perf_counter() - began

    def table(self) -> str:
        """A line for each judge: scenes, stable, not stable, unknown, seconds a scene."""
        rows: list[Sequence[str]] = [("judge", "scenes", "stable", "not stable", "unknown", "s/scene")]
        for name in (*self.names, *([self.arbiter] if self.arbiter else [])):
            found = Counter(v[name].stable for v in self.verdicts.values() if name in v)
            total = sum(found.values())
            counts = (str(found[key]) for key in (True, False, None))
            rows.append((name, str(total), *counts, f"{self.seconds[name] / max(1, total):.3f}"))
        return align_columns(rows, 1)

    def agreement(self) -> str:
        """A line for each combination of verdicts of two judges."""
        found = agreement(self.verdicts.items(), self.names)
        return align_columns([("judges", "verdicts", "scenes"), *((pair, words, str(n)) for pair, words, n in found)], 2)

    def disagreements(self) -> Iterator[dict[str, Any]]:
        """For each scene on which judges disagree, what each says and which objects moved."""
        for scene_id, found in self.verdicts.items():
            if disagree(found):
                yield {"scene_id": scene_id, **{name: _said(verdict) for name, verdict in found.items()}}


def _said(verdict: SettleResult) -> dict[str, Any]:
    moved = {}
    for name, move, turn in zip(verdict.names, verdict.moves.tolist(), verdict.turns.tolist(), strict=True):
        if move > MOVE_LIMIT / 2 or turn > TURN_LIMIT / 2:
            moved[name] = f"{1e3 * move:.1f} mm {turn:.1f} deg"
    return {"stable": verdict.stable, "reason": verdict.reason, "moved": moved}


def scenes_of(place: str, limit: int | None) -> Iterator[tuple[str, Sequence[RigidBody], Tabletop]]:
    """The scenes of a run or folder, as bodies for an engine."""
    if RunFolder(place).files("scenes"):
        run = RunScenes(RunFolder(place))
        for scene in itertools.islice(run, limit):
            yield scene.scene_id, run.geometry(scene).bodies, scene.table
        return
    dataset = MesaTaskDataset(Path(place))
    store = AssetStore(dataset)
    convention = position_convention(dataset, store)
    for scene_id in dataset.scene_ids[:limit]:
        scene, shapes, _ = store.resolved(dataset.read(scene_id)[0], convention)
        yield scene_id, bodies_of(scene, shapes, store), scene.table


def show(found: Mapping[str, Any]) -> str:
    """The text of a disagreement."""
    lines = [found["scene_id"]]
    for name, said in found.items():
        if name != "scene_id":
            moved = ", ".join(f"{instance} {how}" for instance, how in said["moved"].items())
            lines.append(
                f"  {name}: {WORDS[said['stable']]}; moved: {moved or 'none'}{' | ' + said['reason'] if said['reason'] else ''}"
            )
    return "\n".join(lines)


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="a run, or a folder in the MesaTask-10K format")
    parser.add_argument("--judges", default="mujoco,sapien", help="names of judges, joined by commas")
    parser.add_argument("--arbiter", default="", help="judge that is asked where the others disagree")
    parser.add_argument("--limit", type=int, help="scenes of each place")
    parser.add_argument("--json", type=Path, help="file for the disagreements")
    arguments = parser.parse_args()
    names, arbiter = check_judges(arguments.judges, arguments.arbiter), arguments.arbiter
    found = []
    for place in arguments.scenes:
        comparison = Comparison(names, arbiter)
        for scene_id, bodies, table in tqdm(scenes_of(place, arguments.limit), unit="scene"):
            comparison.ask(scene_id, bodies, table)
        print(f"{place}\n{comparison.table()}\n{comparison.agreement()}")
        for one in comparison.disagreements():
            found.append({"place": place, **one})
            print(show(one), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
