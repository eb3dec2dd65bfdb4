"""What the verdicts on a scene predict: whether the expert succeeds in it, and whether its episodes hold under other physics.

``python -m benchmarks.replay SCENES EPISODES [--vary 0.3] [--limit 300] [--json FILE]``

EPISODES is a run of ``demonstrate`` in the run SCENES, best in scenes that nothing was done about: ``generate --set corrects=never --set
accept=``. An episode that could not begin counts as a failure of the expert. Each successful one, or some that are drawn, is carried out
again without feedback, with friction and mass of every object changed by up to the share ``--vary``. Intervals are Wilson's, which take
episodes as independent; those of one scene are less so. For each verdict that is a number, the table gives the area under the curve
(AUC): how often a success has the better value than a failure; 50 % is chance.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu

from models.settings import fill_settings
from pipelines.demonstrate.environments import EpisodeRef, open_episode
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.reports.text_table import align_columns
from stable_data.errors import StableDataError
from stable_data.robot.acting.recording import replay
from stable_data.robot.episodes import read_episodes
from stable_data.scores.intervals import wilson_interval
from stable_data.storage.manifest import read_manifest
from stable_data.storage.run_folder import RunFolder

NUMBERS = ("max_penetration_mm", "table_penetration_mm", "max_gap_mm", "settle_move_max_mm")
"""Verdicts that are numbers; smaller is better."""

_GROUPS: Mapping[str, Callable[[dict[str, Any]], bool]] = {
    "all": lambda row: True,
    "clean and stable": lambda row: row["clean"] and row["stable"],
    "clean": lambda row: row["clean"],
    "not clean": lambda row: row["clean"] is False,
    "stable": lambda row: row["stable"],
    "not stable": lambda row: row["stable"] is False,
    "penetration over 5 mm": lambda row: (row["max_penetration_mm"] or 0) > 5,
    "gap over 5 mm": lambda row: (row["max_gap_mm"] or 0) > 5,
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an episode.

    Attributes:
        verdicts: The row of its scene.
        expert: Whether the expert succeeded; not if the episode could not begin.
        replayed: Whether its actions succeeded again under other physics; None: not tried.
    """

    verdicts: dict[str, Any]
    expert: bool
    replayed: bool | None


def outcomes(scenes: str, episodes: str, vary: float, limit: int) -> Iterator[Outcome]:
    """Yields the outcome of each episode, of which at most ``limit`` successful ones are carried out again."""
    manifest = read_manifest(RunFolder(episodes))
    if manifest is None or manifest.get("job") != "demonstrate":
        raise SystemExit(
            f"{episodes} is {'no run' if manifest is None else 'a run of ' + str(manifest.get('job'))}, expected one of demonstrate"
        )
    settings: DemonstrateSettings = fill_settings(DemonstrateSettings, manifest["settings"], "demonstrate")
    settings = replace(settings, variation=replace(settings.variation, friction=vary, mass=vary), cameras=frozenset())
    columns = ["scene_id", "clean", "stable", *NUMBERS]
    verdicts = {row["scene_id"]: row for row in RunFolder(scenes).table("scenes", columns).to_pylist()}
    never_began = [row["id"].rpartition("/")[0] for row in RunFolder(episodes).table("failures", ["id"]).to_pylist()]
    found = sorted(read_episodes(episodes, with_pictures=False), key=lambda e: (e.scene_id, e.number))
    good = [k for k, e in enumerate(found) if e.success and e.lead is None]
    chosen = set(np.random.default_rng(0).permutation(good)[:limit].tolist())
    if strange := {e.scene_id for e in found}.union(never_began) - set(verdicts):
        raise SystemExit(
            f"{episodes} has an episode in scene {min(strange)}, which is not in {scenes}; expected episodes in its scenes"
        )
    yield from (Outcome(verdicts[scene_id], expert=False, replayed=None) for scene_id in never_began)
    for k, episode in enumerate(found):
        replayed = None
        if k in chosen:
            env = open_episode(scenes, EpisodeRef(episode.scene_id, episode.number), settings).env
            replayed = replay(env, episode).is_success
            env.close()
        yield Outcome(verdicts[episode.scene_id], episode.success, replayed)


def area_under_curve(values: Sequence[float], is_good: Sequence[bool]) -> float | None:
    """Returns how often a good one has a smaller value than a bad one, ties counted half; None without one of each."""
    good = [v for v, is_one in zip(values, is_good, strict=True) if is_one]
    bad = [v for v, is_one in zip(values, is_good, strict=True) if not is_one]
    if not good or not bad:
        return None
    return float(mannwhitneyu(bad, good).statistic) / (len(good) * len(bad))


def figures(found: Sequence[Outcome]) -> dict[str, Any]:
    """Returns successes of all groups of scenes, and the AUC of each number, for the expert and for replays."""
    groups = {}
    for name, is_in in _GROUPS.items():
        here = [o for o in found if is_in(o.verdicts)]
        again = [o.replayed for o in here if o.replayed is not None]
        groups[name] = {"expert": [sum(o.expert for o in here), len(here)], "replayed": [sum(again), len(again)]}
    areas = {}
    for name in NUMBERS:
        known = [o for o in found if o.verdicts[name] is not None]
        tried = [o for o in known if o.replayed is not None]
        areas[name] = {
            "expert": area_under_curve([o.verdicts[name] for o in known], [o.expert for o in known]),
            "replayed": area_under_curve([o.verdicts[name] for o in tried], [bool(o.replayed) for o in tried]),
        }
    return {"groups": groups, "areas": areas}


def show(found: dict[str, Any]) -> Iterator[str]:
    """Yields the lines of the tables."""
    rows = [("scenes", "expert", "95 %", "replayed", "95 %")]
    for name, group in found["groups"].items():
        cells = [cell for kind in ("expert", "replayed") for cell in _share(*group[kind])]
        rows.append((name, cells[0], cells[1], cells[2], cells[3]))
    yield align_columns(rows, 1)
    yield ""
    heads = ("AUC, %", "expert", "replayed")
    yield align_columns(
        [heads, *((name, _percent(a["expert"]), _percent(a["replayed"])) for name, a in found["areas"].items())], 1
    )


def _share(successes: int, attempts: int) -> tuple[str, str]:
    low, high = wilson_interval(successes, attempts)
    return f"{successes} of {attempts}", f"{low:.0%} to {high:.0%}" if attempts else "unknown"


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.0f}"


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", help="a run of scenes")
    parser.add_argument("episodes", help="a run of demonstrate in these scenes")
    parser.add_argument("--vary", type=float, default=0.3, help="largest change of friction and mass, as a share")
    parser.add_argument("--limit", type=int, default=300, help="episodes that are carried out again at most")
    parser.add_argument("--json", type=Path, help="file of the figures")
    options = parser.parse_args()
    try:
        found = figures(list(outcomes(options.scenes, options.episodes, options.vary, options.limit)))
    except StableDataError as error:
        parser.exit(2, f"error: {error}\n")
    print("\n".join(show(found)))
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
