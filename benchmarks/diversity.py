"""Seconds to compare the layouts of sets of scenes: the Vendi score, and near-duplicates beside a search over all pairs.

    python -m benchmarks.diversity RUN [--scenes 300 1000 10000] [--json FILE]

A set of S scenes has the scenes of RUN again and again, all objects shifted by up to 30 cm, so that a few are near-duplicates. The search
over all pairs matches the objects of every two scenes on the same type of table; above 1,000 scenes it is left out.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from stable_data.diversity.comparison import SAMPLE
from stable_data.diversity.layout_similarity import (
    SAME_PLACE,
    SAME_SHARE,
    SceneLayouts,
    layout_kernel,
    near_duplicates,
    num_matched,
)
from stable_data.diversity.scene_set import SceneSet
from stable_data.scores.set_distance import vendi_score_of_kernel

_MOST_BY_PAIRS = 1000

T = TypeVar("T")


def repeated(scenes: SceneSet, count: int, seed: int = 0) -> SceneLayouts:
    """Layouts of so many scenes."""
    rng = np.random.default_rng(seed)
    drawn = [scenes.scenes[k % len(scenes)] for k in range(count)]
    return SceneLayouts.from_lists(
        (s.table_type, s.table_size, s.categories, np.add(s.positions, (*rng.uniform(-0.3, 0.3, 2), 0.0))) for s in drawn
    )


def by_pairs(layouts: SceneLayouts) -> list[tuple[int, int]]:
    """Near-duplicates, with every pair matched."""
    counts = layouts.counts
    return [
        (a, b)
        for a, b in combinations(range(len(layouts)), 2)
        if layouts.table_types[a] == layouts.table_types[b]
        and 2 * num_matched(layouts, a, b, SAME_PLACE) >= SAME_SHARE * (counts[a] + counts[b]) - 1e-9
    ]


def timed(make: Callable[[], T]) -> tuple[T, float]:
    """What a function returns, and its seconds."""
    began = time.perf_counter()
    made = make()
    return made, time.perf_counter() - began


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run with the table scenes")
    parser.add_argument("--scenes", type=int, nargs="+", default=[300, 1000, 10_000])
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args(arguments)
    scenes, rows = SceneSet.read(given.run), list[dict[str, Any]]()
    if not len(scenes):
        parser.exit(2, f"{given.run}: there are no scenes\n")
    print(f"| scenes | near-duplicates, s | all pairs, s | Vendi score of {SAMPLE}, s | pairs |\n|---|---|---|---|---|")
    for count in given.scenes:
        layouts = repeated(scenes, count)
        pairs, seconds = timed(lambda layouts=layouts: near_duplicates(layouts))  # type: ignore[misc]
        plain = None
        if count <= _MOST_BY_PAIRS:
            expected, plain = timed(lambda layouts=layouts: by_pairs(layouts))  # type: ignore[misc]
            if expected != [tuple(pair) for pair in pairs.tolist()]:
                raise SystemExit(f"{count} scenes: the near-duplicates differ from those of all pairs")
        some = layouts.some(range(min(SAMPLE, count)))
        _, vendi = timed(lambda some=some: vendi_score_of_kernel(layout_kernel(some)))  # type: ignore[misc]
        print(
            f"| {count} | {seconds:.2f} | {'-' if plain is None else f'{plain:.1f}'} | {vendi:.3f} | {len(pairs)} |", flush=True
        )
        rows.append(
            {"scenes": count, "near_duplicates_s": seconds, "all_pairs_s": plain, "vendi_s": vendi, "pairs": len(pairs)}
        )
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
